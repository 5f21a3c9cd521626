"""Train with effects that the real system may have and the simulator lacks.

This is domain randomisation: J. Tobin et al., IROS 2017, arXiv 1703.06907; of dynamics X. B. Peng
et al., ICRA 2018, arXiv 1710.06537.

Every training simulation draws its own coefficients, so that a network must find features that
depend on the parameters but not on these effects. Half of the simulations have no such effects,
because during tuning the network compares a target that may have some with simulations that never
have any.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.problem.model_file_simulator import get_simulator_class
from sims import effects as library
from sims.core.simulator import Array, Channel, InputError, Scenario, Simulator, UnitCube

NO_EFFECT_SHARE = 0.5
"""Share of the training simulations without any of the effects."""


class RandomisableProblem(Protocol):
    """Problem that a tuner trains on, as `bench.benchmark.problem.tuning_problem.TuningProblem` is.

    Attributes:
        experiment: experiment with the effects and their ranges.
        simulator: simulator that is tuned.
        cube: map between bounds and unit cube.
        channels: observed channels, in order.
        simulated: number of simulations made so far.
    """

    experiment: Experiment
    simulator: Simulator
    cube: UnitCube
    channels: tuple[Channel, ...]
    simulated: int


class RandomisedSimulator:
    """Simulator of a problem with additional effects whose coefficients are drawn at random.

    An effect that the simulator already has with a fixed coefficient is not changed.

    Args:
        problem: problem that a tuner trains on.

    Raises:
        InputError: the simulator cannot have an effect, or the effect is tuned.
    """

    def __init__(self, problem: RandomisableProblem) -> None:
        """Build the simulator with one more effect for every effect named in the [nuisance] table.

        `ranges` are the bounds from which each coefficient is drawn, by ``effect.coefficient``. The
        coefficients become parameters of the simulator after the tuned ones.
        """
        self._problem = problem
        experiment = problem.experiment
        ranges = dict(experiment.nuisance)
        settings: dict[str, Any] = dict(experiment.settings)
        # The effects that the simulator was extended with are known, and keep their coefficients.
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
        tuned = len(problem.simulator.parameters)
        self._ranges = _order_bounds(location, self._simulator, tuned, ranges)

    def simulate(
        self, rng: np.random.Generator, points: Array, scenarios: tuple[Scenario, ...]
    ) -> Array:
        """Simulate points with effects whose coefficients are drawn at random.

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
        low, high = self._ranges
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
    return (
        prefix
        if effect_name not in library.list_names() and prefix in library.list_names()
        else name
    )


def _order_bounds(
    location: str, simulator: Simulator, tuned: int, ranges: Mapping[str, tuple[float, float]]
) -> tuple[Array, Array]:
    """Return lower and upper bounds in the simulator's order; zero for coefficients not named."""
    names = [parameter.name for parameter in simulator.parameters[tuned:]]
    for name in ranges:
        if name not in names:
            raise InputError(f"{location}: expected one of {', '.join(names)}, found {name}")
    limits = np.array([ranges.get(name, (0.0, 0.0)) for name in names]).reshape(-1, 2)
    return limits[:, 0], limits[:, 1]
