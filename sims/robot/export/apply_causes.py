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
from sims.core.simulator import Array
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
    ANGLE_ATTRIBUTES,
    ATTRIBUTES_BY_KIND,
    ENUM_ATTRIBUTES,
    FLAG_ATTRIBUTES,
    INTEGER_ATTRIBUTES,
    MAX_CORRECTION_ROUNDS,
    ROUNDING_TOLERANCE,
    AttributeStatement,
    Fields,
    Kind,
    ModelElement,
    UnstatableCauseError,
    copy_model_fields,
    find_differing_statements,
    find_missing_statements,
)
from sims.robot.export.mjcf_writer import format_spec
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
    spec, model = _compile_changed_spec(robot, target_values)
    if any(is_compliant_flank(transmission)[0] for transmission in series.values()):
        # The solver parameters of compliant flanks (a gap with a spring) depend on the compiled
        # inertia, and so on all causes.
        robot = prepare_flanks_for_file(robot, series, model)
        spec, model = _compile_changed_spec(robot, target_values)
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


def _compile_changed_spec(robot: RobotModel, target_values: Fields) -> tuple[Any, Any]:
    """Change a copy of the robot's editable model until it compiles to the wanted fields.

    The compiler derives fields (numbers of the compiled model) from attributes of the file, so a
    change may also modify values that should stay. So in each of at most `MAX_CORRECTION_ROUNDS`
    rounds:

    1. Find the attributes whose fields differ from the wanted ones; without any, return the model.
    2. Set them, and compile the model.

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        target_values: wanted fields of the compiled model.

    Returns:
        The changed mujoco.MjSpec, and the compiled model.

    Raises:
        RuntimeError: fields still differ after the last round; this is a program error.
    """
    spec, model = robot.spec.copy(), robot.compiled
    elements = _index_spec_elements(spec)
    tolerance = 0.0  # Later rounds ignore rounding by the compiler.
    for _ in range(MAX_CORRECTION_ROUNDS):
        # 1. Differences.
        statements = find_missing_statements(model, target_values, tolerance)
        if not statements:
            return spec, model
        # 2. Changes. The kind "body" means the mass and inertia of a body.
        for statement in statements:
            set_attributes(elements[statement.element], statement)
        if any(statement.element.kind == "body" for statement in statements):
            _keep_masses(spec, target_values)
        model, tolerance = spec.compile(), ROUNDING_TOLERANCE
    missing_statements = find_missing_statements(model, target_values, tolerance)
    if missing_statements:
        raise RuntimeError(f"{robot.path}: the model does not take {missing_statements[0]}")
    return spec, model


def _keep_masses(spec: Any, target_values: Fields) -> None:
    """Change compiler settings so that MuJoCo uses the masses and inertias of bodies as specified.

    By default settings of a file, it may compute them from shapes, or scale them to a total mass.

    Args:
        spec: the model as an `MjSpec`, changed in place.
        target_values: target fields of the compiled model.
    """
    import mujoco

    if spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    if spec.compiler.settotalmass > 0:
        spec.compiler.settotalmass = float(target_values["body_mass"].sum())


def _index_spec_elements(spec: Any) -> dict[ModelElement, Any]:
    """Return the elements of an editable model (`mujoco.MjSpec`) by kind and compiled number.

    A body is there twice: as ``body`` for its inertial, and as ``frame`` for its pose. The options
    of the model are the element ``option`` with the number 0.

    Args:
        spec: editable model; it is compiled here.

    Returns:
        Elements of the spec, whose attributes can be set, by kind and number.
    """
    # Elements have numbers only after compilation.
    spec.compile()
    elements_by_kind: dict[Kind, Any] = {
        "joint": spec.joints,
        "body": spec.bodies,
        "frame": spec.bodies,
        "actuator": spec.actuators,
        "geom": spec.geoms,
        "pair": spec.pairs,
    }
    elements = {
        ModelElement(kind, element.id): element
        for kind, of_kind in elements_by_kind.items()
        for element in of_kind
    }
    return elements | {ModelElement("option", 0): spec.option}


def set_attributes(element: Any, statement: AttributeStatement) -> None:
    """Set attributes of an element of an editable MuJoCo model.

    Values from the compiled model are converted to the form that the editable model expects:
    enumerations, flags, integers, degrees. Other attributes that would take precedence over the new
    values are reset.

    Args:
        element: element of a `mujoco.MjSpec`; it is changed in place.
        statement: attributes with their values in the units of the compiled model.
    """
    import mujoco

    # 1. Values.
    kind = statement.element.kind
    spec_names = {attribute.name: attribute.spec for attribute in ATTRIBUTES_BY_KIND[kind]}
    for name, values in statement.values.items():
        if name in ENUM_ATTRIBUTES:
            value: Any = getattr(mujoco, ENUM_ATTRIBUTES[name])(int(values[0]))
        elif name in FLAG_ATTRIBUTES:
            limit_states = mujoco.mjtLimited
            value = limit_states.mjLIMITED_TRUE if values[0] else limit_states.mjLIMITED_FALSE
        elif name in INTEGER_ATTRIBUTES:
            value = int(values[0])
        elif kind == "frame" and name == "pos":
            value = _convert_to_inner_frame(element, values)
        else:
            value = _convert_to_attribute(element, name, spec_names[name], values)
        setattr(element, spec_names[name], value)
    # 2. Attributes that would take precedence: a full tensor, or another form of the orientation of
    # an inertial, and `springdamper` of a joint.
    if kind == "body":
        element.explicitinertial = True
        element.fullinertia = np.full(6, np.nan)
        element.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    if kind == "joint" and {"damping", "stiffness"} & set(statement.values):
        element.springdamper = (0.0, 0.0)


def _convert_to_inner_frame(body: Any, position: Sequence[float]) -> Array:
    """Convert the position of a body from its parent body's frame to the innermost frame around it.

    MuJoCo replaces bodies that it fuses into their parents by elements ``<frame>``, which may be
    nested. The position of a body in the editable model is relative to the innermost of them, but
    in the compiled model to the parent. First the pose of the innermost frame in the parent is
    composed, from the inside to the outside.

    Args:
        body: body of the editable model; without frames the position stays as it is.
        position: x, y, z in m.
    """
    # Importing scipy.spatial takes 0.1 s, and most model files have no fused bodies.
    from scipy.spatial.transform import Rotation

    # Pose of the innermost frame in the frame reached so far, at last in the parent body.
    rotation, origin = Rotation.identity(), np.zeros(3)
    frame = body.frame
    while frame is not None:
        w, *xyz = frame.quat  # SciPy expects the real part last
        outer = Rotation.from_quat([*xyz, w])
        rotation, origin = outer * rotation, frame.pos + outer.apply(origin)
        frame = frame.frame
    result: Array = rotation.inv().apply(np.asarray(position) - origin)
    return result


def _convert_to_attribute(element: Any, name: str, attribute: str, values: Sequence[float]) -> Any:
    """Convert values to the form of a spec attribute: a number, or an array padded with zeros.

    Angles of a hinge are converted to degrees if the spec's compiler uses degrees.

    Args:
        element: element of the spec.
        name: name of the attribute in an MJCF.
        attribute: its name in the spec.
        values: its numbers, angles in rad.
    """
    import mujoco

    if name in ANGLE_ATTRIBUTES and element.type == mujoco.mjtJoint.mjJNT_HINGE:
        return float(np.rad2deg(values[0])) if element.compiler.degree else values[0]
    shape = np.shape(getattr(element, attribute))
    if not shape:
        return values[0]
    # A spec may have more or fewer numbers than the compiled model.
    padded = np.zeros(shape)
    padded[: len(values)] = values[: len(padded)]
    return padded
