"""Initial base parameters from a registered tuner, run as in a comparison of tuners."""

from __future__ import annotations

import numpy as np

from bench.benchmark.runner.standalone_tuning import StandaloneProblem, run_tuner
from bench.core.random_streams import make_rng
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.core.simulator import Array

SIMULATION_BUDGET = 60
"""Maximum number of simulations of all runs by the tuner."""
TIME_LIMIT_SECONDS = 300.0
"""Time limit of the tuner, in seconds."""


def find_start_with_tuner(name: str, world: RunEvaluator, noise: NoiseModel, seed: int) -> Array:
    """Run a tuner, and return the base parameters (b,) that it recommends.

    Initial states are fixed at their guesses from the first samples.

    Args:
        name: name of the tuner.
        world: the runs.
        noise: noise of each channel.
        seed: seed of the tuner's random numbers.

    Raises:
        InputError: the tuner does not exist, or must be trained first.
    """
    channels = world.observed.shape[2]
    # A tuner accepts one table, so the runs are concatenated, all padded to the same length.
    observed = world.observed.reshape(-1, channels)
    parameters = [world.parameters[i] for i in world.base]
    problem = StandaloneProblem(
        parameters=parameters,
        start=world.get_nominal_theta()[world.base],
        observed=observed,
        scale=noise.sigma,
        lengths=(world.observed.shape[1],) * len(world.tracks),
        evaluate=lambda base: _evaluated(world, noise, observed, base),
    )
    return run_tuner(
        name, problem, SIMULATION_BUDGET, TIME_LIMIT_SECONDS, make_rng("explain", name, seed)
    )


def _evaluated(
    world: RunEvaluator,
    noise: NoiseModel,
    observed: Array,
    base: Array,
) -> tuple[Array, Array]:
    """Simulate base parameters, and compute their losses.

    The loss is the root mean square of scaled residuals, as in a comparison; it is infinite if the
    simulation fails.

    Args:
        world: the runs.
        noise: noise of each channel.
        observed: (T, C) observations of all runs, concatenated.
        base: (n, b) base parameters.

    Returns:
        Observations (n, T, C) and losses (n,).
    """
    count = len(base)
    runs = len(world.tracks)
    # No effect is active, because the coefficients after the base parameters are zero.
    theta = np.tile(world.get_nominal_theta(), (count, 1))
    theta[:, world.base] = base
    simulated = world.simulate(
        np.repeat(theta, runs, axis=0),
        np.tile(np.arange(runs), count),
        np.tile(world.guess, (count, 1)),
    ).reshape(count, -1, observed.shape[1])

    residuals = np.where(np.isfinite(observed), simulated - observed, 0.0)
    # An abandoned simulation is NaN, which is expected here.
    with np.errstate(invalid="ignore"):
        squares = np.square(residuals / noise.sigma)
        losses = np.sqrt(squares.mean(axis=(1, 2)))
    return simulated, np.where(np.isfinite(losses), losses, np.inf)
