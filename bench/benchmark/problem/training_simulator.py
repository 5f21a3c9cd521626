"""Training simulator of learned tuners: counted, limited in range, with domain randomisation.

Domain randomisation: J. Tobin et al., IROS 2017, arXiv 1703.06907; of dynamics X. B. Peng
et al., ICRA 2018, arXiv 1710.06537.

Every training simulation draws its own coefficients, so that a network must find features that
depend on the parameters but not on these effects. Half of the simulations have no such effects,
because during tuning the network compares a target that may have some with simulations that never
have any.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bench.benchmark.problem.robot_experiment import get_simulator_class
from bench.benchmark.problem.tuning_problem import TuningProblem
from methods.tuner import BudgetExceededError
from sims import effects as library
from sims.core.simulator import Array, InputError, Scenario, Simulator

_RANGE_TOLERANCE = 1e-9
"""Tolerance for points outside the training range, in the unit cube, because of rounding."""


class CountedTrainingSimulator:
    """Training simulator of learned tuners; see `methods.tuner.TrainingSimulator`."""

    def __init__(
        self,
        problem: TuningProblem,
        budget: int,
        nuisance: RandomisedSimulator | None = None,
        check_request: Callable[[bytes], None] = lambda _: None,
    ) -> None:
        """Store the sizes that a tuner may know before its first simulation.

        `dim` is the number of parameters, `training` (2, dim) the training range in the unit cube,
        `scale` (C,) the scale of each channel, `lengths` the number of samples of each scenario.

        Args:
            problem: problem to train on.
            budget: number of simulations allowed.
            nuisance: simulator with random effects that is used instead; None for the problem's
                own.
            check_request: called with the state of the generator and the points of each request.
        """
        self._problem = problem
        self._check_request = check_request
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

        Shapes: T samples, C channels.

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
        self._check_request(repr(rng.bit_generator.state).encode() + points.tobytes())
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


NO_EFFECT_SHARE = 0.5
"""Share of the training simulations without any of the effects."""


class RandomisedSimulator:
    """Simulator of a problem with additional effects whose coefficients are drawn at random.

    An effect that the simulator already has with a fixed coefficient is not changed.

    Raises:
        InputError: the simulator cannot have an effect, or the effect is tuned.
    """

    def __init__(self, problem: TuningProblem) -> None:
        """Build the simulator with one more effect for every effect named in the [nuisance] table.

        This table of the experiment states the bounds from which each coefficient is drawn, by
        ``effect.coefficient``. The coefficients become parameters of the simulator after the tuned
        ones.

        Args:
            problem: problem that a tuner trains on.
        """
        self._problem = problem
        experiment = problem.experiment
        ranges = dict(experiment.nuisance)
        settings: dict[str, Any] = dict(experiment.settings)
        # Effects that the tuned simulator already has with fixed coefficients keep them.
        fixed_effects = settings.get("fixed", {})
        ranges = {
            name: limits
            for name, limits in ranges.items()
            if _get_effect_name(name) not in fixed_effects
        }
        names = list(dict.fromkeys(_get_effect_name(name) for name in ranges))
        settings["effects"] = [*settings.get("effects", ()), *names]
        observe = [channel.name for channel in problem.channels]
        location = f"experiment {experiment.name}: nuisance"
        try:
            self._simulator = get_simulator_class(experiment)(
                constants=experiment.fixed, observe=observe, **settings
            )
        except (InputError, TypeError) as error:
            raise InputError(f"{location}: {error}") from None
        tuned_count = len(problem.simulator.parameters)
        self._bounds = _order_bounds(location, self._simulator, tuned_count, ranges)

    def simulate(
        self, rng: np.random.Generator, points: Array, scenarios: tuple[Scenario, ...]
    ) -> Array:
        """Simulate points with effects whose coefficients are drawn at random.

        Shapes: T samples, C channels.

        Args:
            rng: random generator.
            points: (n, dim) points of the unit cube.
            scenarios: runs to simulate.

        Returns:
            Observations (n, T, C) with the samples of the scenarios concatenated.
        """
        self._problem.simulated += len(points)
        coefficients = self.draw_coefficients(rng, len(points))
        theta = np.concatenate([self._problem.cube.to_physical(points), coefficients], axis=1)
        return np.concatenate([self._simulator.simulate(theta, s) for s in scenarios], axis=1)

    def draw_coefficients(self, rng: np.random.Generator, count: int) -> Array:
        """Draw coefficients uniformly; a share of `NO_EFFECT_SHARE` of the rows is zero.

        Args:
            rng: random generator.
            count: number of rows.

        Returns:
            (count, coefficients) values.
        """
        low, high = self._bounds
        samples = rng.uniform(low, high, size=(count, len(low)))
        has_effect = rng.random((count, 1)) >= NO_EFFECT_SHARE
        coefficients: Array = np.where(has_effect, samples, 0.0)
        return coefficients

    def close(self) -> None:
        """Close the simulator."""
        self._simulator.close()


def _get_effect_name(name: str) -> str:
    """Return a coefficient's effect: the coefficient's name, or its part before the last dot."""
    effect_name, prefix = name.partition("@")[0], name.rpartition(".")[0]
    if effect_name not in library.list_names() and prefix in library.list_names():
        return prefix
    return name


def _order_bounds(
    location: str, simulator: Simulator, tuned_count: int, ranges: Mapping[str, tuple[float, float]]
) -> tuple[Array, Array]:
    """Return lower and upper bounds of random coefficients in the simulator's order.

    Args:
        location: entry of the experiment file, for messages.
        simulator: simulator whose parameters after the tuned ones are randomised.
        tuned_count: number of tuned parameters, which come first.
        ranges: lower and upper bound by name of the coefficient.

    Returns:
        Lower and upper bounds, each (coefficients,); both are zero for a coefficient that `ranges`
        does not name, which switches it off.

    Raises:
        InputError: a name is unknown.
    """
    names = [parameter.name for parameter in simulator.parameters[tuned_count:]]
    for name in ranges:
        if name not in names:
            raise InputError(f"{location}: expected one of {', '.join(names)}, found {name}")
    limits = np.array([ranges.get(name, (0.0, 0.0)) for name in names]).reshape(-1, 2)
    return limits[:, 0], limits[:, 1]
