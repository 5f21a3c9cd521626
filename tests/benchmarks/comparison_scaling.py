"""Measure bytes, seconds and memory by number of runs and rows.

Run: `python -m tests.benchmarks.comparison_scaling`. Prints one JSON line per measurement;
`docs/scale.md` uses the slopes.
"""

from __future__ import annotations

import json
import resource
import sys
import tempfile
import time
from pathlib import Path
from time import perf_counter

import numpy as np

from bench.benchmark.comparison_report import write_report
from bench.benchmark.comparison_study import Comparison
from bench.benchmark.runner.experiment_runner import prepare_experiment
from bench.benchmark.runner.run_in_worker import RunOutcome
from bench.benchmark.runner.run_result_rows import build_rows, make_status
from bench.benchmark.runner.study_base import prepare_study
from bench.benchmark.runner.tuner_loop import RunTrace
from bench.benchmark.runner.worker_pools import LocalPool
from bench.benchmark.statistics.comparison_statistics import REQUIRED_RUN_COLUMNS
from bench.benchmark.storage.result_folder import read_comparison, write_results
from bench.benchmark.storage.run_journal import RunJournal
from bench.core.plugin_registries import load_plugins
from tests.conftest import PLUGINS
from tests.sample_experiments import spring_experiment

TUNERS = {"random": {}, "cma_es": {}, "least_squares": {}, "nelder_mead": {"seeds": 5}}


def outcome(job, rng, budget):
    """Return random numbers of the shapes that a worker returns."""
    steps = np.arange(1, budget + 1)
    points = np.clip(0.5 + rng.normal(size=(budget, 2)) / steps[:, None], 0, 1)
    trace = RunTrace(
        "done", "", points, rng.exponential(size=budget) / steps,
        np.vstack([job.target.blinded.start, points]),
        np.full(budget, 1e-4), np.full(budget, 1e-3),
    )  # fmt: skip
    return RunOutcome(trace, rng.exponential(size=(budget + 1, 1)), None, 0.1)


def memory():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(targets, budget, figures):
    experiment = spring_experiment(targets=targets, seeds=5, budget=budget, tuners=TUNERS)
    with tempfile.TemporaryDirectory() as place:
        before, started = memory(), perf_counter()
        folder = Path(place) / "out"
        results = Comparison.begin(prepare_study(experiment, [], folder)).results
        planned = perf_counter() - started
        plan_memory = memory() - before
        rng = np.random.default_rng(0)
        started = perf_counter()
        for i, job in enumerate(results.plan):
            end = outcome(job, rng, budget)
            results.run_sink.append(
                i,
                build_rows(results.problem, job.request, job.target, end),
                make_status(results.problem, job.request, end),
            )
        kept = perf_counter() - started
        segments = sum(f.stat().st_size for f in (folder / "segments").iterdir())
        started = perf_counter()
        RunJournal.close(results.run_sink)
        again = RunJournal(folder)
        reopened = perf_counter() - started
        started = perf_counter()
        write_results(folder, again, [], [])
        written = perf_counter() - started
        runs = len(results.plan)
        parquet = (folder / "runs.parquet").stat().st_size
        again.delete_segments()
        started = perf_counter()
        read_comparison(folder, [*REQUIRED_RUN_COLUMNS])
        reading = perf_counter() - started
        whole = None
        if figures:
            started = perf_counter()
            write_report(folder, lambda _: None)
            whole = round(perf_counter() - started, 2)
        print(json.dumps({
            "runs": runs, "rows": runs * (budget + 1), "plan_seconds": round(planned, 2),
            "plan_MiB": round(plan_memory),
            "keep_milliseconds_a_run": round(1e3 * kept / runs, 3),
            "segments_bytes_a_run": round(segments / runs),
            "reopen_seconds": round(reopened, 2), "write_seconds": round(written, 2),
            "parquet_bytes_a_row": round(parquet / (runs * (budget + 1)), 1),
            "read_seconds": round(reading, 2), "table_and_all_figures_seconds": whole,
            "peak_MiB": round(memory()),
        }), flush=True)  # fmt: skip


def nap(seconds):
    """Replace a run by a wait, which uses a worker but no core.

    Other work on the machine then has no influence.
    """
    time.sleep(seconds)


def speed_up(calls=80, seconds=0.25):
    """Print how many times faster two started workers are than one."""
    took = {}
    for jobs in (1, 2):
        with LocalPool(jobs) as pool:
            list(pool.iterate_results([(nap, (0.5,))] * (2 * jobs), 60.0))
            started = perf_counter()
            list(pool.iterate_results([(nap, (seconds,))] * calls, 60.0))
            took[jobs] = perf_counter() - started
    print(
        json.dumps(
            {
                "calls": calls,
                "seconds_each": seconds,
                "speed_up_of_2_workers": round(took[1] / took[2], 3),
            }
        )
    )


def main():
    speed_up()
    load_plugins([PLUGINS / "spring.py"])
    prepare_experiment(spring_experiment())
    for targets, budget, figures in (
        (25, 100, True),
        (250, 100, True),
        (1000, 20, False),
        (2500, 20, False),
    ):
        measure(targets, budget, figures)


if __name__ == "__main__":
    sys.exit(main())
