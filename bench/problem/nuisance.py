"""Training over effects that the world may have and the simulator lacks: domain randomisation, J.
Tobin et al., IROS 2017, arXiv 1703.06907; of dynamics X. B. Peng et al., ICRA 2018, arXiv
1710.06537.

Every training simulation draws coefficients of its own, so that a network has to find what follows
the parameters whatever these effects do. Half of the simulations have none of them: when it tunes,
the network compares a target that may have some with simulations that never do.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from bench.problem.experiment import Experiment
from bench.problem.robots import kind_of
from sims import effects as library
from sims.base import Array, Channel, InputError, Scenario, Simulator, UnitCube

ABSENT = 0.5
"""Share of the training simulations without any of the effects."""


class Randomised(Protocol):
    """What is trained on, as `bench.problem.problem.Problem` is.

    Attributes:
        experiment: has the effects and their ranges.
        simulator: the one that is tuned.
        cube: between bounds and unit cube.
        channels: observed, in order.
        simulated: simulations made so far.
    """

    experiment: Experiment
    simulator: Simulator
    cube: UnitCube
    channels: tuple[Channel, ...]
    simulated: int


class Nuisance:
    """The simulator of a problem with further effects, whose coefficients are drawn; those that it
    has already with a fixed coefficient are left as they are.

    Args:
        problem: what is trained on.

    Raises:
        InputError: an effect that the simulator cannot have, or that is tuned.
    """

    def __init__(self, problem: Randomised) -> None:
        self._problem = problem
        experiment = problem.experiment
        ranges = dict(experiment.nuisance)
        settings: dict[str, Any] = dict(experiment.settings)
        # what it was extended with is known, and acts as it is
        known = settings.get("fixed", {})
        ranges = {name: ends for name, ends in ranges.items() if _effect(name) not in known}
        names = list(dict.fromkeys(_effect(name) for name in ranges))
        settings["effects"] = [*settings.get("effects", ()), *names]
        observe = [channel.name for channel in problem.channels]
        who = f"experiment {experiment.name}: nuisance"
        try:
            self._simulator = kind_of(experiment)(
                constants=experiment.fixed, observe=observe, **settings
            )
        except (InputError, TypeError) as error:
            raise InputError(f"{who}: {error}") from None
        tuned = len(problem.simulator.parameters)
        self._ranges = _in_order(who, self._simulator, tuned, ranges)

    def simulate(
        self, rng: np.random.Generator, points: Array, scenarios: tuple[Scenario, ...]
    ) -> Array:
        """Observations (n, T, C) of unit-cube points (n, dim), each with effects drawn by `rng`."""
        self._problem.simulated += len(points)
        coefficients = self.drawn(rng, len(points))
        theta = np.concatenate([self._problem.cube.physical(points), coefficients], axis=1)
        return np.concatenate([self._simulator.simulate(theta, s) for s in scenarios], axis=1)

    def drawn(self, rng: np.random.Generator, count: int) -> Array:
        """(count, coefficients) uniform in their ranges; rows of zeros for a share of `ABSENT`."""
        low, high = self._ranges
        drawn = rng.uniform(low, high, size=(count, len(low)))
        there = rng.random((count, 1)) >= ABSENT
        coefficients: Array = np.where(there, drawn, 0.0)
        return coefficients

    def close(self) -> None:
        """Give back what the simulator holds."""
        self._simulator.close()


def _effect(name: str) -> str:
    """The effect of a coefficient, which is called after it or is one of several."""
    whole, several = name.partition("@")[0], name.rpartition(".")[0]
    return several if whole not in library.names() and several in library.names() else name


def _in_order(
    who: str, simulator: Simulator, tuned: int, ranges: Mapping[str, tuple[float, float]]
) -> tuple[Array, Array]:
    """Lower and upper ends in the simulator's order; what no range is given for stays zero."""
    names = [parameter.name for parameter in simulator.parameters[tuned:]]
    for name in ranges:
        if name not in names:
            raise InputError(f"{who}: expected one of {', '.join(names)}, found {name}")
    ends = np.array([ranges.get(name, (0.0, 0.0)) for name in names]).reshape(-1, 2)
    return ends[:, 0], ends[:, 1]
