"""The number of the model file that a coefficient changes: what the file states, and the total with
the coefficient in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sims.robot.model import Robot
from sims.robot.native import FIELDS
from sims.robot.stated import Fields, fields
from sims.system import Effect


class Total(NamedTuple):
    """A number of the model file before and after, and its unit."""

    stated: float
    total: float
    unit: str


Read = Callable[[Fields, Robot, str], Sequence[float]]
"""The numbers that an effect's coefficients change, in their order: of the fields, at a place."""


def _joint(field: str, *index: int) -> Read:
    return lambda f, r, place: [f[field][(0, r.joint(place).velocity, *index)]]


def _spring(field: str, *index: int) -> Read:
    return lambda f, r, place: [f[field][(0, r.joint(place).id, *index)]]


def _servo(term: int) -> Read:
    return lambda f, r, place: [-f["actuator_biasprm"][0, r.actuator(place).id, term]]


def _strength(f: Fields, robot: Robot, place: str) -> Sequence[float]:  # noqa: ARG001
    """Gravity along the direction that the file states."""
    stated = robot.compiled.opt.gravity
    return [float(f["opt.gravity"][0] @ stated / max(np.linalg.norm(stated), 1e-300))]


def _limit(f: Fields, robot: Robot, place: str) -> Sequence[float]:
    number = robot.actuator(place).id
    limited = f["actuator_forcelimited"][0, number]
    return [f["actuator_forcerange"][0, number, 1]] if limited else [np.inf]


class Reading(NamedTuple):
    """How a total is read, and its units on a hinge and on a slide; empty for the coefficient's."""

    read: Read
    hinge: str = ""
    slide: str = ""


_TOTALS: Mapping[str, Reading] = {
    "drag.linear": Reading(_joint("dof_damping")),
    "drag.quadratic": Reading(_joint("dof_dampingpoly", 0)),
    "friction.coulomb": Reading(_joint("dof_frictionloss")),
    "inertia.armature": Reading(_joint("dof_armature")),
    "spring.linear": Reading(_spring("jnt_stiffness")),
    "spring.cubic": Reading(_spring("jnt_stiffnesspoly", 1)),
    "actuator.limit": Reading(_limit),
    "actuator.stiffness": Reading(_servo(1), "N*m/rad", "N/m"),
    "actuator.damping": Reading(_servo(2), "N*m*s/rad", "N*s/m"),
    "mass.scale": Reading(lambda f, r, place: [f["body_mass"][0, r.body(place).id]], "kg"),
    "mass.offset": Reading(lambda f, r, place: f["body_ipos"][0, r.body(place).id]),
    # Of three principal moments the largest.
    "inertia.scale": Reading(
        lambda f, r, place: [np.max(f["body_inertia"][0, r.body(place).id])], "kg*m^2"
    ),
    "gravity.scale": Reading(_strength, "m/s^2"),
    "gravity.tilt": Reading(lambda f, *_: f["opt.gravity"][0, :2], "m/s^2"),
}


def totals(robot: Robot, effect: type[Effect], values: Sequence[float]) -> list[Total | None]:
    """Return what becomes of the numbers of the model file, by coefficient of an effect at one
    place; None where the file states no such number.

    Args:
        robot: the robot of the model file.
        effect: at a joint, an actuator, a body, or one of the world's.
        values: its coefficients.
    """
    name = effect.of or effect.name
    if name not in _TOTALS:
        return [None] * len(values)
    reading = _TOTALS[name]
    now: Any = fields(robot.compiled)
    stated = np.array(reading.read(now, robot, effect.place), dtype=float)
    FIELDS[name].write(now, robot, effect.place, np.array(values, dtype=float)[:, None])
    after = np.array(reading.read(now, robot, effect.place), dtype=float)
    found: list[Total | None] = []
    for c, before, total in zip(effect.coefficients, stated, after, strict=True):
        unit = (reading.slide if _slides(robot, effect) else "") or reading.hinge or c.units[0]
        known = np.isfinite([before, total]).all()
        found.append(Total(float(before), float(total), unit or "1") if known else None)
    return found


def _slides(robot: Robot, effect: type[Effect]) -> bool:
    """Whether an effect acts at an actuator of a joint that slides."""
    if effect.at != "actuator":
        return False
    joint = robot.actuator(effect.place).joint
    return joint is not None and robot.joint(joint).kind == "slide"
