"""Measure the cost of isolation, with in-process runs and other harnesses on the same machine.

``python -m tests.benchmarks.isolation_overhead``

- An evaluation: random search, in-process and isolated runs alternate, with a simulator without
  cost and with the spring at 400 samples; wall time, and processor time of both processes.
- The harness alone: an in-process tuner without cost, minus the bare loop over the same work.
- A run of one simulation, in-process and isolated runs alternate, and its parts; for random search
  and for a tuner that has loaded torch.

Prints one JSON line each. Other libraries are measured between the rounds
(`benchmarks.peer_libraries`), if they can be installed.
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

from bench.benchmark.isolation.tuner_processes import IsolatedRun, IsolatedTuner
from bench.benchmark.problem.experiment_config import TunerEntry
from bench.benchmark.problem.targets import draw_targets
from bench.benchmark.problem.tuning_problem import ProposalEvaluator
from bench.benchmark.runner import tuner_process_start
from bench.benchmark.runner.run_in_worker import RunRequest, execute_run, get_problem
from bench.benchmark.runner.tuner_loop import drive_tuner
from bench.benchmark.runner.tuner_training import build_tuner
from bench.core.plugin_registries import load_plugins
from bench.core.random_streams import make_rng, make_seed_words
from methods.tuner import Task
from tests.benchmarks import peer_libraries
from tests.benchmarks.harness_overhead import bare, harnessed, make_problems

EVALUATIONS = 3000
REPEATS = 15
RUNS = 40
ROUNDS = 3
NAMES = ("sealed-benchmark", 0)
"""Names from which the random streams are seeded."""


def spent(pid):
    """Return the processor seconds of a process, to the nanosecond where Linux provides it."""
    path = Path(f"/proc/{pid}/schedstat")
    if path.exists():
        return int(path.read_text().split()[0]) / 1e9
    times = psutil.Process(pid).cpu_times()
    return times.user + times.system


def tuners_process():
    """Return the process that runs the tuner: the last of fork server, supervisor and tuner."""
    (last,) = [p for p in psutil.Process().children(recursive=True) if not p.children()]
    return last.pid


def timed(tuner, task, problem, target, child):
    """Return wall seconds of a run, and processor seconds of this and the tuner's process."""
    evaluator = ProposalEvaluator(problem, target.blinded.fitting)
    there = spent(child)
    started, used = perf_counter(), process_time()
    trace = drive_tuner(tuner, task, evaluator, make_rng(*NAMES))
    seconds = perf_counter() - started, process_time() - used
    assert trace.status == "done", trace.reason
    return np.array([*seconds, spent(child) - there])


def evaluation(problem, name):
    """Measure microseconds per evaluation of random search."""
    target = draw_targets(problem)[0]
    sealed = target.blinded
    points = np.random.default_rng(0).uniform(size=(EVALUATIONS, problem.cube.dim))
    task = Task(
        problem.cube.dim, sealed.start, sealed.fitting.observed, problem.scale,
        problem.cube.training, EVALUATIONS, (len(sealed.fitting.observed),),
    )  # fmt: skip
    entry = TunerEntry("random", "random")
    found = {"trusted": [], "sealed": [], "harness": []}
    with tuner_process_start.start_isolated_tuner(
        tuner_process_start.make_tuner_spec(entry), 0, "tuner"
    ) as house:
        child = tuners_process()
        beyond = IsolatedRun(house, make_seed_words(*NAMES), 1e9)
        for _ in range(REPEATS):
            found["trusted"].append(timed(build_tuner(entry), task, problem, target, child))
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
    """Return the same run request of one simulation, in-process and isolated."""
    entry = TunerEntry(tuner, tuner)
    target = draw_targets(get_problem(experiment))[0].blinded
    trusted = RunRequest("run", entry, 0, target, 1)
    return trusted, RunRequest(
        "run", entry, 0, target, 1, tuned=tuner_process_start.make_tuner_spec(entry)
    )


def run(experiment, tuner):
    """Measure milliseconds of a run: start, construction of the tuner, one simulation, end."""
    trusted, sealed = orders(experiment, tuner)
    started = perf_counter()
    execute_run(experiment, sealed)
    first = perf_counter() - started
    execute_run(experiment, trusted)
    here, there, parts = [], [], []
    for _ in range(RUNS):
        for order, times in ((trusted, here), (sealed, there)):
            started = perf_counter()
            assert execute_run(experiment, order).trace.status == "done"
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
    """Return milliseconds to start a process, to build the tuner in it, and to end it."""
    times = [perf_counter()]
    files = [tuned.file] if tuned.file else []
    child = tuner_process_start.get_fork_server().start_process(
        "bench.benchmark.isolation.tuner_server:serve_requests", files
    )
    times.append(perf_counter())
    IsolatedTuner(child, tuned)
    times.append(perf_counter())
    child.end()
    times.append(perf_counter())
    return 1e3 * np.diff(times)


def print_medians(rows):
    """Print the median of each number over several rounds."""
    middle = {
        name: round(median([row[name] for row in rows]), 2) if not isinstance(value, str) else value
        for name, value in rows[0].items()
    }
    print(json.dumps(middle), flush=True)


def main():
    load_plugins([Path(__file__).with_name("torch_networks.py")])
    problems = make_problems()
    experiment = problems["none"].experiment
    rounds = []
    with tempfile.TemporaryDirectory() as place:
        python = peer_libraries.environment(Path(place))
        for number in range(ROUNDS):
            # Start a new fork server, because the first run of a worker is measured too.
            tuner_process_start.close_isolated_processes()
            rounds.append([
                *(evaluation(problem, name) for name, problem in problems.items()),
                run(experiment, "random"),
                run(experiment, "torched"),
            ])  # fmt: skip
            if python:
                folder = Path(place) / str(number)
                folder.mkdir()
                rounds[-1] += [
                    {
                        "peer": "nevergrad",
                        "evaluation_us": peer_libraries.nevergrad_evaluation(python),
                    },
                    {"peer": "benchopt", "run_ms": peer_libraries.benchopt_run(python, folder)},
                ]
    tuner_process_start.close_isolated_processes()
    for rows in zip(*rounds, strict=True):
        print_medians(rows)


if __name__ == "__main__":
    sys.exit(main())
