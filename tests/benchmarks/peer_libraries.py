"""Compare the overhead with benchopt and nevergrad on a trivial problem without cost.

Run: `python -m tests.benchmarks.peer_libraries`. The other libraries are installed into a temporary
environment, or come from the Python in $PEERS.

- An evaluation: random search over two numbers, with a sum of squares as the objective, evaluated a
  few thousand times, minus the bare loop over the same numbers; nevergrad by
  `RandomSearch.minimize`, simgap by `drive_tuner` and its evaluator.
- A run: a method that does nothing, in isolation: simgap by a worker process of its pool, benchopt
  by `run_benchmark` (its smallest benchmark: one objective, data set, solver), as the slope between
  a few and many repetitions.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path
from time import perf_counter

from bench.benchmark.runner.worker_pools import LocalPool

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


def nothing(x):
    return x


def simgap_run():
    """Return milliseconds of a call in an isolated worker that is already started."""
    with LocalPool(1) as pool:
        list(pool.iterate_results([(nothing, (1,))], 60.0))
        started = perf_counter()
        list(pool.iterate_results([(nothing, (i,)) for i in range(300)], 60.0))
        return 1e3 * (perf_counter() - started) / 300


def simgap_fresh():
    """Return milliseconds of the first call in a new worker, which is the cost of a killed run."""
    times = []
    for _ in range(3):
        started = perf_counter()
        with LocalPool(1) as pool:
            list(pool.iterate_results([(nothing, (1,))], 60.0))
            times.append(1e3 * (perf_counter() - started))
    return statistics.median(times)


def simgap_evaluation():
    """Return the microseconds that the harness adds to an evaluation, from its own benchmark."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.benchmarks.harness_overhead"],
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[0])["harness_microseconds_an_evaluation"]


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


def main():
    mine = {
        "evaluation_us": simgap_evaluation(),
        "run_ms": simgap_run(),
        "fresh_worker_ms": simgap_fresh(),
    }
    print(json.dumps({"simgap": {k: round(v, 2) for k, v in mine.items()}}), flush=True)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        python = environment(folder)
        if python is None:
            return
        evaluation = nevergrad_evaluation(python)
        ratio = round(evaluation / mine["evaluation_us"], 2)
        print(
            json.dumps({"nevergrad": {"evaluation_us": round(evaluation, 2), "ratio": ratio}}),
            flush=True,
        )
        run = benchopt_run(python, folder)
        print(
            json.dumps(
                {"benchopt": {"run_ms": round(run, 1), "ratio": round(run / mine["run_ms"], 1)}}
            )
        )


if __name__ == "__main__":
    sys.exit(main())
