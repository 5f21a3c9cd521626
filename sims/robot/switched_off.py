"""Drives that are switched off: their actuators exert nothing in these steps.

An actuator that is off has a force range from zero to zero. So MuJoCo makes its force zero whatever
its kind, and its implicit integrators take no derivative of it, as of any force at a limit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sims.base import Array, Scenario
from sims.robot.model import Robot

Mask = NDArray[np.bool_]

FORCE_FIELDS = ("actuator_forcelimited", "actuator_forcerange")
"""Fields of a model that are written."""
MIDDLE = 0.5
"""Place within a step at which it is decided whether a drive is off."""


def off_steps(robot: Robot, scenario: Scenario, step: float, steps: int) -> Mask:
    """Return (S, K) in which steps of a run each actuator is off; held from sample to sample."""
    result = np.zeros((steps, len(robot.actuators)), dtype=bool)
    if not scenario.off:
        return result
    stamps = scenario.times - scenario.times[0] + scenario.offset
    middles = step * (np.arange(float(steps)) + MIDDLE)
    rows = np.clip(np.searchsorted(stamps, middles, side="right") - 1, 0, stamps.size - 1)
    for name, off in scenario.off.items():
        result[:, robot.actuator(name).id] = off[rows]
    return result


def constant_stretches(off: Mask) -> Iterator[slice]:
    """Yield stretches of steps in which no lane of (n, S, K) changes."""
    changes = np.flatnonzero((off[:, 1:] != off[:, :-1]).any(axis=(0, 2))) + 1
    edges = [0, *changes.tolist(), off.shape[1]]
    for first, end in pairwise(edges):
        yield slice(first, end)


class ForceRanges:
    """The force ranges of lanes' actuators, as they are loaded, and zero for those that are off.

    Args:
        fields: of the lanes' models, by name.
    """

    def __init__(self, fields: Mapping[str, Any]) -> None:
        self._limited, self._range = (fields[name] for name in FORCE_FIELDS)
        self._own = self._limited.copy(), self._range.copy()

    def write(self, off: Mask) -> None:
        """Switch actuators of the first n lanes on and off, (n, K)."""
        limited, limits = self._own
        n = len(off)
        self._limited[:n] = np.where(off, True, limited[:n])
        self._range[:n] = np.where(off[..., None], 0.0, limits[:n])

    def restore(self) -> None:
        """Switch all actuators on."""
        self._limited[...], self._range[...] = self._own


def working_servos(robot: Robot, velocities: Any, off: Mask) -> Array:
    """Return 0 where the position servo of a coordinate is off, and 1 elsewhere.

    Args:
        robot: whose.
        velocities: (D,) addresses of the coordinates' velocities.
        off: (..., K) which actuators are off.
    """
    columns = {int(place): i for i, place in enumerate(velocities)}
    result = np.ones((*off.shape[:-1], len(columns)))
    for actuator in robot.actuators:
        if actuator.kind == "position" and actuator.joint is not None:
            column = columns[robot.joint(actuator.joint).velocity]
            result[..., column] = np.where(off[..., actuator.id], 0.0, result[..., column])
    return result
