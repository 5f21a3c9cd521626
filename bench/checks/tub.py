"""The system that effects on levels are checked on, where no registered one has a level: a tub that
fills by a tap and drains in proportion to its level.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from sims.base import Channel, Parameter
from sims.own import OwnSimulator


class Tub(OwnSimulator):
    """A tub with a tap and a drain, stepped exactly."""

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
        """Start at a level."""
        self.drain, self.level = theta["drain"], initial["level"]

    def step(self, inputs: Mapping[str, float], seconds: float) -> None:
        """Go towards the level at which as much comes in as flows out."""
        end = inputs["tap"] / self.drain
        self.level = end + (self.level - end) * math.exp(-self.drain * seconds)

    def observe(self) -> dict[str, float]:
        """The level."""
        return {"level": self.level}

    def put(self, levels: Mapping[str, float]) -> None:
        """Another level."""
        self.level = levels["level"]
