"""Measure how much time several cores save in a diagnosis.

``OMP_NUM_THREADS=1 python -m tests.benchmarks.speedup_by_cores [RECORDING.csv ...] [--jobs N]``

Without a recording, it uses a pair of causes on each system. On a shared machine wall time is
unreliable, so the critical path is printed as well: the processor time of the main process, plus
the largest processor time of a worker in each shared round.
"""

import argparse
import os
import tempfile
import time
from collections import Counter
from pathlib import Path

from bench.diagnosis.evaluation.forked_workers import ForkedWorkerPool
from bench.diagnosis.explain import explain
from tests.simulation_arguments import simulation_spec, write

DEFAULTS = {"runs": 4, "seconds": 4.0, "rate": 100.0, "engine": "mujoco"}
PAIRS = {
    "pendulum": simulation_spec(
        "pendulum", effects=["drag.linear=6e-4", "friction.coulomb=2e-3"],
        noise=["q=0.003", "qd=0.02"], **DEFAULTS,
    ),
    "slider": simulation_spec(
        "slider", effects=["drag.quadratic=0.4", "friction.coulomb=0.3"],
        inputs=["u=chirp:3:0.3:2"], noise=["x=0.002", "v=0.01"], **DEFAULTS,
    ),
    "servo": simulation_spec(
        "servo", effects=["friction.coulomb=0.01", "input.delay=0.03"], noise=["0.002"], **DEFAULTS
    ),
    "ball": simulation_spec(
        "ball", effects=["wind=3,0.004", "sensor.delay=0.03"], noise=["0.005"], **DEFAULTS
    ),
}  # fmt: skip


class Meter:
    """Sums up the processor times of shared rounds."""

    def __init__(self):
        self.longest = self.all = 0.0
        self.rounds = 0
        self.distribute = ForkedWorkerPool._distribute

    def __enter__(self):
        meter = self

        def shared(worker_pool, world, task, items):
            spent = Counter()
            wrapped = [(task, *item) for item in items]
            for number, (result, who, seconds) in meter.distribute(
                worker_pool, world, timed, wrapped
            ):
                spent[who] += seconds
                yield number, result
            meter.rounds += 1
            meter.longest += max(spent.values())
            meter.all += sum(spent.values())

        ForkedWorkerPool._distribute = shared
        return self

    def __exit__(self, *_):
        ForkedWorkerPool._distribute = self.distribute


def timed(world, task, *item):
    """Run a task and return its result, the worker and the processor time."""
    begun = time.process_time()
    result = task(world, *item)
    return result, os.getpid(), time.process_time() - begun


def measured(path, jobs):
    """Explain a recording and measure the times.

    Returns:
        Wall seconds, seconds of the critical path, processor seconds of the main process, the meter
        of the shared rounds, and the verdict.
    """
    begun, clock = time.process_time(), time.perf_counter()
    with Meter() as meter:
        found = explain(path, jobs=jobs)
    passed = time.perf_counter() - clock
    own = time.process_time() - begun
    document = found.answer.to_document()
    document.pop("seconds")
    return passed, own + meter.longest, own, meter, document


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        paths = given.recordings
        for name, wish in PAIRS.items() if not paths else ():
            paths = [*paths, Path(folder) / f"{name}.csv"]
            write(wish, paths[-1])
        for path in paths:
            explain(path)  # The first call includes imports and tracing.
            row = measured(path, 1), measured(path, given.jobs)
            (clock, alone, *_, first), (shared, path_of, own, meter, second) = row
            assert first == second, "the answer depends on the number of processes"
            print(
                f"{path.stem}: {first['verdict']}; clock {clock:.2f} -> {shared:.2f} s; critical "
                f"path {alone:.2f} -> {path_of:.2f} s ({alone / path_of:.2f} x): leading {own:.2f},"
                f" shared {meter.all:.2f} in {meter.rounds} rounds, at most "
                f"{meter.longest:.2f} of it one after another",
                flush=True,
            )


if __name__ == "__main__":
    main()
