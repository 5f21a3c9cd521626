"""A joint that yields or has play: a second joint in series with it, in the same body.

With x the joint's position on the side of its drive, where actuator, encoder, stated damping and
dry friction are, y that of the links that it carries, J the drive's inertia (the armature) and T
what passes between them,

    J x'' = U - T                                                          (1)
    (M(q) q'' + n(q, q'))_j = T,  q_j = y                                  (2)

(M. W. Spong, J. Dyn. Syst. Meas. Control 109(4), 310 (1987), doi:10.1115/1.3143860). A second
joint d = y - x about the same axis makes the body's position y, and

    T = -k d - c d'         of a spring with a damper                      (3)
    |d| <= gap / 2          of flanks, which MuJoCo's limit holds          (4)
    T = -k e - c d'         of both: flanks that give, e what d exceeds    (5)

with shares of inertia and damping counted by M_jj in the pose that the file states (q = 0 where it
states none), so MuJoCo integrates it as it does any joint, and a model file can say it. Of (5), T
pushes only, and is nothing between the flanks. A limit of MuJoCo with impedance s exerts

    -(K e + C d') / (A + R), R = (1 - s) A0 / s                            (6)

for `solref` (-K s, -C s), A being the inverse inertia along d and A0 that of the pose of the file
(MuJoCo's documentation, "Computation", constraint model): at the least s, 1e-4, a spring of K s /
A0 with an error of the size of s.
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
"""Share of the joint's inertia that a drive has at least: without any, nothing holds x."""
SLIGHT = 1e-4
"""The same while a model is compiled."""
RESOLVED, RESOLVED_BY_RK4 = 1.2, 2.0
"""Radians of the swing of drive and links against each other in a step, at most."""
HARD = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""`solimp` of flanks: as hard as MuJoCo allows."""
GIVING = (1e-4, 1e-4, 0.001, 0.5, 2.0)
"""The same of flanks that give as a spring does: as soft as MuJoCo allows, see (6)."""
UNLOADED = 1e-3
"""Share of a typical force below which a load leaves the links between the flanks."""
WRITTEN = ("dof_armature", "jnt_stiffness", "dof_damping", "jnt_range", "jnt_solref", "jnt_solimp")
"""Fields of the model that are written for it."""
FIELDS = (*WRITTEN, "dof_invweight0")
"""The same, and what MuJoCo derives that is read for it."""

Flags = NDArray[np.bool_]

Added = tuple[tuple[str, str], ...]
"""Joints, and the name of an effect that each has in series; a joint may have several."""


def name_of(joint: str, effects: Collection[str]) -> str:
    """What the second joint is called: ``elbow_flexibility``, ``elbow_transmission`` of several."""
    kind = next(iter(effects)).rpartition(".")[2] if len(effects) == 1 else "transmission"
    return f"{joint}_{kind}"


def second_of(robot: Robot, joint: str) -> str:
    """The name of the one that is in series with a joint; empty where none is."""
    return next((name for name in robot.series if name.rpartition("_")[0] == joint), "")


def by_joint(added: Added) -> dict[str, list[str]]:
    """The effects in series with each joint."""
    effects: dict[str, list[str]] = {}
    for joint, effect in added:
        effects.setdefault(joint, []).append(effect)
    return effects


def by_series(acting: Acting, count: int) -> dict[Added, list[int]]:
    """Lanes by what acts in series with joints in them."""
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
    """The robot with more joints; elements keep the names that the robot has for them.

    Args:
        robot: that was read.
        added: joints, each the last one of its body, and the effect that each has in series; and
            whether drives are coupled.
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
        # Whatever the file's defaults say is said of the first joint alone.
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
        # Lanes have more; here it only has to compile.
        first.armature = max(first.armature, SLIGHT * inertias[name])
    # Poses that are kept lack the new coordinates.
    for key in list(spec.keys):
        spec.delete(key)
    series = {name_of(name, own): inertias[name] for name, own in by_joint(added).items()}
    return replace(robot, spec=spec, series=series)


@kept_with_robot
def compile_error(robot: Robot, added: Added) -> str:
    """Say why the model with more joints does not compile; empty where it does.

    Args:
        robot: that was read.
        added: as for `in_series`.
    """
    try:
        in_series(strip_shapes(robot), added).compiled  # noqa: B018
    # MuJoCo has errors of several kinds, and an effect of a user's plugin may raise any.
    except Exception as error:
        return one_line(error) or type(error).__name__
    return ""


@kept_with_robot
def _inertias(robot: Robot) -> dict[str, float]:
    """About each joint, in the pose that the file states."""
    inertias = np.diagonal(inertia_matrix(robot.compiled)).tolist()
    return {j.name: inertias[j.velocity] for j in robot.joints if j.single}


def is_series(effect: Effect | type[Effect]) -> bool:
    """Whether it is an element in series with a joint."""
    kind = effect if isinstance(effect, type) else type(effect)
    return issubclass(kind, Hidden) and bool(kind.between)


def write(fields: Mapping[str, Any], robot: Robot, acting: Acting) -> None:
    """Write effects in series with joints into the fields of lanes; `press` follows once MuJoCo has
    derived what it does.

    Args:
        fields: of the lanes' models.
        robot: of `in_series`.
        acting: effects with coefficients (K, L, 1), of which others are left alone.
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
    """The element that an effect is by its coefficients (L,); those that a place lacks are zero."""
    assert issubclass(kind, Hidden)
    first = next(iter(numbers.values()))
    values = [numbers.get(one.name, np.zeros_like(first)) for one in kind.between]
    return kind().element(np.stack(values))


def together(elements: Sequence[Element]) -> Element:
    """What lies between one drive and its links as one element: gap first, then the spring."""
    names = ("stiffness", "damping", "gap", "drive")
    return Element(*(np.sum([getattr(e, name) for e in elements], axis=0) for name in names))


def state(fields: Mapping[str, Any], robot: Robot, place: str, made: Element) -> None:
    """Write elements (L,) into fields of models.

    Args:
        fields: of the models.
        robot: of `in_series`.
        place: the joint with which they are in series.
        made: they.
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
    """(L,) whether it is flanks that give as a spring does."""
    return (made.gap > 0) & (made.stiffness > 0)


def press(fields: Mapping[str, Any], robot: Robot) -> None:
    """Turn stiffness and damping of flanks that give into what MuJoCo's limit takes for them; see
    (6).
    """
    for name in robot.series:
        second = robot.joint(name)
        soft = fields["jnt_solimp"][:, second.id, 0] == GIVING[0]
        inverse = fields["dof_invweight0"][soft, second.velocity, None]
        fields["jnt_solref"][soft, second.id] *= inverse  # (6)


def _hard(step: float) -> tuple[float, float]:
    """`solref` of flanks: as stiff as a step bears."""
    return 2.0 * step, 1.0


def with_flanks(robot: Robot, made: Mapping[str, Element], model: Any = None) -> Robot:
    """The robot of `in_series` whose file is to state flanks.

    Args:
        robot: of `in_series`.
        made: elements of one lane, by the joint with which they are in series.
        model: that is compiled of it, with all that acts; those that give are told by it.
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
    """Stiffness and damping (L,) as a step bears them: it would let a swing that it does not
    resolve explode.
    """
    softened = 1.0 / drive + 1.0 / inertia
    most = ((RESOLVED_BY_RK4 if explicit else RESOLVED) / step) ** 2 / softened
    stiffness = np.minimum(made.stiffness, most)
    damping = 2.0 * made.damping * np.sqrt(stiffness * inertia)
    borne = np.minimum(damping, RESOLVED / step / softened)
    if explicit:
        return stiffness, borne
    # Where dampings are implicit so is a stiffness, by the backward rule: k (d + h d').
    give = gives(made)
    backward = damping + step * (made.stiffness - stiffness)
    return np.where(give, stiffness, made.stiffness), np.where(give, borne, backward)


def hung(fields: Mapping[str, Any], robot: Robot, loads: Sequence[Array]) -> list[Array]:
    """(n,) of each joint in series where it rests while its drive is held.

    Args:
        fields: of the lanes' models.
        robot: of `in_series`.
        loads: (n,) what pulls at each of them.
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
