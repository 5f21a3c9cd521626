"""Drives a registered tuner on any function that simulates, without an experiment around it.

A part of the harness that only wants good parameters gets them here, under the contract of a
comparison: the tuner works in the unit cube, within a budget, and sees no more than a target shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.registry import tuners
from bench.runs.drive import Evaluate, drive
from methods.base import Task
from methods.learning.quasi_random import spread
from sims.base import Array, InputError, Parameter, UnitCube


@dataclass(frozen=True)
class Standalone:
    """What a tuner is to be run on.

    Attributes:
        parameters: what it tunes.
        start: (b,) where it starts, physical units.
        observed: (T, C) SI units, runs one behind the other; NaN where a sample is missing.
        scale: (C,) what a residual is divided by.
        lengths: samples of each run; they add up to T.
        evaluate: physical parameters (n, b) -> observations (n, T, C) and losses (n,).
    """

    parameters: Sequence[Parameter]
    start: Array
    observed: Array
    scale: Array
    lengths: tuple[int, ...]
    evaluate: Evaluate


def recommended(
    name: str, problem: Standalone, budget: int, seconds: float, rng: np.random.Generator
) -> Array:
    """Parameters (b,) that a registered tuner recommends in the end, physical units.

    Args:
        name: the tuner's, with its default options.
        problem: what it is run on.
        budget: simulations that it may use.
        seconds: time limit, checked between evaluations.
        rng: the run's own generator.

    Raises:
        InputError: no such tuner, or one that must be trained first.
    """
    kind = tuners.get(name)
    # there is no experiment here that says on what to train
    if kind.learned:
        raise InputError(
            f"tuner {name} must be trained first; expected one that searches, such as least_squares"
        )
    cube = UnitCube(problem.parameters)

    def evaluate(points: Array) -> tuple[Array, Array]:
        return problem.evaluate(cube.physical(points))

    task = Task(
        dim=cube.dim,
        start=cube.inverse(problem.start),
        observed=problem.observed,
        scale=problem.scale,
        training=cube.training,
        budget=budget,
        lengths=problem.lengths,
    )
    trace = drive(kind(), task, evaluate, rng, seconds)
    # the last one, whatever the status: a run that failed still recommends where it stood
    best: Array = cube.physical(trace.recommendations[-1])
    return best


def evenly(count: int, dim: int) -> Array:
    """(count, dim) starting points spread evenly over the unit cube, for who has no tuner begin."""
    return spread(count, np.full(dim, 0.5))
