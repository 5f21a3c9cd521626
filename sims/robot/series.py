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

with shares of inertia and damping counted by M_jj in the pose that the file states (q = 0 where it
states none), so MuJoCo integrates it as it does any joint, and a model file can say it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from sims.base import Array
from sims.robot.model import Robot
from sims.robot.native import RK4
from sims.robot.quiet import quiet
from sims.system import Acting, Effect, Element, Hidden

LIGHTEST = 0.01
"""Share of the joint's inertia that a drive has at least: without any, nothing holds x."""
SLIGHT = 1e-4
"""The same while a model is compiled."""
RESOLVED, RESOLVED_BY_RK4 = 1.2, 2.0
"""Radians of the swing of drive and links against each other in a step, at most."""
HARD = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""`solimp` of flanks: as hard as MuJoCo allows."""
UNLOADED = 1e-3
"""Share of a typical force below which a load leaves the links between the flanks."""
FIELDS = ("dof_armature", "jnt_stiffness", "dof_damping", "jnt_range", "jnt_solref", "jnt_solimp")
"""Of the model, that are written for it."""

Added = tuple[tuple[str, str], ...]
"""Joints, and the name of the effect that each has in series."""


def name_of(joint: str, effect: str) -> str:
    """What the second joint is called: ``elbow_flexibility``."""
    return f"{joint}_{effect.rpartition('.')[2]}"


def by_series(acting: Acting, count: int) -> dict[Added, list[int]]:
    """Lanes by what acts in series with joints in them."""
    lanes: dict[Added, list[int]] = {}
    there = [(e, (c[0] > 0)[:, 0]) for e, c in acting if is_series(e)]
    for lane in range(count):
        added = tuple((e.place, e.of) for e, on in there if on[lane])
        lanes.setdefault(added, []).append(lane)
    return lanes


def twice(added: Added) -> bool:
    """Whether one joint has two in series: nothing with an inertia lies between them."""
    return len({joint for joint, _ in added}) < len(added)


@lru_cache(maxsize=128)
def in_series(robot: Robot, added: Added) -> Robot:
    """The robot with more joints; elements keep the names that the robot has for them.

    Args:
        robot: that was read.
        added: joints, each the last one of its body, and the effect that each has in series.
    """
    import mujoco

    with quiet():
        spec = robot.spec.copy()
        spec.compile()
    joints = {joint.id: joint for joint in spec.joints}
    _named(spec, robot, joints)
    inertias = _inertias(robot)
    for name, effect in added:
        first = joints[robot.joint(name).id]
        # Whatever the file's defaults say is said of the first joint alone.
        nothing = {"damping": 0.0, "frictionloss": 0.0, "armature": 0.0, "stiffness": 0.0}
        second = first.parent.add_joint(
            name=name_of(name, effect), type=first.type, axis=first.axis, pos=first.pos
        )
        for attribute, value in nothing.items():
            setattr(second, attribute, np.full_like(getattr(second, attribute), value))
        second.springdamper = (0.0, 0.0)
        second.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        play = effect.endswith("backlash")
        limited = mujoco.mjtLimited
        second.limited = limited.mjLIMITED_TRUE if play else limited.mjLIMITED_FALSE
        if play:
            second.range = (-1.0, 1.0)
        # Lanes have more; here it only has to compile.
        first.armature = max(first.armature, SLIGHT * inertias[name])
    # Poses that are kept lack the new coordinates.
    for key in list(spec.keys):
        spec.delete(key)
    series = {name_of(name, effect): inertias[name] for name, effect in added}
    return replace(robot, spec=spec, series=series)


@lru_cache(maxsize=8)
def _inertias(robot: Robot) -> dict[str, float]:
    """About each joint, in the pose that the file states."""
    import mujoco

    model = robot.compiled
    data, whole = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, whole)
    return {j.name: float(whole[j.velocity, j.velocity]) for j in robot.joints if j.single}


def _named(spec: Any, robot: Robot, joints: Mapping[int, Any]) -> None:
    """Write down the names of what has none: they count, and counts change."""
    for joint in robot.joints:
        joints[joint.id].name = joint.name
    for actuator in spec.actuators:
        actuator.name = robot.actuators[actuator.id].name


def is_series(effect: Effect | type[Effect]) -> bool:
    """Whether it is an element in series with a joint."""
    kind = effect if isinstance(effect, type) else type(effect)
    return issubclass(kind, Hidden) and bool(kind.between)


def write(fields: Mapping[str, Any], robot: Robot, effect: Effect, c: Array) -> None:
    """Write an effect in series with a joint into the fields of lanes.

    Args:
        fields: of the lanes' models.
        robot: of `in_series`.
        effect: at its place.
        c: (K, L) its coefficients there.
    """
    numbers = dict(zip((one.name for one in effect.coefficients), c, strict=True))
    state(fields, robot, effect.place, effect.of, element(type(effect), numbers))


def element(kind: type[Effect], numbers: Mapping[str, Array]) -> Element:
    """The element that an effect is by its coefficients (L,); those that a place lacks are zero."""
    assert issubclass(kind, Hidden)
    first = next(iter(numbers.values()))
    values = [numbers.get(one.name, np.zeros_like(first)) for one in kind.between]
    return kind().element(np.stack(values))


def state(fields: Mapping[str, Any], robot: Robot, place: str, effect: str, made: Element) -> None:
    """Write elements (L,) into fields of models.

    Args:
        fields: of the models.
        robot: of `in_series`.
        place: the joint with which they are in series.
        effect: the name of what they are.
        made: they.
    """
    second = robot.joint(name_of(place, effect))
    inertia = robot.series[second.name]
    dof = robot.joint(place).velocity
    stated = fields["dof_armature"][:, dof]
    drive = np.maximum(stated + made.drive * inertia, LIGHTEST * inertia)
    fields["dof_armature"][:, dof] = drive
    option = robot.compiled.opt
    step = float(fields["opt.timestep"][0] if "opt.timestep" in fields else option.timestep)
    number = fields["opt.integrator"][0] if "opt.integrator" in fields else option.integrator
    stiffness, damping = _stepped(made, inertia, drive, step, int(number) == RK4)
    fields["jnt_stiffness"][:, second.id] = stiffness
    fields["dof_damping"][:, second.velocity] = damping
    if "jnt_range" in fields:
        half = 0.5 * made.gap
        fields["jnt_range"][:, second.id] = np.stack([-half, half], axis=1)
        fields["jnt_solref"][:, second.id] = _hard(step)
        fields["jnt_solimp"][:, second.id] = HARD


def _hard(step: float) -> tuple[float, float]:
    """`solref` of flanks: as stiff as a step bears."""
    return 2.0 * step, 1.0


def with_flanks(robot: Robot, gaps: Mapping[str, float]) -> Robot:
    """The robot of `in_series` whose file is to state these gaps, by name of the second joint."""
    spec = robot.spec.copy()
    for joint in spec.joints:
        if joint.name not in gaps:
            continue
        half = 0.5 * gaps[joint.name]
        turns = robot.joint(joint.name).kind == "hinge" and spec.compiler.degree
        half = float(np.rad2deg(half)) if turns else half
        joint.range = (-half, half)
        joint.solref_limit = _hard(float(robot.compiled.opt.timestep))
        joint.solimp_limit = HARD
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
    if explicit:
        return stiffness, np.minimum(damping, RESOLVED / step / softened)
    # Where dampings are implicit so is a stiffness, by the backward rule: k (d + h d').
    return made.stiffness, damping + step * (made.stiffness - stiffness)


def hung(fields: Mapping[str, Any], robot: Robot, loads: Sequence[Array]) -> list[Array]:
    """(n,) of each joint in series where it rests while its drive is held.

    Args:
        fields: of the lanes' models.
        robot: of `in_series`.
        loads: (n,) what pulls at each of them.
    """
    places = []
    for (name, inertia), load in zip(robot.series.items(), loads, strict=True):
        number, n = robot.joint(name).id, len(load)
        stiffness = fields["jnt_stiffness"][:n, number]
        half = fields["jnt_range"][:n, number, 1]
        on_flank = half * np.clip(load / (UNLOADED * inertia), -1.0, 1.0)
        places.append(np.where(stiffness > 0, load / np.maximum(stiffness, 1e-300), on_flank))
    return places
