"""Apply causes to a robot's model, as changed numbers of an MjSpec.

This module alone defines the meaning of a cause for a model file. Model-field effects have the same
meaning as in a simulation (`sims.robot.model_field_effects`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sims import effects as library
from sims.core.effect import SeriesElement
from sims.core.freed_memory import release_free_memory
from sims.effects.transmission import combine_elements, make_series_element
from sims.extended_simulator import FittedValue
from sims.robot.contact_pairs import add_contact_pairs
from sims.robot.coupled_drives import COUPLING_EFFECT, make_coupled_robot
from sims.robot.dynamics.series_joints import (
    add_series_joints,
    find_series_joint,
    is_compliant_flank,
    is_series_effect,
    prepare_flanks_for_file,
    write_series_element,
)
from sims.robot.export.input_effect_writers import COMMAND_WRITERS, get_application_order
from sims.robot.export.mjcf_attributes import (
    Fields,
    ModelElement,
    UnstatableCauseError,
    copy_model_fields,
    find_differing_statements,
)
from sims.robot.export.spec_editing import compile_changed_spec, format_spec
from sims.robot.fitted_causes import FittedCause, expand_families, is_gravity_compensated
from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS
from sims.robot.robot_model import RobotModel

KEYFRAMES_OMITTED_NOTE = "keyframes are left out: they lack the coordinates of joints in series"

COULOMB = "friction.coulomb"

GEOMETRY_EFFECTS = frozenset({"joint.axis", "link.length"})
"""Effects that change attributes in the frame of the element around theirs."""

_NOTES = {
    "joint.flexibility": "joint.flexibility: the joint is followed by a second joint in series, "
    "whose "
    "initial position in the file is zero; damping is given as a damping ratio",
    "joint.backlash": "joint.backlash: the joint is followed by a second joint in series, whose "
    "initial position in the file is the middle of the backlash",
    **{
        name: f"{name}: the pair of geoms has an element <pair>, whose parameters replace those of "
        "both geoms"
        for name in ("contact.damping", "contact.friction", "contact.softness")
    },
    "joint.coupling": "joint.coupling: the joint's actuator drives a tendon, the joint with 1 and "
    "the one before it with the coefficient",
    COULOMB: "friction.coulomb: dry friction is stiff in the file (solreffriction, "
    "solimpfriction), so that the joint does not creep",
}
"""Notes about effects that a file contains."""
_SOFT_FRICTION_NOTE = (
    "friction.coulomb: dry friction has MuJoCo's soft form, since solreffriction and "
    "solimpfriction are left as they were; a joint under load creeps"
)


@dataclass(frozen=True)
class ModifiedModel:
    """A robot's model with causes applied.

    Attributes:
        robot: the robot, with joints in series if causes add some.
        text: the model as MJCF written by MuJoCo.
        model: the compiled model.
        target_values: target fields of the compiled model.
        comments: causes that change an element, by element.
        held: causes that the model contains.
        notes: notes about causes that it cannot contain, and about differences of those it
            contains.
    """

    robot: RobotModel
    text: str
    model: Any
    target_values: Fields
    comments: Mapping[ModelElement, Sequence[str]]
    held: tuple[FittedCause, ...]
    notes: tuple[str, ...]


def apply_causes(
    robot: RobotModel, causes: Mapping[str, Mapping[str, FittedValue]], recording: str = ""
) -> ModifiedModel:
    """Apply fitted causes to a copy of a robot's model, and explain each change in a comment.

    The result is what a model file must contain so that MuJoCo simulates the robot with its causes,
    such as a joint's friction or a wrong mass. The steps are:

    1. Add the elements that causes need: couplings, contact pairs, elements in series.
    2. Write each cause into the fields (numbers) of the compiled model, and note which elements it
       changes. Causes that no model file can state, such as a sensor's bias, become notes.
    3. Change a copy of the editable model until it compiles to these fields.

    Args:
        robot: model of the robot as read from its file; it is not changed.
        causes: coefficients by ``effect@place``, ``effect@*`` or ``effect``.
        recording: title of the recording to which they were fitted, for comments.

    Raises:
        InputError: the robot has no place of that name.
        RuntimeError: the model does not accept a change; this is a program error.
    """
    # 1. Elements. A family, one effect at all places, is expanded to its places.
    fitted_causes = expand_families(robot, causes)
    notes = []
    couplings = {
        c.place: float(c.coefficients[0]) for c in fitted_causes if c.effect == COUPLING_EFFECT
    }
    robot = make_coupled_robot(robot, couplings) if couplings else robot
    robot = add_contact_pairs(robot, [c.place for c in fitted_causes if _is_at_contact(c)])
    # Springs and gaps between a drive and its links, by joint.
    series = _combine_series_elements(fitted_causes)
    if series:
        notes += [KEYFRAMES_OMITTED_NOTE] if robot.compiled.nkey else []
        added = tuple((c.place, c.effect) for c in fitted_causes if _is_in_series(c))
        robot = prepare_flanks_for_file(add_series_joints(robot, added), series)
    # 2. Fields.
    target_values = copy_model_fields(robot.compiled)
    comments: dict[ModelElement, list[str]] = {}
    applied_causes: list[FittedCause] = []
    # Elements in series take their share of armatures, so they are written last.
    for cause in sorted(fitted_causes, key=lambda c: (get_application_order(c), _is_in_series(c))):
        values_before = {name: values.copy() for name, values in target_values.items()}
        places_in_series = {applied.place for applied in applied_causes if _is_in_series(applied)}
        # The elements in series at a place are written once, with the first of their causes.
        unwritten_series = series if cause.place not in places_in_series else {}
        try:
            remark = _write_cause(target_values, robot, cause, unwritten_series)
        except UnstatableCauseError as reason:
            notes.append(f"{cause.format(recording)}: not in the file: {reason}")
            continue
        applied_causes.append(cause)
        note = f"{cause.effect}: {remark}" if remark else _NOTES.get(cause.effect)
        # Only an increased friction becomes stiff; a reduced one keeps the parameters of the file.
        if cause.effect == COULOMB and (robot.friction_form == "soft" or cause.coefficients[0] < 0):
            note = _SOFT_FRICTION_NOTE
        if note and note not in notes:
            notes.append(note)
        # Comments: at each element with changed numbers, at an added joint, and at the actuators of
        # a coupled drive.
        changed_elements = [
            statement.element
            for statement in find_differing_statements(
                robot.compiled, values_before, target_values, 0.0
            )
        ]
        if _is_in_series(cause):
            second = ModelElement("joint", robot.joint(find_series_joint(robot, cause.place)).id)
            changed_elements += [] if second in changed_elements else [second]
        for changed_element in changed_elements:
            comments.setdefault(changed_element, []).append(cause.format(recording))
        if cause.effect == COUPLING_EFFECT:
            for actuator in (a for a in robot.actuators if a.joint == cause.place):
                element = ModelElement("actuator", actuator.id)
                comments.setdefault(element, []).append(cause.format(recording))
    # 3. Editable model.
    spec, model = compile_changed_spec(robot, target_values)
    if any(is_compliant_flank(transmission)[0] for transmission in series.values()):
        # The solver parameters of compliant flanks (a gap with a spring) depend on the compiled
        # inertia, and so on all causes.
        robot = prepare_flanks_for_file(robot, series, model)
        spec, model = compile_changed_spec(robot, target_values)
    # Only the text is stored, since a compiled spec holds all meshes a second time.
    text = format_spec(spec, robot.path.resolve().parent)
    del spec
    release_free_memory()
    return ModifiedModel(
        robot, text, model, target_values, comments, tuple(applied_causes), tuple(notes)
    )


def _is_at_contact(cause: FittedCause) -> bool:
    """Return whether a cause is an effect at a contact of two geoms."""
    known = cause.effect in library.list_names()
    return known and library.get_effect(cause.effect).at == "contact"


def _is_in_series(cause: FittedCause) -> bool:
    """Return whether a cause is an effect that adds a joint in series, such as a flexible gear."""
    return cause.effect in library.list_names() and is_series_effect(
        library.get_effect(cause.effect)
    )


def _combine_series_elements(causes: Sequence[FittedCause]) -> dict[str, SeriesElement]:
    """Combine the springs and gaps that causes put in series with a joint to one element by joint.

    Such an element is between the drive of the joint and the links that it moves.

    Args:
        causes: fitted causes; those that add nothing in series are ignored.

    Returns:
        Elements by joint; their numbers have the shape (1,).
    """
    elements: dict[str, list[SeriesElement]] = {}
    for cause in (cause for cause in causes if _is_in_series(cause)):
        numbers = {name: np.array([number.value]) for name, number in cause.numbers.items()}
        element = make_series_element(library.get_effect(cause.effect), numbers)
        elements.setdefault(cause.place, []).append(element)
    return {place: combine_elements(place_elements) for place, place_elements in elements.items()}


def _write_cause(
    target_values: Fields,
    robot: RobotModel,
    cause: FittedCause,
    series: Mapping[str, SeriesElement],
) -> str | None:
    """Write a cause into the fields (numbers) of the compiled model that a model file shall have.

    Args:
        target_values: fields of the model, changed in place.
        robot: robot with the elements that causes add.
        cause: effect at a place with its fitted coefficients.
        series: elements in series with joints, by place, that are not yet written.

    Returns:
        A note for the user, or None.

    Raises:
        UnstatableCauseError: a model file cannot state the cause.
    """
    # A coupling is an element of the robot, which has its coefficient already.
    if cause.effect == COUPLING_EFFECT:
        return None
    if is_gravity_compensated(cause.effect, cause.numbers):
        for body in robot.bodies:
            target_values["body_gravcomp"][0, body.id] = 1.0
        return "gravity is compensated: the bodies have gravcomp = 1, and gravity is unchanged"
    if cause.effect in GEOMETRY_EFFECTS and _is_in_frame(robot, cause):
        raise UnstatableCauseError("its element is within a <frame>, or made by another element")
    if cause.effect in MODEL_FIELD_EFFECTS:
        MODEL_FIELD_EFFECTS[cause.effect].write(
            target_values, robot, cause.place, cause.coefficients[:, None]
        )
        return None
    if _is_in_series(cause):
        if cause.place in series:
            write_series_element(target_values, robot, cause.place, series[cause.place])
        return None
    if cause.effect in COMMAND_WRITERS:
        return COMMAND_WRITERS[cause.effect](target_values, robot, cause)
    if cause.effect.startswith(("sensor.", "clock.")):
        raise UnstatableCauseError("a model file does not state sensor errors")
    raise UnstatableCauseError("MuJoCo has no such element")


def _is_in_frame(robot: RobotModel, cause: FittedCause) -> bool:
    """Return whether the joint or body of a cause is within a ``<frame>`` of the model file.

    A frame moves the position and the axes of its contents. The compiled numbers are then not those
    of the file, so an effect on geometry cannot be written as a changed attribute.

    Args:
        robot: robot with the spec of the model file.
        cause: effect on the geometry of a joint (``joint.``) or a body.
    """
    elements = robot.spec.joints if cause.effect.startswith("joint.") else robot.spec.bodies
    return any(element.name == cause.place and element.frame is not None for element in elements)
