"""Flexible joints and joints with backlash, as a second joint in series in the same body.

Let x be the joint's position on the side of its drive, where the actuator, encoder, specified
damping and dry friction are, y the position of the links that it carries, J the drive's inertia
(the armature) and T the transmitted force:

    J x'' = U - T                                                          (1)
    (M(q) q'' + n(q, q'))_j = T,  q_j = y                                  (2)

(M. W. Spong, J. Dyn. Syst. Meas. Control 109(4), 310 (1987), doi:10.1115/1.3143860). A second joint
d = y - x about the same axis makes y the body's position, and

    T = -k d - c d'         for a spring with a damper                     (3)
    |d| <= gap / 2          for rigid flanks, by MuJoCo's joint limit      (4)
    T = -k e - c d'         for compliant flanks; e is d beyond the gap    (5)

The shares of inertia and damping refer to M_jj in the pose that the file specifies (q = 0 by
default). So MuJoCo integrates the second joint like any other, and a model file can state it. In
(5), T only pushes, and is zero between the flanks. A limit of MuJoCo with impedance s exerts

    -(K e + C d') / (A + R), R = (1 - s) A0 / s                            (6)

for `solref` (-K s, -C s), with the inverse inertia A along d, and its value A0 in the pose of the
file (MuJoCo's documentation, "Computation", constraint model). At the smallest s, 1e-4, this is a
spring of stiffness K s / A0 with a relative error of the order of s.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sims.base import Array
from sims.robot.coupled import ANY, EFFECT, named
from sims.robot.coupled import coupled as coupled_robot
from sims.robot.coupled import places as coupled_places
from sims.robot.inertia_matrix import inertia_matrix
from sims.robot.model import Robot, kept_with_robot
from sims.robot.native import RK4
from sims.robot.quiet import one_line
from sims.robot.simulation_model import strip_shapes
from sims.system import Acting, Effect, Element, Hidden

LIGHTEST = 0.01
"""Minimum inertia of a drive, as a share of the joint's inertia.

Without inertia of the drive, x in (1) is undetermined.
"""
SLIGHT = 1e-4
"""Minimum inertia of a drive while a model is compiled, as a share of the joint's inertia."""
RESOLVED, RESOLVED_BY_RK4 = 1.2, 2.0
"""Maximum phase, in radians per step, of the oscillation between drive and links.

The second value applies to the Runge-Kutta 4 integrator, the first one to all others.
"""
HARD = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Parameter `solimp` of rigid flanks: the hardest value that MuJoCo allows."""
GIVING = (1e-4, 1e-4, 0.001, 0.5, 2.0)
"""Parameter `solimp` of compliant flanks: the softest value that MuJoCo allows, see (6)."""
UNLOADED = 1e-3
"""Load, as a multiple of the inertia, below which the links rest between the flanks."""
WRITTEN = ("dof_armature", "jnt_stiffness", "dof_damping", "jnt_range", "jnt_solref", "jnt_solimp")
"""Model fields that are written for joints in series."""
FIELDS = (*WRITTEN, "dof_invweight0")
"""Model fields that are written for joints in series, and those derived by MuJoCo that are read."""

Flags = NDArray[np.bool_]

Added = tuple[tuple[str, str], ...]
"""Effects in series with joints, as pairs of joint and effect name; a joint may have several."""


def name_of(joint: str, effects: Collection[str]) -> str:
    """Make the name of a second joint, such as ``elbow_flexibility``.

    It is ``elbow_transmission`` for several effects.

    Args:
        joint: name of the joint with which it is in series.
        effects: names of the effects that it combines.
    """
    kind = next(iter(effects)).rpartition(".")[2] if len(effects) == 1 else "transmission"
    return f"{joint}_{kind}"


def second_of(robot: Robot, joint: str) -> str:
    """Return the name of the joint in series with a joint; empty if there is none."""
    return next((name for name in robot.series if name.rpartition("_")[0] == joint), "")


def by_joint(added: Added) -> dict[str, list[str]]:
    """Group the effects in series by joint."""
    effects: dict[str, list[str]] = {}
    for joint, effect in added:
        effects.setdefault(joint, []).append(effect)
    return effects


def by_series(acting: Acting, count: int) -> dict[Added, list[int]]:
    """Group batch elements by their effects in series with joints.

    Args:
        acting: effects with their coefficients (K, L, 1).
        count: number L of batch elements.
    """
    lanes: dict[Added, list[int]] = {}
    there = [(e, (c[0] > 0)[:, 0]) for e, c in acting if is_series(e)]
    coupled = np.zeros(count, dtype=bool)
    for e, c in acting:
        if e.of == EFFECT:
            coupled |= (c[0] != 0)[:, 0]
    for lane in range(count):
        added = tuple((e.place, e.of) for e, on in there if on[lane])
        if coupled[lane]:
            added += (ANY,)
        lanes.setdefault(added, []).append(lane)
    return lanes


def in_series(robot: Robot, added: Added) -> Robot:
    """Add joints in series to a robot, without changing element names.

    Args:
        robot: robot as read from its model file.
        added: joints, each the last one of its body, with the effect in series; `ANY` requests the
            tendons of coupled drives.
    """
    import mujoco

    if ANY in added:
        robot = coupled_robot(robot, dict.fromkeys(coupled_places(robot), 0.0))
        added = tuple(one for one in added if one != ANY)
    if not added:
        return robot
    spec = robot.spec.copy()
    joints = named(spec, robot)
    inertias = _inertias(robot)
    for name, effects in by_joint(added).items():
        first = joints[robot.joint(name).id]
        # Default classes of the file apply to the first joint only.
        nothing = {"damping": 0.0, "frictionloss": 0.0, "armature": 0.0, "stiffness": 0.0}
        second = first.parent.add_joint(
            name=name_of(name, effects), type=first.type, axis=first.axis, pos=first.pos
        )
        for attribute, value in nothing.items():
            setattr(second, attribute, np.full_like(getattr(second, attribute), value))
        second.springdamper = (0.0, 0.0)
        second.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        play = any(effect.endswith("backlash") for effect in effects)
        limited = mujoco.mjtLimited
        second.limited = limited.mjLIMITED_TRUE if play else limited.mjLIMITED_FALSE
        if play:
            second.range = (-1.0, 1.0)
        # The simulation writes the actual armature; this minimum makes the model compile.
        first.armature = max(first.armature, SLIGHT * inertias[name])
    # Keyframes lack the new coordinates.
    for key in list(spec.keys):
        spec.delete(key)
    series = {name_of(name, own): inertias[name] for name, own in by_joint(added).items()}
    return replace(robot, spec=spec, series=series)


@kept_with_robot
def compile_error(robot: Robot, added: Added) -> str:
    """Return why the model with joints in series does not compile; empty if it does.

    Args:
        robot: robot as read from its model file.
        added: effects in series, as for `in_series`.
    """
    try:
        in_series(strip_shapes(robot), added).compiled  # noqa: B018
    # MuJoCo raises several kinds of errors, and an effect of a user's plugin may raise any.
    except Exception as error:
        return one_line(error) or type(error).__name__
    return ""


@kept_with_robot
def _inertias(robot: Robot) -> dict[str, float]:
    """Return the inertia about each joint, in the pose that the file specifies."""
    inertias = np.diagonal(inertia_matrix(robot.compiled)).tolist()
    return {j.name: inertias[j.velocity] for j in robot.joints if j.single}


def is_series(effect: Effect | type[Effect]) -> bool:
    """Return whether an effect is an element in series with a joint."""
    kind = effect if isinstance(effect, type) else type(effect)
    return issubclass(kind, Hidden) and bool(kind.between)


def write(fields: Mapping[str, Any], robot: Robot, acting: Acting) -> None:
    """Write effects in series with joints into the model fields of a batch.

    `press` must be called after MuJoCo has derived its constants.

    Args:
        fields: model fields of the batch elements.
        robot: robot of `in_series`.
        acting: effects with coefficients (K, L, 1); other effects are ignored.
    """
    made: dict[str, list[Element]] = {}
    for effect, c in acting:
        if not is_series(effect) or not (c[0] > 0).any():
            continue
        numbers = dict(zip((one.name for one in effect.coefficients), c[:, :, 0], strict=True))
        made.setdefault(effect.place, []).append(element(type(effect), numbers))
    for place, elements in made.items():
        state(fields, robot, place, together(elements))


def element(kind: type[Effect], numbers: Mapping[str, Array]) -> Element:
    """Make the series element of an effect from its coefficients (L,).

    Args:
        kind: class of the effect.
        numbers: coefficients by name; missing ones are zero.
    """
    assert issubclass(kind, Hidden)
    first = next(iter(numbers.values()))
    values = [numbers.get(one.name, np.zeros_like(first)) for one in kind.between]
    return kind().element(np.stack(values))


def together(elements: Sequence[Element]) -> Element:
    """Combine several elements in series with one joint by adding their numbers."""
    names = ("stiffness", "damping", "gap", "drive")
    return Element(*(np.sum([getattr(e, name) for e in elements], axis=0) for name in names))


def state(fields: Mapping[str, Any], robot: Robot, place: str, made: Element) -> None:
    """Write elements in series (L,) into model fields.

    Args:
        fields: model fields of the batch elements.
        robot: robot of `in_series`.
        place: joint with which they are in series.
        made: the elements.
    """
    second = robot.joint(second_of(robot, place))
    inertia = robot.series[second.name]
    dof = robot.joint(place).velocity
    stated = fields["dof_armature"][:, dof]
    drive = np.maximum(stated + made.drive * inertia, LIGHTEST * inertia)
    fields["dof_armature"][:, dof] = drive
    option = robot.compiled.opt
    step = float(fields["opt.timestep"][0] if "opt.timestep" in fields else option.timestep)
    number = fields["opt.integrator"][0] if "opt.integrator" in fields else option.integrator
    stiffness, damping = _stepped(made, inertia, drive, step, int(number) == RK4)
    give = gives(made)
    fields["jnt_stiffness"][:, second.id] = np.where(give, 0.0, stiffness)
    fields["dof_damping"][:, second.velocity] = np.where(give, 0.0, damping)
    if "jnt_range" in fields:
        half = 0.5 * made.gap
        fields["jnt_range"][:, second.id] = np.stack([-half, half], axis=1)
        soft = np.stack([-stiffness, -damping], axis=1)
        fields["jnt_solref"][:, second.id] = np.where(give[:, None], soft, _hard(step))
        fields["jnt_solimp"][:, second.id] = np.where(give[:, None], GIVING, HARD)


def gives(made: Element) -> Flags:
    """Return whether elements (L,) are compliant flanks: a gap with a spring."""
    return (made.gap > 0) & (made.stiffness > 0)


def press(fields: Mapping[str, Any], robot: Robot) -> None:
    """Convert stiffness and damping of compliant flanks to parameters of MuJoCo's limit by (6).

    Args:
        fields: model fields of the batch elements.
        robot: robot of `in_series`.
    """
    for name in robot.series:
        second = robot.joint(name)
        soft = fields["jnt_solimp"][:, second.id, 0] == GIVING[0]
        inverse = fields["dof_invweight0"][soft, second.velocity, None]
        fields["jnt_solref"][soft, second.id] *= inverse  # (6)


def _hard(step: float) -> tuple[float, float]:
    """Return `solref` of rigid flanks: the stiffest value that is stable for a time step."""
    return 2.0 * step, 1.0


def with_flanks(robot: Robot, made: Mapping[str, Element], model: Any = None) -> Robot:
    """Set the joint limits that represent flanks, for writing a model file.

    Args:
        robot: robot of `in_series`.
        made: elements of one batch element, by the joint with which they are in series.
        model: model compiled from the robot with all effects; required for compliant flanks.
    """
    spec, option = robot.spec.copy(), (model or robot.compiled).opt
    joints = {joint.name: joint for joint in spec.joints}
    step, explicit = float(option.timestep), int(option.integrator) == RK4
    for place, one in made.items():
        joint = joints[second_of(robot, place)]
        half = 0.5 * float(one.gap[0])
        if not half:
            continue
        turns = robot.joint(joint.name).kind == "hinge" and spec.compiler.degree
        half = float(np.rad2deg(half)) if turns else half
        joint.range = (-half, half)
        joint.solref_limit, joint.solimp_limit = _hard(step), HARD
        if model is not None and gives(one)[0]:
            inertia, drive = robot.series[joint.name], model.dof_armature
            drive = drive[[robot.joint(place).velocity]]
            numbers = np.stack(_stepped(one, inertia, drive, step, explicit))[:, 0]
            inverse = model.dof_invweight0[robot.joint(joint.name).velocity]
            joint.solref_limit, joint.solimp_limit = -numbers * inverse, GIVING  # (6)
    return replace(robot, spec=spec)


def _stepped(
    made: Element, inertia: float, drive: Array, step: float, explicit: bool
) -> tuple[Array, Array]:
    """Limit stiffness and damping (L,) to values that are stable for a time step.

    Args:
        made: elements in series.
        inertia: inertia of the joint.
        drive: (L,) inertia of the drive.
        step: time step in seconds.
        explicit: whether the integrator treats damping explicitly (Runge-Kutta 4).
    """
    softened = 1.0 / drive + 1.0 / inertia
    most = ((RESOLVED_BY_RK4 if explicit else RESOLVED) / step) ** 2 / softened
    stiffness = np.minimum(made.stiffness, most)
    damping = 2.0 * made.damping * np.sqrt(stiffness * inertia)
    borne = np.minimum(damping, RESOLVED / step / softened)
    if explicit:
        return stiffness, borne
    # If damping is implicit, so is this stiffness, by the backward Euler rule: k (d + h d').
    give = gives(made)
    backward = damping + step * (made.stiffness - stiffness)
    return np.where(give, stiffness, made.stiffness), np.where(give, borne, backward)


def hung(fields: Mapping[str, Any], robot: Robot, loads: Sequence[Array]) -> list[Array]:
    """Compute the rest positions (n,) of joints in series while their drives are held.

    Args:
        fields: model fields of the batch elements.
        robot: robot of `in_series`.
        loads: (n,) load at each of these joints.
    """
    places = []
    for (name, inertia), load in zip(robot.series.items(), loads, strict=True):
        second, n = robot.joint(name), len(load)
        stiffness = fields["jnt_stiffness"][:n, second.id]
        soft = fields["jnt_solimp"][:n, second.id, 0] == GIVING[0]
        inverse = fields["dof_invweight0"][:n, second.velocity]
        pressed = np.where(
            soft, -fields["jnt_solref"][:n, second.id, 0] / inverse, stiffness
        )  # (6)
        half = fields["jnt_range"][:n, second.id, 1]
        on_flank = half * np.clip(load / (UNLOADED * inertia), -1.0, 1.0)
        away = np.where(pressed > 0, load / np.maximum(pressed, 1e-300), 0.0)
        places.append(away + np.where(soft | (stiffness <= 0), on_flank, 0.0))
    return places
