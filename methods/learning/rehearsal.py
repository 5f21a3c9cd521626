"""Training data of learned tuners: several simulations in each of many scenarios."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from methods.base import Array, Practice, Scene

_LEAST = 2
"""Minimum number of scenarios; one alone gives no information about their differences."""


class Rehearsal(NamedTuple):
    """Training simulations: several in each scenario.

    Attributes:
        parameters: (scenarios, each, dim) parameters in the unit cube.
        observations: (scenarios, each, T, C) observations in SI units.
        lengths: number of samples of each run.
        scenes: scenario information of each scenario.
        unspoilt: the data before noise was added; None if no noise was added.
    """

    parameters: Array
    observations: Array
    lengths: tuple[int, ...]
    scenes: tuple[Scene, ...]
    unspoilt: Rehearsal | None = None

    @property
    def pure(self) -> Rehearsal:
        """Training data without noise."""
        return self if self.unspoilt is None else self.unspoilt

    @property
    def flat(self) -> Array:
        """All observations (scenarios * each, T, C), concatenated over scenarios."""
        return self.observations.reshape(-1, *self.observations.shape[2:])

    def spoilt(self, noise: Array, rng: np.random.Generator) -> Rehearsal:
        """Return the data with white noise added.

        Args:
            noise: (C,) standard deviations of the noise.
            rng: random generator.
        """
        errors = noise * rng.standard_normal(self.observations.shape)
        # Noise-free data are kept for the proposed side of a network, which reads simulations.
        return self._replace(observations=self.observations + errors, unspoilt=self.pure)


class TooFewError(ValueError):
    """The training budget is too small for the tuner."""


def uniform(simulator: Practice, rng: np.random.Generator, count: int) -> Array:
    """Draw points (count, dim) uniformly from the training range.

    Args:
        simulator: training simulator.
        rng: random generator.
        count: number of points.
    """
    return simulator.sample(rng, count)


def rehearse(
    simulator: Practice,
    rng: np.random.Generator,
    budget: int,
    scenarios: int,
    each: int,
    drawn: Callable[[Practice, np.random.Generator, int], Array] = uniform,
) -> Rehearsal:
    """Simulate several points in each of several scenarios; fewer scenarios for a small budget.

    Args:
        simulator: training simulator.
        rng: random generator.
        budget: maximum number of simulations.
        scenarios: maximum number of scenarios.
        each: number of points in each scenario.
        drawn: function that draws the points of a scenario.

    Raises:
        TooFewError: the budget is smaller than two scenarios.
        ValueError: fewer than two scenarios could be simulated.
    """
    # Only complete scenarios are simulated, because pairs are formed within a scenario.
    count = min(scenarios, budget // each)
    if count < _LEAST:
        raise TooFewError(
            f"{budget} training simulations are fewer than two scenarios of {each} need"
        )
    parameters = []
    observations = []
    scenes = []
    for _ in range(count):
        points = drawn(simulator, rng, each)
        simulated = simulator.simulate(rng, points)
        # A scenario with a failed simulation is left out, because all need the same number of
        # points.
        if np.isfinite(simulated).all():
            parameters.append(points)
            observations.append(simulated)
            scenes.append(simulator.scene)
    if len(parameters) < _LEAST:
        raise ValueError(
            f"of {count} training scenarios, {len(parameters)} could be simulated; "
            f"at least {_LEAST} are needed"
        )
    lengths = tuple(simulator.lengths)
    return Rehearsal(np.array(parameters), np.array(observations), lengths, tuple(scenes))
