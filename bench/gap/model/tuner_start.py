"""Lets a registered tuner find where the fit of the base model begins: the same contract as in a
comparison.
"""

from __future__ import annotations

import numpy as np

from bench.gap.model.noise import Noise
from bench.gap.model.world import World
from bench.problem.seeds import rng_for
from bench.registry import tuners
from bench.runs.drive import drive
from methods.base import Task
from sims.base import Array, InputError, UnitCube

BUDGET, SECONDS = 60, 300.0


def tuned(name: str, world: World, noise: Noise, seed: int) -> Array:
    """Base parameters (b,) that a tuner recommends, initial states as guessed from the first
    samples.

    Raises:
        InputError: no such tuner, or one that must be trained first.
    """
    kind = tuners.get(name)
    if kind.learned:
        raise InputError(
            f"tuner {name} must be trained first; expected one that searches, such as least_squares"
        )
    cube = UnitCube([world.parameters[i] for i in world.base])
    runs = np.arange(len(world.tracks))
    seen = np.isfinite(world.observed)

    def evaluate(points: Array) -> tuple[Array, Array]:
        theta = np.tile(world.nominal(), (len(points), 1))
        theta[:, world.base] = cube.physical(points)
        lanes = world.simulate(
            np.repeat(theta, len(runs), axis=0),
            np.tile(runs, len(points)),
            np.tile(world.guess, (len(points), 1)),
        )
        shown = lanes.reshape(len(points), -1, world.observed.shape[2])
        left = np.where(
            seen.reshape(shown.shape[1:]), shown - world.observed.reshape(shown.shape[1:]), 0.0
        )
        with np.errstate(invalid="ignore"):
            losses = np.sqrt(np.square(left / noise.sigma).mean(axis=(1, 2)))
        return shown, np.where(np.isfinite(losses), losses, np.inf)

    observed = world.observed.reshape(-1, world.observed.shape[2])
    task = Task(
        dim=cube.dim,
        start=cube.inverse(world.nominal()[world.base]),
        observed=observed,
        scale=noise.sigma,
        training=cube.training,
        budget=BUDGET,
        lengths=(world.observed.shape[1],) * len(runs),
    )
    trace = drive(kind(), task, evaluate, rng_for("explain", name, seed), SECONDS)
    best: Array = cube.physical(trace.recommendations[-1])
    return best
