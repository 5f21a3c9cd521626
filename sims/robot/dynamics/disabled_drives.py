"""Steps in which actuators are switched off, and how they are switched off in a simulation.

An actuator that is off gets a force range from zero to zero. So its force is zero whatever its
kind, and MuJoCo's implicit integrators take no derivative of it, as for any force at a limit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Array, Scenario
from sims.robot.robot_model import RobotModel

Mask = NDArray[np.bool_]


FORCE_FIELDS = ("actuator_forcelimited", "actuator_forcerange")
"""Model fields that switch an actuator off: whether its force is limited, and its force range."""


SAMPLED_STEP_FRACTION = 0.5
"""Fraction of a step after which the on/off state of an actuator is sampled for the whole step."""


def compute_off_steps(robot: RobotModel, scenario: Scenario, step: float, steps: int) -> Mask:
    """Compute in which steps of a run each actuator is switched off.

    The on/off state is held from one sample of the recording to the next. A step has the state in
    its middle.

    Args:
        robot: robot with K actuators.
        scenario: run with T sample times; `off` has by actuator whether it is off, (T,), and
            `offset` is the delay of inputs against their time stamps, in seconds.
        step: step length in seconds.
        steps: number S of steps.

    Returns:
        (S, K) whether each of the K actuators is off.
    """
    off_steps = np.zeros((steps, len(robot.actuators)), dtype=bool)
    if not scenario.off:
        return off_steps
    stamps = scenario.times - scenario.times[0] + scenario.offset
    middles = step * (np.arange(float(steps)) + SAMPLED_STEP_FRACTION)
    # Index (S,) of the last sample before the middle of each step.
    sample_indices = np.clip(np.searchsorted(stamps, middles, side="right") - 1, 0, stamps.size - 1)
    for name, off in scenario.off.items():
        off_steps[:, robot.actuator(name).id] = off[sample_indices]
    return off_steps


def iterate_constant_stretches(off: Mask) -> Iterator[slice]:
    """Yield the slices of steps within which no element of an on/off mask (n, S, K) changes."""
    changes = np.flatnonzero((off[:, 1:] != off[:, :-1]).any(axis=(0, 2))) + 1
    edges = [0, *changes.tolist(), off.shape[1]]
    for first, end in pairwise(edges):
        yield slice(first, end)


class ForceRanges:
    """Actuator force ranges of batch elements, which can be set to zero to switch actuators off.

    Args:
        fields: model fields of the batch elements by name; includes all of `FORCE_FIELDS`.
    """

    def __init__(self, fields: Mapping[str, Any]) -> None:
        self._limit_flags, self._force_ranges = (fields[name] for name in FORCE_FIELDS)
        self._values_when_on = self._limit_flags.copy(), self._force_ranges.copy()

    def write(self, off: Mask) -> None:
        """Switch actuators of the first n batch elements off where `off` (n, K) is true.

        All other ones of their K actuators are switched on: they get the force ranges that they had
        when this object was created.
        """
        limit_flags, force_ranges = self._values_when_on
        n = len(off)
        self._limit_flags[:n] = np.where(off, True, limit_flags[:n])
        self._force_ranges[:n] = np.where(off[..., None], 0.0, force_ranges[:n])

    def restore(self) -> None:
        """Switch all actuators on."""
        self._limit_flags[...], self._force_ranges[...] = self._values_when_on


def find_working_servos(robot: RobotModel, velocities: Any, off: Mask) -> Array:
    """Return 0 for joints whose position servo is switched off, and 1 for all others.

    The caller multiplies the stiffness of servos by it.

    Args:
        robot: robot with K actuators.
        velocities: (D,) addresses in `qvel` of the velocities of D joints.
        off: (..., K) whether each actuator is off.

    Returns:
        (..., D) zeros and ones.
    """
    column_of_address = {int(address): column for column, address in enumerate(velocities)}
    is_working = np.ones((*off.shape[:-1], len(column_of_address)))
    for actuator in robot.actuators:
        if actuator.kind == "position" and actuator.joint is not None:
            column = column_of_address[robot.joint(actuator.joint).velocity]
            is_working[..., column] *= ~off[..., actuator.id]
    return is_working
