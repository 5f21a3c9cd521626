"""What a worker process does: make one run on one sealed target (training is
`bench.runs.training.train`).

No true parameter ever enters a worker: it gets `SealedTarget`s and returns traces, which the parent
scores. No tuner's code enters it either, unless the tuners are trusted: it simulates, counts and
times, and the tuner lives in a process of its own (`bench.sealing`).
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
    """One run to make.

    Attributes:
        run: its id.
        entry: the tuner's.
        seed: of the tuner.
        target: without its truth.
        budget: simulations.
        weights: the file of a learned tuner's tensors.
        tuned: the tuner, to be built in a process of its own; None where it is trusted.
        hidden: folders that this process must not reach.
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
        """What must travel with the order to another machine."""
        plugin = Path(self.tuned.file) if self.tuned and self.tuned.file else None
        return tuple(path for path in (self.weights, plugin) if path is not None)

    def moved(self, places: Mapping[Path, Path]) -> Order:
        """The order where its files have other places."""
        weights = None if self.weights is None else places[self.weights]
        tuned = None if self.tuned is None else moved(self.tuned, places)
        return replace(self, weights=weights, tuned=tuned)


@dataclass(frozen=True)
class Outcome:
    """What one run did, and how well what it recommended after 0..k simulations fits.

    Attributes:
        trace: the run.
        obs_rmse: (k + 1, C) error on the target's own runs, channel units.
        heldout_rmse: (k + 1, C) error on its held-out runs; None where there are none.
        seconds: wall-clock time of the run, without the scoring.
        written: files that the tuner wrote and that were thrown away with its process.
        import_seconds: that the imports of the tuner's file took before the run.
    """

    trace: Trace
    obs_rmse: Array
    heldout_rmse: Array | None
    seconds: float
    written: Written = NOTHING_WRITTEN
    import_seconds: float = 0.0


class CheatError(RuntimeError):
    """A tuner had points simulated behind the harness's back."""


_problems: dict[int, tuple[Experiment, Problem]] = {}
"""The last problem of this process; another would hold a second world open."""


def problem_of(experiment: Experiment) -> Problem:
    """The problem of an experiment, built once in each process."""
    held = _problems.get(0)
    if held is None or held[0] != experiment:
        release()
        held = _problems[0] = (experiment, Problem(experiment))
    return held[1]


def release() -> None:
    """Close the problem that this process has kept, and forget it."""
    for _, problem in _problems.values():
        problem.close()
    _problems.clear()


def perform(experiment: Experiment, order: Order) -> Outcome:
    """Make one run; failures of the tuner or the simulator are a status of its trace.

    Raises:
        CheatError: more was simulated than the tuner asked the harness for.
        EndedError: the tuner's process was killed from outside, again and again.
    """
    before: list[Array] = []
    return undisturbed(lambda: _perform(experiment, order, before))


class _Repeated:
    """Simulates what a run asks for, which is made again after a kill and must ask for the same:
    who could have itself killed would else try until it is lucky.
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
    # Scoring and what came before do not count.
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
    # A simulator that raises has simulated, and nothing came of it.
    if beside > 0 and trace.status != "crashed":
        raise CheatError(f"{beside} simulations beside the budget")
    if trace.status == "crashed":
        # Nobody sees a worker's stderr; without workers the person who wrote the tuner does.
        sys.stderr.write(trace.reason)
    # After the run, so that no tuner can have seen them.
    heldout = None
    if target.held_out.scenarios:
        heldout = Evaluator(problem, target.held_out).rmse(
            trace.proposals[:0], trace.recommendations
        )
    rmse = evaluator.rmse(trace.proposals, trace.recommendations)
    return Outcome(trace, rmse, heldout, seconds, written, import_seconds)


def _names(experiment: Experiment, order: Order) -> tuple[str | int, ...]:
    """What the run's own random stream depends on."""
    return experiment.name, order.entry.tuner, order.target.name, order.seed


def _trusted(experiment: Experiment, order: Order, task: Task, evaluate: Evaluate) -> Trace:
    """A run whose tuner works in this very process."""
    entry, weights = order.entry, order.weights
    tuner = build(entry) if weights is None else trained(entry, weights)
    rng = rng_for(*_names(experiment, order))
    with memory_limit(experiment.memory):
        return drive(tuner, task, evaluate, rng, experiment.timeout)


def _sealed(
    experiment: Experiment, order: Order, task: Task, evaluate: Evaluate
) -> tuple[Trace, Written, float]:
    """Make a run whose tuner has a process of its own.

    Returns:
        The run, what the tuner wrote, and the seconds of its imports.
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
            # What failed may have left anything behind.
            if trace.status in FAILED:
                tuner.child.end()
            return trace, written, tuner.import_seconds
    except EndedError as ended:
        # It never began: it could not be built.
        trace = drive(Ended(ended), task, evaluate, rng_for(*names))
        return trace, NOTHING_WRITTEN, 0.0


@dataclass(frozen=True)
class Ended:
    """A tuner that could not be built; its run ends as it begins."""

    error: EndedError

    def tune(self, _task: Task, _rng: object) -> Steps:
        """Begin no run.

        Raises:
            EndedError: always.
        """
        raise self.error
