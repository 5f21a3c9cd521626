"""Runs an experiment: tuners x targets x seeds in worker processes, hard time limits, nothing lost on Ctrl-C."""

from __future__ import annotations

import math
import multiprocessing
import os
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from typing import Any

from bench.experiment import Entry, Experiment
from bench.problem import Problem, Target
from bench.registry import SkippedError, tuners
from bench.scores import Status, rows, status_of, unfinished
from bench.training import Training, build, train
from bench.worker import Order, Outcome, initialise, perform
from sims.base import InputError

_GRACE = 30.0
"""Seconds by which the hard limit, which kills, exceeds the soft one, which a cooperative run meets by itself."""


Progress = Callable[[str, int], Callable[[], None]]
"""Called with a title and a number of steps; gives the function to call after each step."""


def _silent(_title: str, _steps: int) -> Callable[[], None]:
    return lambda: None


@dataclass
class Results:
    """What a comparison has so far: columns and status of each run by its place in the plan, and what training cost."""

    problem: Problem
    columns: dict[int, dict[str, Any]] = field(default_factory=dict)
    statuses: dict[int, Status] = field(default_factory=dict)
    trainings: dict[tuple[str, int], Training] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    planned: int = 0
    interrupted: bool = False


@dataclass(frozen=True)
class Job:
    """An order and the target it is for, truth included; stays in the parent process."""

    order: Order
    target: Target


def seeds_of(experiment: Experiment, entry: Entry) -> int:
    """How many seeds an entry runs: its own number, the experiment's, or one where nothing is random."""
    kind = tuners.get(entry.tuner)
    if not (kind.stochastic or kind.learned):
        return 1
    return entry.seeds or experiment.seeds


def check(experiment: Experiment) -> dict[str, str]:
    """Build every tuner once, so that a fault shows before the work; returns the skipped entries with their reason."""
    skipped = {}
    for entry in experiment.tuners:
        try:
            build(entry)
        except SkippedError as reason:
            skipped[entry.label] = str(reason)
    return skipped


def prepare(experiment: Experiment) -> Results:
    """Check an experiment whole before any work: its simulator, recording, tuners and their options.

    Raises:
        InputError: a fault in it.
    """
    if not experiment.tuners:
        raise InputError(f"experiment {experiment.name}: names no tuner; add a [tuners.NAME] table or use --tuners")
    return Results(Problem(experiment), skipped=check(experiment))


def run(
    results: Results,
    plugins: Sequence[str] = (),
    jobs: int = 2,
    progress: Progress = _silent,
) -> None:
    """Make every run of a prepared experiment; `results` gets each as it ends.

    Args:
        results: from `prepare`.
        plugins: plugin files that workers need; the caller has loaded them in this process.
        jobs: worker processes. The results do not depend on their number.
        progress: told of every step.
    """
    experiment = results.problem.experiment
    targets = results.problem.targets()
    results.problem.close()
    entries = [entry for entry in experiment.tuners if entry.label not in results.skipped]
    with _Pool(jobs, plugins) as pool:
        try:
            failures = _train(pool, experiment, entries, results, progress)
            plan = list(_plan(experiment, entries, targets, results.trainings))
            results.planned = len(plan)
            step = progress("running", len(plan))
            untrained = {i for i, job in enumerate(plan) if (job.order.entry.label, job.order.seed) in failures}
            for i in sorted(untrained):
                _file(results, i, plan[i], failures[plan[i].order.entry.label, plan[i].order.seed])
                step()
            ready = [i for i in range(len(plan)) if i not in untrained]
            calls = [(perform, (experiment, plan[i].order)) for i in ready]
            for place, outcome in pool.results(calls, experiment.timeout):
                _file(results, ready[place], plan[ready[place]], outcome)
                step()
        except KeyboardInterrupt:
            results.interrupted = True


def _train(
    pool: _Pool, experiment: Experiment, entries: list[Entry], results: Results, progress: Progress
) -> dict[tuple[str, int], Exception]:
    """Train every learned entry with each of its seeds; returns the reasons of those that failed."""
    learned = [e for e in entries if tuners.get(e.tuner).learned]
    wanted = [(e, seed) for e in learned for seed in range(seeds_of(experiment, e))]
    failures: dict[tuple[str, int], Exception] = {}
    if wanted:
        step = progress("training", len(wanted))
        calls = [(train, (experiment, entry, seed)) for entry, seed in wanted]
        for place, trained in pool.results(calls, math.inf):
            entry, seed = wanted[place]
            if isinstance(trained, Training):
                results.trainings[entry.label, seed] = trained
            else:
                failures[entry.label, seed] = trained
            step()
    return failures


def _plan(
    experiment: Experiment,
    entries: list[Entry],
    targets: list[Target],
    trainings: dict[tuple[str, int], Training],
) -> Iterator[Job]:
    """Every run, target by target, so that the time left can be estimated from the time gone."""
    for target in targets:
        for entry in entries:
            for seed in range(seeds_of(experiment, entry)):
                training = trainings.get((entry.label, seed))
                weights = training.path if training else None
                yield Job(Order(entry, seed, target.sealed, entry.budget or experiment.budget, weights), target)


def _file(results: Results, place: int, job: Job, outcome: Outcome | Exception) -> None:
    """Keep what a worker gave back: an outcome, or the error that ended it."""
    problem = results.problem
    if isinstance(outcome, TimeoutError):
        reason = f"killed past its limit of {problem.experiment.timeout:g} s"
        outcome = unfinished(problem, job.target, "timeout", reason)
    elif isinstance(outcome, Exception):
        reason = "".join(traceback.format_exception(outcome))
        outcome = unfinished(problem, job.target, "crashed", reason)
    results.columns[place] = rows(problem, job.order, job.target, outcome)
    results.statuses[place] = status_of(problem, job.order, outcome)


class _Pool:
    """Worker processes, each a fresh interpreter with one arithmetic thread; a task past its limit is killed."""

    _THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

    def __init__(self, jobs: int, plugins: Sequence[str]) -> None:
        from pebble import ProcessPool

        self._jobs = jobs
        for name in self._THREADS:
            os.environ.setdefault(name, "1")
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPool(jobs, initializer=initialise, initargs=(list(plugins),), context=context)

    def __enter__(self) -> _Pool:
        return self

    def __exit__(self, kind: object, *rest: object) -> None:
        self._pool.stop()  # type: ignore[no-untyped-call]
        self._pool.join()

    def results(self, calls: Sequence[tuple[Any, tuple[Any, ...]]], seconds: float) -> Iterator[tuple[int, Any]]:
        """Place and result (or exception) of each call, as they finish; few are handed over ahead of time."""
        limit = None if math.isinf(seconds) else seconds + _GRACE
        waiting: dict[Future[Any], int] = {}
        following = iter(enumerate(calls))
        while True:
            while len(waiting) < 4 * self._jobs and (item := next(following, None)) is not None:
                place, (function, arguments) = item
                waiting[self._pool.schedule(function, args=arguments, timeout=limit)] = place
            if not waiting:
                return
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                place = waiting.pop(future)
                error = future.exception()
                yield place, future.result() if error is None else error
