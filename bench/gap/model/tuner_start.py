"""Lets a registered tuner find where the fit of the base model begins: the same contract as in a
comparison.
"""

from __future__ import annotations

import numpy as np

from bench.gap.model.noise import Noise
from bench.gap.model.world import World
from bench.problem.seeds import rng_for
from bench.runs.standalone import Standalone, recommended
from sims.base import Array

BUDGET = 60
"""Simulations of all runs that the tuner may use."""
SECONDS = 300.0
"""Time after which the tuner is stopped, seconds."""


def tuned(name: str, world: World, noise: Noise, seed: int) -> Array:
    """Base parameters (b,) that a tuner recommends, initial states as guessed from the first
    samples.

    Raises:
        InputError: no such tuner, or one that must be trained first.
    """
    channels = world.observed.shape[2]
    # a tuner knows one table: the runs follow one another, all of them padded to one length
    observed = world.observed.reshape(-1, channels)
    parameters = [world.parameters[i] for i in world.base]
    problem = Standalone(
        parameters=parameters,
        start=world.nominal()[world.base],
        observed=observed,
        scale=noise.sigma,
        lengths=(world.observed.shape[1],) * len(world.tracks),
        evaluate=lambda base: _evaluated(world, noise, observed, base),
    )
    return recommended(name, problem, BUDGET, SECONDS, rng_for("explain", name, seed))


def _evaluated(
    world: World,
    noise: Noise,
    observed: Array,
    base: Array,
) -> tuple[Array, Array]:
    """Observations (n, T, C) of base parameters (n, b), and their losses (n,).

    The loss is the root mean square of scaled residuals, as in a comparison; what cannot be
    simulated is infinitely far.
    """
    count = len(base)
    runs = len(world.tracks)
    # no effect acts: the coefficients behind the base parameters are zero
    theta = np.tile(world.nominal(), (count, 1))
    theta[:, world.base] = base
    simulated = world.simulate(
        np.repeat(theta, runs, axis=0),
        np.tile(np.arange(runs), count),
        np.tile(world.guess, (count, 1)),
    ).reshape(count, -1, observed.shape[1])

    residuals = np.where(np.isfinite(observed), simulated - observed, 0.0)
    # a lane that was given up is NaN, which is no news here
    with np.errstate(invalid="ignore"):
        squares = np.square(residuals / noise.sigma)
        losses = np.sqrt(squares.mean(axis=(1, 2)))
    return simulated, np.where(np.isfinite(losses), losses, np.inf)
