"""Run a registered tuner on any simulation function, without an experiment.

Other parts of the project that only need good parameters use this. The rules of a comparison hold:
the tuner works in the unit cube, within a budget, and has the same information as for a target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.benchmark.runner.tuner_loop import Evaluate, drive_tuner
from bench.core.plugin_registries import tuners
from methods.learning.quasi_random_points import generate_quasi_random_points
from methods.tuner import Task
from sims.core.simulator import Array, InputError, Parameter
from sims.core.unit_cube import UnitCube


@dataclass(frozen=True)
class StandaloneProblem:
    """Problem to run a tuner on.

    Attributes:
        parameters: parameters to tune.
        start: (b,) starting point in physical units.
        observed: (T, C) observations of all runs in SI units, concatenated; NaN for missing
            samples.
        scale: (C,) scale of the residuals of each channel.
        lengths: number of samples of each run; their sum is T.
        evaluate: function of physical parameters (n, b) that returns observations (n, T, C) and
            losses (n,).
    """

    parameters: Sequence[Parameter]
    start: Array
    observed: Array
    scale: Array
    lengths: tuple[int, ...]
    evaluate: Evaluate


def run_tuner(
    name: str, problem: StandaloneProblem, budget: int, seconds: float, rng: np.random.Generator
) -> Array:
    """Run a registered tuner on a problem, and return the parameters that it recommends at the end.

    Args:
        name: name of the tuner, which runs with its default options.
        problem: problem to run it on.
        budget: maximum number of simulations.
        seconds: time limit, checked between evaluations.
        rng: random generator of the run.

    Returns:
        (b,) parameters in physical units.

    Raises:
        InputError: there is no such tuner, or it must be trained first.
    """
    tuner_class = tuners.get(name)
    # There is no experiment that defines the training.
    if tuner_class.learned:
        raise InputError(
            f"tuner {name} must be trained first; expected one that searches, such as least_squares"
        )
    cube = UnitCube(problem.parameters)

    def evaluate(points: Array) -> tuple[Array, Array]:
        return problem.evaluate(cube.to_physical(points))

    task = Task(
        dim=cube.dim,
        start=cube.to_unit_cube(problem.start),
        observed=problem.observed,
        scale=problem.scale,
        training=cube.training,
        budget=budget,
        lengths=problem.lengths,
    )
    trace = drive_tuner(tuner_class(), task, evaluate, rng, seconds)
    # Even a failed run recommends its last point, so the status is not checked.
    best: Array = cube.to_physical(trace.recommendations[-1])
    return best


def spread_start_points(count: int, dim: int) -> Array:
    """Return quasi-random starting points, which cover the unit cube evenly.

    Args:
        count: number of points.
        dim: number of parameters.

    Returns:
        (count, dim) points.
    """
    # A fixed shift of the sequence instead of a random one gives the same points in each call.
    return generate_quasi_random_points(count, np.full(dim, 0.5))
