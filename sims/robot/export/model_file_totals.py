"""Values of model-file numbers that coefficients change, before and after the change."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sims.core.effect import Effect
from sims.robot.contact_pairs import add_contact_pairs, find_geom, find_pair
from sims.robot.export.mjcf_attributes import Fields, copy_model_fields
from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS, get_write_order, model_fields
from sims.robot.robot_model import RobotModel


class Total(NamedTuple):
    """A number of the model file before and after the effects are applied.

    Attributes:
        stated: value in the model file.
        total: value with the coefficients applied.
        unit: unit of both.
    """

    stated: float
    total: float
    unit: str


Read = Callable[[Fields, RobotModel, str], Sequence[float]]
"""Function that reads the numbers that an effect's coefficients change, in their order.

It takes the model fields, the robot and the place.
"""


def _get_gravity_strength(f: Fields, robot: RobotModel, place: str) -> Sequence[float]:  # noqa: ARG001
    """Return the component of gravity along its direction in the file, in m/s^2.

    It is a list of one, since each reader returns one number for each coefficient of its effect.

    Args:
        f: fields of the model with the effects, with one batch element (index 0).
        robot: the robot, whose file specifies the direction.
        place: unused; all readers have the same arguments.
    """
    gravity_in_file = robot.compiled.opt.gravity
    # Gravity may be zero in the file.
    magnitude = max(np.linalg.norm(gravity_in_file), 1e-300)
    return [float(f["opt.gravity"][0] @ gravity_in_file / magnitude)]


def _get_force_limit(f: Fields, robot: RobotModel, place: str) -> Sequence[float]:
    """Return the upper force limit of an actuator; infinite if none.

    It is a list of one, since each reader returns one number for each coefficient of its effect.

    Args:
        f: fields of the model with the effects, with one batch element (index 0).
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        place: name of the actuator.
    """
    actuator_id = robot.actuator(place).id
    is_limited = f["actuator_forcelimited"][0, actuator_id]
    return [f["actuator_forcerange"][0, actuator_id, 1]] if is_limited else [np.inf]


def _make_solref_reader(index: int) -> Read:
    """Return a function that reads the time constant or the damping ratio of a contact.

    MuJoCo's `solref` has these two numbers, or the negative stiffness and damping. The function
    returns infinity in the second case, which stands for a number that the file does not have.

    Args:
        index: 0 for the time constant, 1 for the damping ratio.
    """

    def read(f: Fields, robot: RobotModel, place: str) -> Sequence[float]:
        values = f["pair_solref"][0, find_pair(robot, place)]
        return [values[index] if values[0] > 0 else np.inf]

    return read


_READERS: Mapping[str, Read] = {
    "actuator.limit": _get_force_limit,
    "contact.damping": _make_solref_reader(1),
    "contact.friction": lambda f, r, place: [f["pair_friction"][0, find_pair(r, place), 0]],
    "contact.softness": _make_solref_reader(0),
    "geom.radius": lambda f, r, place: [f["geom_size"][0, find_geom(r, place), 0]],
    "gravity.compensation": lambda f, r, place: [f["body_gravcomp"][0, r.body(place).id]],
    "gravity.scale": _get_gravity_strength,
    "joint.zero": lambda f, r, place: [f["qpos0"][0, r.joint(place).position]],
    "link.length": lambda f, r, place: [float(np.linalg.norm(f["body_pos"][0, r.body(place).id]))],
}
"""Readers of numbers that are more than one element of a field, or may be missing."""
_UNITS: Mapping[str, tuple[str, str]] = {
    "actuator.stiffness": ("N*m/rad", "N/m"),
    "actuator.damping": ("N*m*s/rad", "N*s/m"),
    "mass.scale": ("kg", ""),
    "inertia.scale": ("kg*m^2", ""),
    "contact.softness": ("s", ""),
    "link.length": ("m", ""),
    "geom.radius": ("m", ""),
    "gravity.scale": ("m/s^2", ""),
    "gravity.tilt": ("m/s^2", ""),
}
"""Units at a hinge and at a slide, where they differ from that of the coefficient."""


Fitted = Sequence[tuple[type[Effect], Sequence[float]]]
"""Effects, each at one place or of the world, with their coefficients."""


def compute_file_totals(robot: RobotModel, fitted: Fitted) -> list[list[Total | None]]:
    """Return the numbers of the model file that effects change, before and after, for the report.

    A fitted coefficient is a change, such as 0.2 of a damping. Users want to see the number in the
    file and the total, such as 0.1 and 0.3. Several effects may change one number, such as the mass
    of a body; a total includes all of them.

    Args:
        robot: model of the robot as read from its file.
        fitted: effects with their coefficients.

    Returns:
        For each effect, one entry per coefficient; None if the file has no such number.
    """
    # A contact has numbers of its own only with an element `<pair>`.
    robot = add_contact_pairs(robot, [e.place for e, _ in fitted if e.at == "contact"])
    file_fields = copy_model_fields(robot.compiled)
    changed_fields = copy_model_fields(robot.compiled)
    # Some effects, such as a payload, must be written after others.
    for effect, values in sorted(
        fitted, key=lambda entry: get_write_order(_get_effect_name(entry[0]))
    ):
        # Effects without numbers in the file change nothing here.
        if _read_numbers(file_fields, robot, effect):
            c = np.array(values, dtype=float)[:, None]
            MODEL_FIELD_EFFECTS[_get_effect_name(effect)].write(
                changed_fields, robot, effect.place, c
            )
    return [
        _list_totals(robot, effect, len(values), file_fields, changed_fields)
        for effect, values in fitted
    ]


def _get_effect_name(effect: type[Effect]) -> str:
    return effect.of or effect.name


def _read_numbers(fields: Fields, robot: RobotModel, effect: type[Effect]) -> Sequence[float]:
    """Return the numbers of the model file that an effect's coefficients change, one for each.

    The result is empty if the file has no such numbers.

    Args:
        fields: fields of the model, from which the numbers are read.
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        effect: class of the effect at its place.
    """
    name, place = _get_effect_name(effect), effect.place
    if name in _READERS:
        return _READERS[name](fields, robot, place)
    # Each coefficient has a main field, and others that hold the same number. The largest of three
    # principal moments represents a tensor. Fields have one batch element, 0.
    return [
        main_field.sign * np.max(fields[main_field.name][(0, *main_field.address)])
        for main_field, *_ in model_fields(robot, name, place)
    ]


def _list_totals(
    robot: RobotModel, effect: type[Effect], count: int, file_fields: Fields, changed_fields: Fields
) -> list[Total | None]:
    """Return the numbers of the model file that one effect changes, before and after.

    An example is a damping of 0.1 in the file and an effect of 0.2: the total is 0.3.

    Args:
        robot: model of the robot as read from its file.
        effect: effect at one place.
        count: number of coefficients.
        file_fields: fields of the model file.
        changed_fields: fields with all fitted effects.

    Returns:
        One entry for each coefficient; None where the file has no such number, or an infinite one.
    """
    file_numbers, totals = (
        np.array(_read_numbers(fields, robot, effect), dtype=float)
        for fields in (file_fields, changed_fields)
    )
    if not file_numbers.size:
        return [None] * count
    hinge_unit, slide_unit = _UNITS.get(_get_effect_name(effect), ("", ""))
    joint = robot.actuator(effect.place).joint if effect.at == "actuator" else None
    is_at_slide = joint is not None and robot.joint(joint).kind == "slide"
    number_totals: list[Total | None] = []
    for c, before, total in zip(effect.coefficients, file_numbers, totals, strict=True):
        # Without a unit for this effect, the number has that of the coefficient.
        effect_unit = slide_unit if is_at_slide and slide_unit else hinge_unit
        unit = effect_unit or c.units[0] or "1"
        is_stated = np.isfinite([before, total]).all()
        number_totals.append(Total(float(before), float(total), unit) if is_stated else None)
    return number_totals
