"""Causes as explain states them, one by one: families become their members."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sims.base import Array
from sims.extended import Number

if TYPE_CHECKING:
    from sims.robot.model import Robot

FAMILY = "*"
"""The place of a family."""

_AXES: Mapping[str, tuple[str, ...]] = {
    "mass.offset": ("x", "y", "z"),
    "gravity.tilt": ("x", "y"),
}
"""Coefficients of effects that have several, in their order."""


COMPENSATED = 0.02
"""Share of its weight that a robot with compensated gravity still feels at most."""

GRAVITY_COMPENSATED = "gravity is compensated: the real robot or its controller carries its weight"
"""What is said of a correction of gravity that takes all of it away."""


def is_gravity_compensated(effect: str, numbers: Mapping[str, Number]) -> bool:
    """Whether a correction of gravity takes all of it away: the real robot, or its controller,
    carries its own weight.
    """
    return effect == "gravity.scale" and any(
        abs(1.0 + number.value) < COMPENSATED for number in numbers.values()
    )


@dataclass(frozen=True)
class Cause:
    """An effect at one place, with its numbers.

    Attributes:
        effect: its name, without the place.
        place: a joint, an actuator, a body or a channel; empty for the world's.
        numbers: by coefficient, without the place.
    """

    effect: str
    place: str
    numbers: Mapping[str, Number]

    @property
    def name(self) -> str:
        """``friction.coulomb@elbow``."""
        return f"{self.effect}@{self.place}" if self.place else self.effect

    @property
    def coefficients(self) -> Array:
        """(K,) its numbers in the effect's order; what is not stated is zero."""
        axes = _AXES.get(self.effect)
        if axes is None:
            return np.array([number.value for number in self.numbers.values()])
        zero = Number(0.0, "1", None, None)
        return np.array([self.numbers.get(axis, zero).value for axis in axes])

    def told(self, recording: str) -> str:
        """``friction.coulomb@elbow: 0.3 N*m (95 %: 0.28 to 0.32), fitted to log.csv``."""
        several = len(self.numbers) > 1
        numbers = [
            (f"{name} " if several else "") + _told(number) for name, number in self.numbers.items()
        ]
        fitted = f", fitted to {recording}" if recording else ""
        return f"{self.name}: {', '.join(numbers)}{fitted}"


def _told(number: Number) -> str:
    """``-0.05 N*m (95 %: -0.06 to -0.04), from 0.2 to 0.15 N*m``: the last part is the number that
    the file has before and after.
    """
    text = f"{number.value:.4g}{_unit(number.unit)}"
    if number.low is not None and number.high is not None:
        text += f" (95 %: {number.low:.4g} to {number.high:.4g})"
    if number.stated is not None and number.total is not None:
        unit = _unit(number.total_unit or number.unit)
        text += f", from {number.stated:.4g} to {number.total:.4g}{unit}"
    return text


def _unit(unit: str) -> str:
    return "" if unit == "1" else f" {unit}"


def one_by_one(robot: Robot, causes: Mapping[str, Mapping[str, Number]]) -> list[Cause]:
    """Every cause at one place.

    Args:
        robot: whose places a family has where its coefficients name none.
        causes: coefficients by ``effect@place``; those of a family are keyed
            ``coefficient@PLACE``, or without a place where they hold for all.
    """
    found = []
    for name, numbers in causes.items():
        effect, _, place = name.partition("@")
        if place == FAMILY:
            found += _members(robot, effect, numbers)
        else:
            found.append(Cause(effect, place, dict(numbers)))
    return found


def _members(robot: Robot, effect: str, numbers: Mapping[str, Number]) -> list[Cause]:
    """The members of a family."""
    by_place: dict[str, dict[str, Number]] = {}
    for key, number in numbers.items():
        coefficient, _, place = key.partition("@")
        places = [place] if place else _places(robot, effect)
        for one in places:
            by_place.setdefault(one, {})[coefficient] = number
    return [Cause(effect, place, own) for place, own in by_place.items()]


def _places(robot: Robot, effect: str) -> list[str]:
    """All places of an effect that has one number for all of them."""
    if effect.startswith("input."):
        return [actuator.name for actuator in robot.actuators if actuator.joint is not None]
    if effect.startswith("sensor."):
        return [FAMILY]
    return [joint.name for joint in robot.joints]
