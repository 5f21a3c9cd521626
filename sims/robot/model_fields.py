"""Fields of MuJoCo's compiled model that store the numbers changed by effect coefficients.

`robot.model_field_effects` writes these fields, `export.model_file_totals` reads the numbers in
them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from sims.robot.model_field_effects import gain_pulls
from sims.robot.robot_model import RobotModel

Operation = Literal["abs", "add", "scale"]
"""Operation that applies a random number to a field: replace, add to, or multiply its number."""


@dataclass(frozen=True)
class ModelField:
    """An element of a field of mujoco.MjModel that holds a number of the model file.

    Attributes:
        name: name of the field, such as ``dof_damping``; ``opt.gravity`` for a field of the
            options.
        address: index of the element.
        sign: -1 if the field holds the negative of the number, such as the bias of a servo.
    """

    name: str
    address: tuple[int, ...]
    sign: int = 1


Find = Callable[[RobotModel, str], "list[list[ModelField]]"]
"""Function that finds the elements of each coefficient, by robot and place."""


def _make_dof_finder(name: str, *index: int) -> Find:
    return lambda robot, place: [[ModelField(name, (robot.joint(place).velocity, *index))]]


def _make_joint_finder(name: str, *index: int) -> Find:
    return lambda robot, place: [[ModelField(name, (robot.joint(place).id, *index))]]


def _make_body_finder(name: str) -> Find:
    return lambda robot, place: [[ModelField(name, (robot.body(place).id,))]]


def _find_mass_centre_fields(robot: RobotModel, place: str) -> list[list[ModelField]]:
    """Return the three fields of a body's centre of mass."""
    number = robot.body(place).id
    return [[ModelField("body_ipos", (number, axis))] for axis in range(3)]


def _make_servo_gain_finder(term: int) -> Find:
    """Return a finder of the fields that hold a gain of a servo.

    `term` is the index in the actuator's bias: 1 for the stiffness, 2 for the damping. The bias
    holds the negative gain. MuJoCo's gain field holds the same number where the control
    multiplies it.
    """

    def find(robot: RobotModel, place: str) -> list[list[ModelField]]:
        """Return the bias field with the servo's gain, and the gain field if it is the same."""
        number = robot.actuator(place).id
        servo_fields = [ModelField("actuator_biasprm", (number, term), -1)]
        if gain_pulls(robot, number, term):
            servo_fields.insert(0, ModelField("actuator_gainprm", (number, 0)))
        return [servo_fields]

    return find


def _force_range(robot: RobotModel, place: str) -> list[list[ModelField]]:
    """Return both ends of an actuator's force range, which one positive limit determines."""
    number = robot.actuator(place).id
    range_fields = [
        ModelField("actuator_forcerange", (number, end), (-1, 1)[end]) for end in (1, 0)
    ]
    return [range_fields]


def _make_gravity_finder(*axes: int) -> Find:
    return lambda _robot, _place: [[ModelField("opt.gravity", (axis,))] for axis in axes]


_FIELDS: Mapping[str, Find] = {
    "drag.linear": _make_dof_finder("dof_damping"),
    "drag.quadratic": _make_dof_finder("dof_dampingpoly", 0),
    "friction.coulomb": _make_dof_finder("dof_frictionloss"),
    "inertia.armature": _make_dof_finder("dof_armature"),
    "spring.linear": _make_joint_finder("jnt_stiffness"),
    "spring.cubic": _make_joint_finder("jnt_stiffnesspoly", 1),
    "actuator.limit": _force_range,
    "actuator.stiffness": _make_servo_gain_finder(1),
    "actuator.damping": _make_servo_gain_finder(2),
    "mass.scale": _make_body_finder("body_mass"),
    "mass.offset": _find_mass_centre_fields,
    "inertia.scale": _make_body_finder("body_inertia"),
    "gravity.scale": lambda _robot, _place: [[ModelField("opt.gravity", ())]],
    "gravity.tilt": _make_gravity_finder(0, 1),
}
_OPERATIONS: Mapping[str, Operation] = {
    "mass.offset": "add",
    "inertia.scale": "scale",
    "gravity.scale": "scale",
}
"""Operations other than ``abs``, by effect.

A position is shifted. A tensor or a vector is scaled, so that it keeps its direction.
"""


def model_fields(robot: RobotModel, effect: str, place: str) -> list[list[ModelField]]:
    """Find the elements of the compiled model that an effect changes, by coefficient.

    Args:
        robot: robot with the compiled model.
        effect: name of the effect, without its place.
        place: joint, actuator or body.

    Returns:
        For each coefficient, the elements that hold its number, the main one first; empty if the
        model has no such number.
    """
    return _FIELDS[effect](robot, place) if effect in _FIELDS else []


def operation_of(effect: str) -> Operation:
    """Return how a random number is applied to the field of an effect."""
    return _OPERATIONS.get(effect, "abs")
