"""Execute one run on one target in a worker process.

Trainings are executed by `bench.runs.training.train`. True parameters never enter a worker: it gets
`SealedTarget`s and returns traces, which the parent process scores. Code of tuners does not enter
it either, unless the tuners are trusted. The worker simulates, counts and measures time, and the
tuner lives in its own process (`bench.sealing`).
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from bench.problem.experiment import Entry, Experiment
from bench.problem.problem import Problem
from bench.problem.seeds import rng_for, stream_of
from bench.problem.targets import SealedTarget
from bench.runs.drive import Evaluate, Steps, Trace, drive
from bench.runs.evaluate import Evaluator
from bench.runs.housing import housed, undisturbed
from bench.runs.training import MADE_AGAIN, build, trained, weights_of
from bench.sealing.children import NOTHING_WRITTEN, Written
from bench.sealing.ended import EndedError
from bench.sealing.memory import memory_limit
from bench.sealing.outside import Sealed, Tuned, moved
from bench.store.status import FAILED
from methods.base import Task
from sims.base import Array


@dataclass(frozen=True)
class Order:
    """Request of one run.

    Attributes:
        run: id of the run.
        entry: entry of the tuner.
        seed: seed of the tuner.
        target: target without its true parameters.
        budget: number of simulations.
        weights: file of the weights of a learned tuner; None for none.
        tuned: specification of the tuner for an isolated process; None if it is trusted.
        hidden: folders that this process must not access.
    """

    run: str
    entry: Entry
    seed: int
    target: SealedTarget
    budget: int
    weights: Path | None = None
    tuned: Tuned | None = None
    hidden: tuple[str, ...] = ()

    def files(self) -> tuple[Path, ...]:
        """Return the files that another machine needs for the run."""
        plugin = Path(self.tuned.file) if self.tuned and self.tuned.file else None
        return tuple(path for path in (self.weights, plugin) if path is not None)

    def moved(self, places: Mapping[Path, Path]) -> Order:
        """Return the request with other paths of its files.

        Args:
            places: new path of each file by its present path.
        """
        weights = None if self.weights is None else places[self.weights]
        tuned = None if self.tuned is None else moved(self.tuned, places)
        return replace(self, weights=weights, tuned=tuned)


@dataclass(frozen=True)
class Outcome:
    """Outcome of one run, with the errors of its recommendations after 0..k simulations.

    Attributes:
        trace: trace of the run.
        obs_rmse: (k + 1, C) RMS error on the target's fitted runs, in channel units.
        heldout_rmse: (k + 1, C) RMS error on its held-out runs; None if there are none.
        seconds: wall-clock time of the run in seconds, without the scoring.
        written: files that the tuner wrote and that were deleted with its process.
        import_seconds: time in seconds for imports of the tuner's file before the run.
    """

    trace: Trace
    obs_rmse: Array
    heldout_rmse: Array | None
    seconds: float
    written: Written = NOTHING_WRITTEN
    import_seconds: float = 0.0


class CheatError(RuntimeError):
    """A tuner simulated points without the harness counting them."""


_problems: dict[int, tuple[Experiment, Problem]] = {}
"""Last problem of this process; several problems would hold several simulators open."""


def problem_of(experiment: Experiment) -> Problem:
    """Return the problem of an experiment; it is cached until another one is needed."""
    held = _problems.get(0)
    if held is None or held[0] != experiment:
        release()
        held = _problems[0] = (experiment, Problem(experiment))
    return held[1]


def release() -> None:
    """Close the cached problem of this process."""
    for _, problem in _problems.values():
        problem.close()
    _problems.clear()


def perform(experiment: Experiment, order: Order) -> Outcome:
    """Execute one run; failures of the tuner or the simulator are a status of its trace.

    Args:
        experiment: configuration of the experiment.
        order: request of the run.

    Raises:
        CheatError: more points were simulated than the tuner requested from the harness.
        EndedError: the tuner's process was killed externally several times.
    """
    before: list[Array] = []
    return undisturbed(lambda: _perform(experiment, order, before))


class _Repeated:
    """Evaluator that checks that a repeated run makes the same requests.

    A run is repeated if its process was killed externally. Otherwise a tuner that causes its own
    kill could repeat its run until the result is good.
    """

    def __init__(self, evaluate: Evaluate, before: list[Array]) -> None:
        self._evaluate, self._before, self._place = evaluate, before, 0

    def __call__(self, points: Array) -> tuple[Array, Array]:
        if self._place == len(self._before):
            self._before.append(points)
        elif not np.array_equal(self._before[self._place], points):
            raise EndedError("crashed", MADE_AGAIN)
        self._place += 1
        return self._evaluate(points)


def _perform(experiment: Experiment, order: Order, before: list[Array]) -> Outcome:
    problem = problem_of(experiment)
    target = order.target
    evaluator = Evaluator(problem, target.fitting)
    task = Task(
        dim=problem.cube.dim,
        start=target.start,
        observed=target.fitting.observed,
        scale=problem.scale,
        training=problem.cube.training,
        budget=order.budget,
        lengths=tuple(s.times.size for s in target.fitting.scenarios),
        scene=problem.scene(target.fitting.scenarios),
    )
    # Simulations of the scoring and of earlier runs are not counted.
    simulated = problem.simulated
    started = perf_counter()
    written, import_seconds = NOTHING_WRITTEN, 0.0
    if order.tuned is None:
        trace = _trusted(experiment, order, task, evaluator)
    else:
        repeated = _Repeated(evaluator, before)
        trace, written, import_seconds = _sealed(experiment, order, task, repeated)
    seconds = perf_counter() - started
    beside = problem.simulated - simulated - len(trace.losses)
    # A simulator that raises an error has counted simulations without a result.
    if beside > 0 and trace.status != "crashed":
        raise CheatError(f"{beside} simulations beside the budget")
    if trace.status == "crashed":
        # The stderr of a worker is discarded; without workers the author of the tuner sees it.
        sys.stderr.write(trace.reason)
    # Held-out runs are simulated after the run, so that the tuner cannot see them.
    heldout = None
    if target.held_out.scenarios:
        heldout = Evaluator(problem, target.held_out).rmse(
            trace.proposals[:0], trace.recommendations
        )
    rmse = evaluator.rmse(trace.proposals, trace.recommendations)
    return Outcome(trace, rmse, heldout, seconds, written, import_seconds)


def _names(experiment: Experiment, order: Order) -> tuple[str | int, ...]:
    """Return the names that determine the random stream of the run."""
    return experiment.name, order.entry.tuner, order.target.name, order.seed


def _trusted(experiment: Experiment, order: Order, task: Task, evaluate: Evaluate) -> Trace:
    """Execute a run whose tuner works in this process."""
    entry, weights = order.entry, order.weights
    tuner = build(entry) if weights is None else trained(entry, weights)
    rng = rng_for(*_names(experiment, order))
    with memory_limit(experiment.memory):
        return drive(tuner, task, evaluate, rng, experiment.timeout)


def _sealed(
    experiment: Experiment, order: Order, task: Task, evaluate: Evaluate
) -> tuple[Trace, Written, float]:
    """Execute a run whose tuner has an isolated process.

    Returns:
        The trace, the files that the tuner wrote, and the seconds of its imports.
    """
    assert order.tuned is not None
    state = None if order.weights is None else weights_of(order.weights)
    names = _names(experiment, order)
    house = housed(
        order.tuned, order.seed, experiment.isolation, order.hidden, experiment.memory, state
    )
    try:
        with house as tuner:
            run = Sealed(tuner, stream_of(*names), experiment.timeout)
            trace = drive(run, task, evaluate, rng_for(*names), experiment.timeout)
            written = tuner.child.written()
            # A failed run may have left the process in any state.
            if trace.status in FAILED:
                tuner.child.end()
            return trace, written, tuner.import_seconds
    except EndedError as ended:
        # The tuner could not be built, so the run has no simulations.
        trace = drive(Ended(ended), task, evaluate, rng_for(*names))
        return trace, NOTHING_WRITTEN, 0.0


@dataclass(frozen=True)
class Ended:
    """Tuner that could not be built; its run fails at the start.

    Attributes:
        error: reason of the failure.
    """

    error: EndedError

    def tune(self, _task: Task, _rng: object) -> Steps:
        """Fail to start a run.

        Raises:
            EndedError: always.
        """
        raise self.error
