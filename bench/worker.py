"""What a worker process does: make one run on one sealed target (training is `bench.training.train`).

No true parameter ever enters a worker: it gets `SealedTarget`s and returns traces, which the parent scores.
"""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

from bench.drive import Trace, drive
from bench.evaluate import Evaluator
from bench.experiment import Entry, Experiment
from bench.problem import Problem, SealedTarget
from bench.registry import load_plugins
from bench.seeds import rng_for
from bench.training import build, trained
from methods.base import Array, Task


@dataclass(frozen=True)
class Order:
    """One run to make: a tuner on a target with a seed; `weights` is the file of a learned tuner's tensors."""

    entry: Entry
    seed: int
    target: SealedTarget
    budget: int
    weights: Path | None = None


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


def initialise(plugins: Sequence[str]) -> None:
    """Prepare a worker: an interrupt is the parent's to handle, plugins are there, one thread does the arithmetic."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    load_plugins(plugins)


_problems: dict[int, tuple[Experiment, Problem]] = {}


def problem_of(experiment: Experiment) -> Problem:
    """The problem of an experiment, built once in each process."""
    held = _problems.get(0)
    if held is None or held[0] != experiment:
        if held is not None:
            held[1].close()
        held = _problems[0] = (experiment, Problem(experiment))
    return held[1]


def perform(experiment: Experiment, order: Order) -> Outcome:
    """Make one run; failures of the tuner or the simulator are a status of its trace."""
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
    )
    rng = rng_for(experiment.name, order.entry.tuner, target.name, order.seed)
    started = perf_counter()
    trace = drive(tuner, task, evaluator, rng, experiment.timeout)
    seconds = perf_counter() - started
    heldout = None
    if target.held_out.scenarios:
        heldout = Evaluator(problem, target.held_out).rmse(trace.proposals[:0], trace.recommendations)
    return Outcome(trace, evaluator.rmse(trace.proposals, trace.recommendations), heldout, seconds)
