"""First-order tank on which effects on levels are checked if no registered system has a level."""

from __future__ import annotations

import math
from collections.abc import Mapping

from sims.core.simulator import Channel, Parameter
from sims.own_simulator import OwnSimulator


class FirstOrderTank(OwnSimulator):
    """Tank with an inflow and a drain proportional to the level, integrated exactly."""

    name = "tub"
    parameters = (Parameter("drain", "1/s", 0.8, (0.1, 2.0)),)
    inputs = (Channel("tap", "m/s"),)
    channels = (Channel("level", "m"),)
    states = {"level": 0.5}  # noqa: RUF012
    levels = ("level",)
    time_step = 0.05

    def reset(
        self,
        theta: Mapping[str, float],
        constants: Mapping[str, float],  # noqa: ARG002
        initial: Mapping[str, float],
    ) -> None:
        """Start at a given level.

        Args:
            theta: parameters by name.
            constants: not used.
            initial: initial states by name.
        """
        self.drain, self.level = theta["drain"], initial["level"]

    def step(self, inputs: Mapping[str, float], seconds: float) -> None:
        """Advance the level; it approaches the value at which inflow and outflow are equal.

        Args:
            inputs: inputs by name.
            seconds: length of the step.
        """
        end = inputs["tap"] / self.drain
        self.level = end + (self.level - end) * math.exp(-self.drain * seconds)

    def observe(self) -> dict[str, float]:
        """Return the level."""
        return {"level": self.level}

    def put(self, levels: Mapping[str, float]) -> None:
        """Set the level."""
        self.level = levels["level"]
