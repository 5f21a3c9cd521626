"""Training simulator of learned tuners: counted, and limited to the training range."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from methods.tuner import BudgetExceededError, ScenarioInfo
from sims.core.simulator import Array, Scenario, UnitCube

_RANGE_TOLERANCE = 1e-9
"""Tolerance for points outside the training range, in the unit cube, because of rounding."""


class TrainingProblem(Protocol):
    """Problem that a tuner trains on, as `bench.benchmark.problem.tuning_problem.TuningProblem` is.

    Attributes:
        cube: map between bounds and unit cube.
        scale: (C,) scale of the residuals of each channel.
    """

    cube: UnitCube
    scale: Array

    def draw_scenarios(self, rng: np.random.Generator) -> tuple[Scenario, ...]:
        """Draw the scenarios of one target."""

    def describe_scenarios(self, scenarios: Sequence[Scenario]) -> ScenarioInfo:
        """Return the scenario information that tuners get."""

    def simulate(self, points: Array, scenarios: tuple[Scenario, ...]) -> Array:
        """Simulate points of the unit cube.

        Args:
            points: (n, dim) points of the unit cube.
            scenarios: runs to simulate.

        Returns:
            Observations (n, T, C).
        """


class RandomisedSimulation(Protocol):
    """Simulator with effects that the tuned one lacks, for example `RandomisedSimulator`."""

    def simulate(
        self, rng: np.random.Generator, points: Array, scenarios: tuple[Scenario, ...]
    ) -> Array:
        """Simulate points of the unit cube with random effects.

        Args:
            rng: random generator of the effects.
            points: (n, dim) points of the unit cube.
            scenarios: runs to simulate.

        Returns:
            Observations (n, T, C).
        """


class CountedTrainingSimulator:
    """Training simulator of learned tuners; see `methods.tuner.TrainingSimulator`.

    Args:
        problem: problem to train on.
        budget: number of simulations allowed.
        nuisance: simulator with random effects that is used instead; None for the problem's own.
    """

    def __init__(
        self, problem: TrainingProblem, budget: int, nuisance: RandomisedSimulation | None = None
    ) -> None:
        """Store the sizes that a tuner may know before its first simulation.

        `dim` is the number of parameters, `training` (2, dim) the training range in the unit cube,
        `scale` (C,) the scale of each channel, `lengths` the number of samples of each scenario.
        """
        self._problem = problem
        self._nuisance = nuisance
        self.dim = problem.cube.dim
        self.training = problem.cube.training
        self.scale = problem.scale
        self.used = 0
        self.budget = budget
        # All scenarios have the same number of samples and inputs, so any scenario gives the sizes.
        scenarios = problem.draw_scenarios(np.random.default_rng(0))
        self.lengths = tuple(scenario.times.size for scenario in scenarios)
        self.scene = problem.describe_scenarios(scenarios)

    def sample(self, rng: np.random.Generator, n: int) -> Array:
        """Draw parameters uniformly from the training range.

        Args:
            rng: random generator.
            n: number of points.

        Returns:
            (n, dim) points of the unit cube.
        """
        return rng.uniform(self.training[0], self.training[1], size=(n, self.dim))

    def simulate(self, rng: np.random.Generator, points: Array) -> Array:
        """Simulate points, all in one scenario drawn at random; `scene` then describes it.

        Args:
            rng: random generator.
            points: (n, dim) points of the unit cube.

        Returns:
            Observations (n, T, C).

        Raises:
            ValueError: a point is outside the training range.
            BudgetExceededError: more simulations are requested than the budget allows.
        """
        points = np.asarray(points, dtype=np.float64)
        low, high = self.training
        if not ((points >= low - _RANGE_TOLERANCE) & (points <= high + _RANGE_TOLERANCE)).all():
            raise ValueError(
                "a learned tuner may only simulate inside the training range while it trains"
            )
        # The whole request is refused; otherwise the tuner would learn from a part of it.
        requested_total = self.used + len(points)
        if requested_total > self.budget:
            raise BudgetExceededError(
                f"{requested_total} training simulations requested, {self.budget} allowed"
            )
        self.used = requested_total
        scenarios = self._problem.draw_scenarios(rng)
        self.scene = self._problem.describe_scenarios(scenarios)
        if self._nuisance is not None:
            return self._nuisance.simulate(rng, points, scenarios)
        return self._problem.simulate(points, scenarios)
