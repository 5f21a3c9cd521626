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


def find_start_with_tuner(
    name: str, evaluator: RunEvaluator, noise: NoiseModel, seed: int
) -> Array:
    """Run a tuner, and return the base parameters (b,) that it recommends.

    Initial states are fixed at their guesses from the first samples.

    Args:
        name: name of the tuner.
        evaluator: the runs.
        noise: noise of each channel.
        seed: seed of the tuner's random numbers.

    Raises:
        InputError: the tuner does not exist, or must be trained first.
    """
    channels = evaluator.observed.shape[2]
    # A tuner accepts one table, so the runs are concatenated, all padded to the same length.
    observed = evaluator.observed.reshape(-1, channels)
    parameters = [evaluator.parameters[i] for i in evaluator.base_indices]
    problem = StandaloneProblem(
        parameters=parameters,
        start=evaluator.get_nominal_theta()[evaluator.base_indices],
        observed=observed,
        scale=noise.sigma,
        lengths=(evaluator.observed.shape[1],) * len(evaluator.prepared_runs),
        evaluate=lambda base: _evaluate_base(evaluator, noise, observed, base),
    )
    return run_tuner(
        name, problem, SIMULATION_BUDGET, TIME_LIMIT_SECONDS, make_rng("explain", name, seed)
    )


def _evaluate_base(
    evaluator: RunEvaluator,
    noise: NoiseModel,
    observed: Array,
    base: Array,
) -> tuple[Array, Array]:
    """Simulate base parameters, and compute their losses.

    The loss is the root mean square of scaled residuals, as in a comparison; it is infinite if the
    simulation fails.

    Args:
        evaluator: the runs.
        noise: noise of each channel.
        observed: (T, C) observations of all runs, concatenated.
        base: (n, b) base parameters.

    Returns:
        Observations (n, T, C) and losses (n,).
    """
    count = len(base)
    runs = len(evaluator.prepared_runs)
    # No effect is active, because the coefficients after the base parameters are zero.
    theta = np.tile(evaluator.get_nominal_theta(), (count, 1))
    theta[:, evaluator.base_indices] = base
    simulated = evaluator.simulate(
        np.repeat(theta, runs, axis=0),
        np.tile(np.arange(runs), count),
        np.tile(evaluator.initial_state_guesses, (count, 1)),
    ).reshape(count, -1, observed.shape[1])

    residuals = np.where(np.isfinite(observed), simulated - observed, 0.0)
    # An abandoned simulation is NaN, which is expected here.
    with np.errstate(invalid="ignore"):
        squares = np.square(residuals / noise.sigma)
        losses = np.sqrt(squares.mean(axis=(1, 2)))
    return simulated, np.where(np.isfinite(losses), losses, np.inf)
