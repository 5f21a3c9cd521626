"""Measure the overhead of benchopt and nevergrad on a trivial problem without cost.

Part of `python -m tests.benchmarks.isolation_overhead`. The libraries are installed into a
temporary environment, or come from the Python in $PEERS.

- An evaluation: random search over two numbers, with a sum of squares as the objective, minus the
  bare loop over the same numbers, by nevergrad's `RandomSearch.minimize`.
- A run: a method that does nothing, by benchopt's smallest benchmark (one objective, data set,
  solver), as the slope between a few and many repetitions.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap
from time import perf_counter

EVALUATIONS = 3000
NEVERGRAD = """
import json, time, warnings
warnings.simplefilter("ignore")
import numpy as np
import nevergrad as ng
N = {n}
def objective(x):
    return float((x * x).sum())
points = np.random.default_rng(0).uniform(size=(N, 2))
bare, whole = [], []
for _ in range(5):
    t = time.perf_counter()
    for p in points:
        objective(p)
    bare.append(time.perf_counter() - t)
    optimizer = ng.optimizers.RandomSearch(parametrization=ng.p.Array(shape=(2,)), budget=N)
    t = time.perf_counter()
    optimizer.minimize(objective)
    whole.append(time.perf_counter() - t)
print(json.dumps((np.median(whole) - np.median(bare)) / N * 1e6))
"""
BENCHMARK = {
    "objective.py": """
        from benchopt import BaseObjective
        import numpy as np
        class Objective(BaseObjective):
            name = "trivial"
            min_benchopt_version = "1.6"
            def set_data(self, x): self.x = x
            def get_objective(self): return dict(x=self.x)
            def evaluate_result(self, w): return dict(value=float((w * w).sum()))
            def get_one_result(self): return dict(w=np.zeros(2))
    """,
    "datasets/simulated.py": """
        from benchopt import BaseDataset
        import numpy as np
        class Dataset(BaseDataset):
            name = "simulated"
            parameters = {"number": [*range(COUNT)]}
            def get_data(self): return dict(x=np.ones(2))
    """,
    "solvers/nothing.py": """
        from benchopt import BaseSolver
        import numpy as np
        class Solver(BaseSolver):
            name = "nothing"
            sampling_strategy = "run_once"
            def set_objective(self, x): self.x = x
            def run(self, _): self.w = np.ones(2)
            def get_result(self): return dict(w=self.w)
    """,
}


def nevergrad_evaluation(python):
    done = subprocess.run(
        [python, "-c", NEVERGRAD.replace("{n}", str(EVALUATIONS))],
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def benchopt_run(python, folder):
    """Return milliseconds of one more run: the slope between benchmarks of 10 and 410 runs."""
    times = {}
    for count in (10, 410):
        place = folder / f"benchmark-{count}"
        for name, text in BENCHMARK.items():
            path = place / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(textwrap.dedent(text).replace("COUNT", str(count)))
        command = [
            python,
            "-m",
            "benchopt",
            "run",
            str(place),
            "--no-plot",
            "--no-html",
            "-n",
            "1",
            "-r",
            "1",
            "--no-cache",
        ]
        started = perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
        times[count] = perf_counter() - started
        if done.returncode != 0:
            raise RuntimeError(done.stdout[-2000:] + done.stderr[-2000:])
    return 1e3 * (times[410] - times[10]) / 400


def environment(folder, packages=("benchopt", "nevergrad")):
    """Return the Python that has the packages: $PEERS, or a new environment in `folder`.

    The result is None if they cannot be installed.
    """
    if os.environ.get("PEERS"):
        return os.environ["PEERS"]
    python = str(folder / "venv" / "bin" / "python")
    install = [python, "-m", "pip", "install", "--quiet", *packages]
    try:
        subprocess.run([sys.executable, "-m", "venv", str(folder / "venv")], check=True)
        subprocess.run(install, check=True, capture_output=True)
    except subprocess.CalledProcessError:
        print("peers: cannot be installed here, nothing to compare with", file=sys.stderr)
        return None
    return python
