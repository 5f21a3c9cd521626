"""Apply causes to a robot's model, as changed numbers of an MjSpec.

This module alone defines the meaning of a cause for a model file. Model-field effects have the same
meaning as in a simulation (`sims.robot.native`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sims import effects as library
from sims.extended import Number
from sims.memory import release_free_memory
from sims.robot.causes import Cause, is_gravity_compensated, one_by_one
from sims.robot.commands import COMMANDS, order
from sims.robot.coupled import EFFECT as COUPLED
from sims.robot.coupled import coupled
from sims.robot.model import Robot
from sims.robot.native import FIELDS
from sims.robot.precise import saved
from sims.robot.series import element, gives, in_series, is_series, second_of, together, with_flanks
from sims.robot.series import state as state_element
from sims.robot.stated import (
    ATTRIBUTES,
    CHOICES,
    COUNTS,
    FLAGS,
    Element,
    Fields,
    Statement,
    differing,
    fields,
    lacking,
)
from sims.system import Element as Transmission

ROUNDS = 4
"""Maximum number of rounds that restore values which another change has modified."""

CLOSE = 1e-13
"""Relative difference between compiled numbers that counts as rounding."""

KEPT = "as it was: it would move along with another change"

KEYLESS = "keyframes are left out: they lack the coordinates of joints in series"

COULOMB = "friction.coulomb"

_NOTES = {
    "joint.flexibility": "joint.flexibility: the joint has a second one in series, whose position "
    "begins at zero in the file; damping is a share of the critical one",
    "joint.backlash": "joint.backlash: the joint has a second one in series, which begins in the "
    "middle of its gap in the file",
    "joint.coupling": "joint.coupling: the joint's actuator drives a tendon, the joint with 1 and "
    "the one before it with the coefficient",
    COULOMB: "friction.coulomb: dry friction is stiff in the file (solreffriction, "
    "solimpfriction), or it would creep",
}
"""Notes about effects that a file contains."""
_SOFT = (
    "friction.coulomb: dry friction has MuJoCo's soft form, since solreffriction and "
    "solimpfriction are left as they were; a joint under load creeps"
)


@dataclass(frozen=True)
class Applied:
    """A robot's model with causes applied.

    Attributes:
        robot: the robot, with joints in series if causes add some.
        text: the model as MJCF written by MuJoCo.
        model: the compiled model.
        wanted: target fields of the compiled model.
        comments: causes that change an element, by element.
        held: causes that the model contains.
        said: notes about causes that it cannot contain, and about differences of those it contains.
    """

    robot: Robot
    text: str
    model: Any
    wanted: Fields
    comments: Mapping[Element, Sequence[str]]
    held: tuple[Cause, ...]
    said: tuple[str, ...]


def apply(robot: Robot, causes: Mapping[str, Mapping[str, Number]], recording: str = "") -> Applied:
    """Apply causes to a robot's model.

    Args:
        robot: robot as read from its model file; it is not changed.
        causes: coefficients by ``effect@place``, ``effect@*`` or ``effect``.
        recording: title of the recording to which they were fitted, for comments.

    Raises:
        InputError: the robot has no place of that name.
        RuntimeError: the model does not accept a change; this is a program error.
    """
    found = one_by_one(robot, causes)
    said = []
    couplings = {c.place: float(c.coefficients[0]) for c in found if c.effect == COUPLED}
    robot = coupled(robot, couplings) if couplings else robot
    series = _in_series(found)
    if series:
        said += [KEYLESS] if robot.compiled.nkey else []
        added = tuple((c.place, c.effect) for c in found if _is_in_series(c))
        robot = with_flanks(in_series(robot, added), series)
    wanted = fields(robot.compiled)
    comments: dict[Element, list[str]] = {}
    held: list[Cause] = []
    # Elements in series take their share of armatures, so they are written last.
    for cause in sorted(found, key=lambda c: (order(c), _is_in_series(c))):
        before = {name: values.copy() for name, values in wanted.items()}
        done = {one.place for one in held if _is_in_series(one)}
        answer = _write(wanted, robot, cause, series if cause.place not in done else {})
        if answer and not answer.startswith("+"):
            said.append(f"{cause.told(recording)}: not in the file: {answer}")
            continue
        held.append(cause)
        note = f"{cause.effect}: {answer[1:]}" if answer else _note(robot, cause)
        if note and note not in said:
            said.append(note)
        changed = [one.element for one in differing(robot.compiled, before, wanted, 0.0)]
        if _is_in_series(cause):
            second = Element("joint", robot.joint(second_of(robot, cause.place)).id)
            changed += [] if second in changed else [second]
        for one in changed:
            comments.setdefault(one, []).append(cause.told(recording))
        if cause.effect == COUPLED:
            for actuator in (a for a in robot.actuators if a.joint == cause.place):
                element = Element("actuator", actuator.id)
                comments.setdefault(element, []).append(cause.told(recording))
    spec, model = _compiled(robot, wanted)
    if any(gives(made)[0] for made in series.values()):
        # The solver parameters of compliant flanks depend on all causes, so they are computed
        # again.
        robot = with_flanks(robot, series, model)
        spec, model = _compiled(robot, wanted)
    # Only the text is stored, since a compiled spec holds all meshes a second time.
    text = saved(spec, robot.path.resolve().parent)
    del spec
    release_free_memory()
    return Applied(robot, text, model, wanted, comments, tuple(held), tuple(said))


def _note(robot: Robot, cause: Cause) -> str | None:
    """Return the note about an effect that the file contains; None if there is none."""
    if cause.effect == COULOMB and (robot.friction_form == "soft" or cause.coefficients[0] < 0):
        return _SOFT
    return _NOTES.get(cause.effect)


def _is_in_series(cause: Cause) -> bool:
    return cause.effect in library.names() and is_series(library.get(cause.effect))


def _in_series(causes: Sequence[Cause]) -> dict[str, Transmission]:
    """Combine the elements that causes put in series with joints, by joint."""
    elements: dict[str, list[Transmission]] = {}
    for cause in causes:
        if _is_in_series(cause):
            elements.setdefault(cause.place, []).append(_element(cause))
    return {place: together(own) for place, own in elements.items()}


def _element(cause: Cause) -> Transmission:
    numbers = {name: np.array([number.value]) for name, number in cause.numbers.items()}
    return element(library.get(cause.effect), numbers)


def _write(
    wanted: Fields, robot: Robot, cause: Cause, series: Mapping[str, Transmission]
) -> str | None:
    """Apply a cause to the fields; `series` contains the elements in series not yet written."""
    # A coupling is an element of the robot, which has been added before.
    if cause.effect == COUPLED:
        return None
    if is_gravity_compensated(cause.effect, cause.numbers):
        for body in robot.bodies:
            wanted["body_gravcomp"][0, body.id] = 1.0
        return "+gravity is compensated: the bodies have gravcomp = 1, and gravity is as it was"
    if cause.effect in FIELDS:
        FIELDS[cause.effect].write(wanted, robot, cause.place, cause.coefficients[:, None])
        return None
    if _is_in_series(cause):
        if cause.place in series:
            state_element(wanted, robot, cause.place, series[cause.place])
        return None
    if cause.effect in COMMANDS:
        return COMMANDS[cause.effect](wanted, robot, cause)
    if cause.effect.startswith(("sensor.", "clock.")):
        return "what a sensor shows is no part of the model"
    return "MuJoCo has no such element"


def _compiled(robot: Robot, wanted: Fields) -> tuple[Any, Any]:
    """Return a spec that compiles to the wanted fields, and the compiled model."""
    spec, model = robot.spec.copy(), robot.compiled
    by_id = Elements(spec, robot)
    tolerance = 0.0
    for _ in range(ROUNDS):
        statements = lacking(model, wanted, tolerance)
        if not statements:
            return spec, model
        for statement in statements:
            state(by_id.of(statement.element), statement)
        if any(statement.element.kind == "body" for statement in statements):
            _keep_masses(spec, wanted)
        model, tolerance = spec.compile(), CLOSE
    left = lacking(model, wanted, tolerance)
    if left:
        raise RuntimeError(f"{robot.path}: the model does not take {left[0]}")
    return spec, model


def _keep_masses(spec: Any, wanted: Fields) -> None:
    """Change compiler settings so that MuJoCo uses inertials as specified."""
    import mujoco

    if spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    if spec.compiler.settotalmass > 0:
        spec.compiler.settotalmass = float(wanted["body_mass"].sum())


class Elements:
    """The elements of a spec by their numbers in the compiled model."""

    def __init__(self, spec: Any, robot: Robot) -> None:
        self.spec = spec
        # Elements have numbers only after compilation.
        spec.compile()
        self.joints = {joint.id: joint for joint in spec.joints}
        self.bodies = {body.id: body for body in spec.bodies}
        self.actuators = {actuator.id: actuator for actuator in spec.actuators}
        self.robot = robot

    def of(self, element: Element) -> Any:
        """Return the spec's element for an element of the compiled model."""
        if element.kind == "option":
            return self.spec.option
        of_kind = {"joint": self.joints, "actuator": self.actuators}
        return of_kind.get(element.kind, self.bodies)[element.id]


def state(element: Any, statement: Statement) -> None:
    """Set the attributes of a statement in an element of a spec.

    Args:
        element: element of a mujoco.MjSpec; it is changed in place.
        statement: attributes in MuJoCo's units.
    """
    import mujoco

    kind = statement.element.kind
    known = {attribute.name: attribute.spec for attribute in ATTRIBUTES[kind]}
    for name, values in statement.values.items():
        if name in CHOICES:
            value: Any = getattr(mujoco, CHOICES[name])(int(values[0]))
        elif name in FLAGS:
            limited = mujoco.mjtLimited
            value = limited.mjLIMITED_TRUE if values[0] else limited.mjLIMITED_FALSE
        elif name in COUNTS:
            value = int(values[0])
        else:
            value = _numbers(element, name, known[name], values)
        setattr(element, known[name], value)
    if kind == "body":
        _explicit(element)
    if kind == "joint" and {"damping", "stiffness"} & set(statement.values):
        element.springdamper = (0.0, 0.0)


def _numbers(element: Any, name: str, attribute: str, values: Sequence[float]) -> Any:
    """Convert values to the form of a spec attribute: a number, or an array of its length."""
    import mujoco

    if name == "springref" and element.type == mujoco.mjtJoint.mjJNT_HINGE:
        return float(np.rad2deg(values[0])) if element.compiler.degree else values[0]
    now = np.asarray(getattr(element, attribute))
    if now.ndim == 0:
        return values[0]
    padded = np.zeros(now.shape)
    padded[: len(values)] = values[: len(padded)]
    return padded


def _explicit(body: Any) -> None:
    """Make the compiler use the inertial that was set."""
    import mujoco

    body.explicitinertial = True
    body.fullinertia = np.full(6, np.nan)
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
