"""Overhead beside benchopt and nevergrad: what each harness adds to a trivial problem that costs
nothing itself.

Run: `python -m tests.benchmarks.peer_libraries`. The peers are installed into a throwaway
    environment, or
are those of the Python that $PEERS names.

- an evaluation: random search over two numbers, the objective a sum of squares, evaluated a few
  thousand times, less the bare loop over the same numbers; nevergrad by `RandomSearch.minimize`,
  simgap by `drive` and its evaluator;
- a run: a method that does nothing, in isolation: simgap by a worker process of its pool, benchopt
  by `run_benchmark` (its smallest benchmark: one objective, data set, solver), slope between a few
  and many repetitions.
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
    """Milliseconds of a call in an isolated worker, when the worker is there."""
    with LocalPool(1) as pool:
        list(pool.iterate_results([(nothing, (1,))], 60.0))
        started = perf_counter()
        list(pool.iterate_results([(nothing, (i,)) for i in range(300)], 60.0))
        return 1e3 * (perf_counter() - started) / 300


def simgap_fresh():
    """Milliseconds of the first call in a worker that has to be started: what a killed run
    costs.
    """
    times = []
    for _ in range(3):
        started = perf_counter()
        with LocalPool(1) as pool:
            list(pool.iterate_results([(nothing, (1,))], 60.0))
            times.append(1e3 * (perf_counter() - started))
    return statistics.median(times)


def simgap_evaluation():
    """Microseconds that `drive` and the evaluator add, from the harness's own benchmark."""
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
    """Milliseconds of one more run: the slope between a benchmark of 10 and one of 410."""
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
    """Python of an environment that has the peers: of $PEERS, else of one made below `folder`; None
    where they cannot be had.
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
