"""What sealing costs, side by side with trusted runs and other harnesses in one run on one machine:
``python -m tests.benchmarks.sealed``.

- an evaluation: random search, trusted and sealed by turns, with a simulator that costs nothing and
  with the spring at 400 samples; wall time, and processor time of both sides;
- the harness alone: a trusted tuner that costs nothing, less the bare loop over the same work;
- a run: one of a single simulation, trusted and sealed by turns; its parts; of random search and of
  a tuner with torch loaded.

Prints a JSON line each. Peers are measured between (`tests.benchmarks.peers`), where they can be
had.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from statistics import median
from time import perf_counter, process_time

import numpy as np
import psutil

from bench.problem.experiment import Entry
from bench.problem.problem import Problem
from bench.problem.seeds import rng_for, stream_of
from bench.registry import load_plugins
from bench.runs import housing
from bench.runs.drive import drive
from bench.runs.evaluate import Evaluator
from bench.runs.training import build
from bench.runs.worker import Order, perform, problem_of
from bench.sealing.outside import Sealed, SealedTuner
from methods.base import Task
from tests.benchmarks import peers
from tests.benchmarks.harness import bare, harnessed
from tests.conftest import PLUGINS
from tests.experiments import spring_experiment

EVALUATIONS = 3000
REPEATS = 15
RUNS = 40
ROUNDS = 3
NAMES = ("sealed-benchmark", 0)
"""Of the random streams."""


def spent(pid):
    """Seconds of processor time of a process, to the nanosecond where Linux tells."""
    path = Path(f"/proc/{pid}/schedstat")
    if path.exists():
        return int(path.read_text().split()[0]) / 1e9
    times = psutil.Process(pid).cpu_times()
    return times.user + times.system


def tuners_process():
    """The one that runs the tuner's code: the last of nursery, keeper, tuner."""
    (last,) = [p for p in psutil.Process().children(recursive=True) if not p.children()]
    return last.pid


def timed(tuner, task, problem, target, child):
    """Wall seconds of a run, processor seconds of this side and of the tuner's process."""
    evaluator = Evaluator(problem, target.sealed.fitting)
    there = spent(child)
    started, used = perf_counter(), process_time()
    trace = drive(tuner, task, evaluator, rng_for(*NAMES))
    seconds = perf_counter() - started, process_time() - used
    assert trace.status == "done", trace.reason
    return np.array([*seconds, spent(child) - there])


def evaluation(problem, name):
    """Microseconds an evaluation, of random search."""
    target = problem.targets()[0]
    sealed = target.sealed
    points = np.random.default_rng(0).uniform(size=(EVALUATIONS, problem.cube.dim))
    task = Task(
        problem.cube.dim, sealed.start, sealed.fitting.observed, problem.scale,
        problem.cube.training, EVALUATIONS, (len(sealed.fitting.observed),),
    )  # fmt: skip
    entry = Entry("random", "random")
    found = {"trusted": [], "sealed": [], "harness": []}
    with housing.housed(housing.tuned_of(entry), 0, "tuner") as house:
        child = tuners_process()
        beyond = Sealed(house, stream_of(*NAMES), 1e9)
        for _ in range(REPEATS):
            found["trusted"].append(timed(build(entry), task, problem, target, child))
            found["sealed"].append(timed(beyond, task, problem, target, child))
            used = process_time()
            bare(points, problem, sealed.fitting.scenarios[0])
            between = process_time()
            harnessed(points, problem, sealed)
            found["harness"].append((process_time() - between) - (between - used))
        house.child.end()
    here, there = (np.array(found[how]) / EVALUATIONS * 1e6 for how in ("trusted", "sealed"))
    added = np.median(there - here, axis=0)
    return {
        "simulator": name,
        "trusted_us": round(median(here[:, 0]), 1),
        "sealed_us": round(median(there[:, 0]), 1),
        "sealing_adds_us": round(added[0], 1),
        "sealing_adds_processor_us": round(added[1] + added[2], 1),
        "of_it_in_the_tuners_process_us": round(added[2], 1),
        "trusted_harness_processor_us": round(median(found["harness"]) / EVALUATIONS * 1e6, 1),
    }


def orders(experiment, tuner):
    """The same run of one simulation, trusted and sealed."""
    entry = Entry(tuner, tuner)
    target = problem_of(experiment).targets()[0].sealed
    trusted = Order("run", entry, 0, target, 1)
    return trusted, Order("run", entry, 0, target, 1, tuned=housing.tuned_of(entry))


def run(experiment, tuner):
    """Milliseconds of a run: its start, the tuner's building, one simulation, its end."""
    trusted, sealed = orders(experiment, tuner)
    started = perf_counter()
    perform(experiment, sealed)
    first = perf_counter() - started
    perform(experiment, trusted)
    here, there, parts = [], [], []
    for _ in range(RUNS):
        for order, times in ((trusted, here), (sealed, there)):
            started = perf_counter()
            assert perform(experiment, order).trace.status == "done"
            times.append(1e3 * (perf_counter() - started))
        parts.append(steps(sealed.tuned))
    start, built, end = np.median(parts, axis=0)
    return {
        "tuner": tuner,
        "trusted_run_ms": round(median(here), 2),
        "sealed_run_ms": round(median(there), 2),
        "sealing_adds_ms": round(median(np.subtract(there, here)), 2),
        "start_ms": round(start, 2),
        "seals_and_building_ms": round(built, 2),
        "end_ms": round(end, 2),
        "first_run_of_a_worker_ms": round(1e3 * first),
    }


def steps(tuned):
    """Milliseconds until a process is begun, until the tuner in it is built, and of its end."""
    times = [perf_counter()]
    files = [tuned.file] if tuned.file else []
    child = housing.nursery().start("bench.sealing.inside:serve", files)
    times.append(perf_counter())
    SealedTuner(child, tuned)
    times.append(perf_counter())
    child.end()
    times.append(perf_counter())
    return 1e3 * np.diff(times)


def said(rows):
    """Print what several rounds found: the median of each number."""
    middle = {
        name: round(median([row[name] for row in rows]), 2) if not isinstance(value, str) else value
        for name, value in rows[0].items()
    }
    print(json.dumps(middle), flush=True)


def main():
    load_plugins([PLUGINS / "spring.py", Path(__file__).with_name("torched.py")])
    experiment = spring_experiment(targets=1, sampling={"rate": 60.0, "samples": 400})
    spring, nothing = Problem(experiment), Problem(experiment)
    fixed = spring.simulate(np.full((1, 2), 0.5), spring.targets()[0].sealed.fitting.scenarios)
    nothing.simulator.simulate = lambda theta, scenario: fixed
    rounds = []
    with tempfile.TemporaryDirectory() as place:
        python = peers.environment(Path(place))
        for number in range(ROUNDS):
            # A new nursery: the first run of a worker is measured too.
            housing.close()
            rounds.append([
                evaluation(nothing, "none"),
                evaluation(spring, "spring, 400 samples"),
                run(experiment, "random"),
                run(experiment, "torched"),
            ])  # fmt: skip
            if python:
                folder = Path(place) / str(number)
                folder.mkdir()
                rounds[-1] += [
                    {"peer": "nevergrad", "evaluation_us": peers.nevergrad_evaluation(python)},
                    {"peer": "benchopt", "run_ms": peers.benchopt_run(python, folder)},
                ]
    housing.close()
    for rows in zip(*rounds, strict=True):
        said(rows)


if __name__ == "__main__":
    sys.exit(main())
