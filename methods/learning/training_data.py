"""Training data of learned tuners: simulations at random parameters in several scenarios."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from methods.tuner import Array, ScenarioInfo, TrainingSimulator

_MIN_SCENARIOS = 2
"""Minimum number of scenarios; one alone gives no information about their differences."""


class TrainingData(NamedTuple):
    """Training simulations: several in each scenario.

    Attributes:
        parameters: (scenarios, each, dim) parameters in the unit cube.
        observations: (scenarios, each, T, C) observations in SI units.
        lengths: number of samples of each run.
        scenes: scenario information of each scenario.
        noise_free_observations: the data before noise was added; None if no noise was added.
    """

    parameters: Array
    observations: Array
    lengths: tuple[int, ...]
    scenes: tuple[ScenarioInfo, ...]
    noise_free_observations: TrainingData | None = None

    @property
    def without_noise(self) -> TrainingData:
        """Training data without noise."""
        return self if self.noise_free_observations is None else self.noise_free_observations

    @property
    def flattened_observations(self) -> Array:
        """All observations (scenarios * each, T, C), concatenated over scenarios."""
        return self.observations.reshape(-1, *self.observations.shape[2:])

    def with_noise(self, noise: Array, rng: np.random.Generator) -> TrainingData:
        """Return the data with white noise added.

        Args:
            noise: (C,) standard deviations of the noise.
            rng: random generator.
        """
        errors = noise * rng.standard_normal(self.observations.shape)
        # Noise-free data are kept for the proposed side of a network, which reads simulations.
        return self._replace(
            observations=self.observations + errors, noise_free_observations=self.without_noise
        )


class TrainingBudgetTooSmallError(ValueError):
    """The training budget is too small for the tuner."""


def draw_uniform_points(
    simulator: TrainingSimulator, rng: np.random.Generator, count: int
) -> Array:
    """Draw points (count, dim) uniformly from the training range.

    Args:
        simulator: training simulator.
        rng: random generator.
        count: number of points.
    """
    return simulator.sample(rng, count)


def generate_training_data(
    simulator: TrainingSimulator,
    rng: np.random.Generator,
    budget: int,
    scenarios: int,
    each: int,
    draw_parameters: Callable[
        [TrainingSimulator, np.random.Generator, int], Array
    ] = draw_uniform_points,
) -> TrainingData:
    """Simulate several points in each of several scenarios; fewer scenarios for a small budget.

    A scenario is a drawn set of initial values and inputs. It is left out if a simulation in it
    fails.

    Args:
        simulator: training simulator.
        rng: random generator.
        budget: maximum number of simulations.
        scenarios: maximum number of scenarios.
        each: number of points in each scenario.
        draw_parameters: function that draws the points of a scenario.

    Raises:
        TrainingBudgetTooSmallError: the budget is smaller than two scenarios.
        ValueError: fewer than two scenarios could be simulated.
    """
    # Only complete scenarios are simulated, because pairs are formed within a scenario.
    count = min(scenarios, budget // each)
    if count < _MIN_SCENARIOS:
        raise TrainingBudgetTooSmallError(
            f"{budget} training simulations are fewer than two scenarios of {each} need"
        )
    parameters = []
    observations = []
    scenes = []
    for _ in range(count):
        points = draw_parameters(simulator, rng, each)
        simulated = simulator.simulate(rng, points)
        # All scenarios need the same number of points.
        if np.isfinite(simulated).all():
            parameters.append(points)
            observations.append(simulated)
            scenes.append(simulator.scene)
    if len(parameters) < _MIN_SCENARIOS:
        raise ValueError(
            f"of {count} training scenarios, {len(parameters)} could be simulated; "
            f"at least {_MIN_SCENARIOS} are needed"
        )
    lengths = tuple(simulator.lengths)
    return TrainingData(np.array(parameters), np.array(observations), lengths, tuple(scenes))
