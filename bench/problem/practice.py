"""Where learned tuners train: the simulator, counted and fenced to the training range."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from methods.base import BudgetExceededError, Scene
from sims.base import Array, Scenario, UnitCube

_SLACK = 1e-9
"""How far outside the training range a point may lie, unit cube: a sum that rounds is no breach."""


class Ground(Protocol):
    """What is practised on, as `bench.problem.problem.Problem` is.

    Attributes:
        cube: between bounds and unit cube.
        scale: (C,) what a residual is divided by.
    """

    cube: UnitCube
    scale: Array

    def scenarios(self, rng: np.random.Generator) -> tuple[Scenario, ...]:
        """Those of one target."""

    def scene(self, scenarios: Sequence[Scenario]) -> Scene:
        """What tuners are told of them."""

    def simulate(self, points: Array, scenarios: tuple[Scenario, ...]) -> Array:
        """Observations (n, T, C) of points (n, dim) of the unit cube."""


class Disturbed(Protocol):
    """Simulates with what the simulator may lack, as `bench.problem.nuisance.Nuisance` does."""

    def simulate(
        self, rng: np.random.Generator, points: Array, scenarios: tuple[Scenario, ...]
    ) -> Array:
        """Observations (n, T, C) of points (n, dim) of the unit cube."""


class Practice:
    """The practice ground of learned tuners; see `methods.base.Practice`.

    Args:
        problem: what is practised on.
        budget: simulations allowed.
        nuisance: simulates in its place, for training over effects that the world may have.
    """

    def __init__(self, problem: Ground, budget: int, nuisance: Disturbed | None = None) -> None:
        self._problem = problem
        self._nuisance = nuisance
        self.dim = problem.cube.dim
        self.training = problem.cube.training
        self.scale = problem.scale
        self.used = 0
        self.budget = budget
        # Any scenario tells how many samples and which numbers there will be.
        scenarios = problem.scenarios(np.random.default_rng(0))
        self.lengths = tuple(scenario.times.size for scenario in scenarios)
        self.scene = problem.scene(scenarios)

    def sample(self, rng: np.random.Generator, n: int) -> Array:
        """(n, dim) parameters drawn uniformly from the training range, unit cube."""
        return rng.uniform(self.training[0], self.training[1], size=(n, self.dim))

    def simulate(self, rng: np.random.Generator, points: Array) -> Array:
        """Observations (n, T, C) of `points` (n, dim), all in one scenario drawn by `rng`; told by
        `scene`.
        """
        points = np.asarray(points, dtype=np.float64)
        low, high = self.training
        if not ((points >= low - _SLACK) & (points <= high + _SLACK)).all():
            raise ValueError(
                "a learned tuner may only simulate inside the training range while it trains"
            )
        # Refused whole: a tuner that asks for too much would else learn from part of it.
        asked = self.used + len(points)
        if asked > self.budget:
            raise BudgetExceededError(f"{asked} training simulations asked, {self.budget} allowed")
        self.used = asked
        scenarios = self._problem.scenarios(rng)
        self.scene = self._problem.scene(scenarios)
        if self._nuisance is not None:
            return self._nuisance.simulate(rng, points, scenarios)
        return self._problem.simulate(points, scenarios)
