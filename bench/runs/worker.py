"""What a worker process does: make one run on one sealed target (training is
`bench.runs.training.train`).

No true parameter ever enters a worker: it gets `SealedTarget`s and returns traces, which the parent
scores.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

from bench.problem.experiment import Entry, Experiment
from bench.problem.problem import Problem
from bench.problem.seeds import rng_for
from bench.problem.targets import SealedTarget
from bench.runs.drive import Trace, drive
from bench.runs.evaluate import Evaluator
from bench.runs.guard import memory_limit
from bench.runs.training import build, trained
from methods.base import Task
from sims.base import Array


@dataclass(frozen=True)
class Order:
    """One run to make: its id, a tuner on a target with a seed; `weights` is the file of a learned
    tuner's tensors.
    """

    run: str
    entry: Entry
    seed: int
    target: SealedTarget
    budget: int
    weights: Path | None = None

    def files(self) -> tuple[Path, ...]:
        """What must travel with the order to another machine."""
        return () if self.weights is None else (self.weights,)

    def moved(self, places: Mapping[Path, Path]) -> Order:
        """The order where its files have other places."""
        return self if self.weights is None else replace(self, weights=places[self.weights])


@dataclass(frozen=True)
class Outcome:
    """What one run did, and how well what it recommended after 0..k simulations fits.

    Attributes:
        trace: the run.
        obs_rmse: (k + 1, C) error on the target's own runs, channel units.
        heldout_rmse: (k + 1, C) error on its held-out runs; None where there are none.
        seconds: wall-clock time of the run, without the scoring.
    """

    trace: Trace
    obs_rmse: Array
    heldout_rmse: Array | None
    seconds: float


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
    """
    problem = problem_of(experiment)
    target = order.target
    tuner = build(order.entry) if order.weights is None else trained(order.entry, order.weights)
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
    rng = rng_for(experiment.name, order.entry.tuner, target.name, order.seed)
    # Scoring and what came before do not count.
    before = problem.simulated
    started = perf_counter()
    with memory_limit(experiment.memory):
        trace = drive(tuner, task, evaluator, rng, experiment.timeout)
    seconds = perf_counter() - started
    beside = problem.simulated - before - len(trace.losses)
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
    return Outcome(trace, evaluator.rmse(trace.proposals, trace.recommendations), heldout, seconds)
