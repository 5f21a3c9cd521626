"""List of the places of a robot at which effects can act.

Places are joints, actuators, bodies, channels, contacts of two geoms, and round geoms in contact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from sims.core.simulator import InputError
from sims.robot.contact_pairs import (
    find_geom,
    find_pair_geoms,
    get_geom_name,
    read_contact_parameters,
)
from sims.robot.coupled_drives import list_coupling_places
from sims.robot.places.centre_of_mass_limits import compute_centre_of_mass_limits
from sims.robot.places.observable_axes import observable_axes, observable_tilts
from sims.robot.robot_model import Actuator, RobotModel

MUJOCO_EFFECT_WORDS = {
    "armature": "inertia.armature",
    "damping": "drag.linear",
    "frictionloss": "friction.coulomb",
    "gear": "input.gain",
    "gravcomp": "gravity.compensation",
    "gravity": "gravity.scale",
    "inertia": "inertia.scale",
    "ipos": "mass.offset",
    "kp": "actuator.stiffness",
    "kv": "actuator.damping",
    "mass": "mass.scale",
    "pos": "link.length",
    "ref": "joint.zero",
    "size": "geom.radius",
    "stiffness": "spring.linear",
}
"""MuJoCo's words for numbers of a model file, and the effects that change them."""

MAX_REDUCTION = 0.99
"""Largest reduction of the time constant of a contact, as a share of it."""

STANDARD_GRAVITY = 9.81
"""Acceleration of gravity in m/s^2, which gives the typical weight of a mass."""


class EffectPlace(NamedTuple):
    """A place at which an effect may act.

    Attributes:
        name: name of the joint, actuator, body, channel, geom or pair of geoms.
        kind: kind of the coordinate whose units apply: hinge or slide; or contact or geom.
        coordinate: index of the coordinate; None if there is none.
        signal: name of the input or channel; empty for a joint or body.
        unit: unit of the signal.
        size: typical force along the coordinate, in N or N m.
        inertia: inertia about the coordinate, in kg or kg m^2.
        stated: values that the model file specifies, by name of the effect that changes them.
        words: name of the place in a sentence.
        servo: whether it is an actuator that follows a position set point.
        last: whether it is the last joint of its body.
        coupled: whether it is a joint whose drive may be coupled to the preceding joint.
        limits: for a body, lowest and highest coefficients by effect and coefficient. Offsets in
            metres leave a centre of mass within the link. A payload may stick out of it: from the
            middle of the link by the longest side of its box, or half the length of the robot's
            longest link. Both ends are zero along an axis where an offset cannot be observed.
        mass: for a body, the mass in kg of all moving bodies.
        tilts: for a joint, the axes of its body's frame about which a tilt of its axis shows in the
            motion.
        pairs: for a contact, the pairs of geoms whose contacts get parameters of their own.
        is_base: whether it is a coordinate of a floating body whose pose is recorded.
        servo_damping: for a joint, the damping by its servos in N s/m or N m s/rad, which acts like
            that of the joint.
    """

    name: str
    kind: str
    coordinate: int | None
    signal: str
    unit: str
    size: float
    inertia: float
    stated: Mapping[str, float]
    words: str
    servo: bool = False
    last: bool = False
    coupled: bool = False
    limits: Mapping[str, Mapping[str, tuple[float, float]]] = MappingProxyType({})
    mass: float = 0.0
    tilts: tuple[str, ...] = ()
    pairs: tuple[str, ...] = ()
    is_base: bool = False
    servo_damping: float = 0.0


def list_places(
    robot: RobotModel, channels: Sequence[tuple[str, str]]
) -> dict[str, list[EffectPlace]]:
    """List the places of a robot by kind: joint, actuator, body, channel, contact, geom.

    A place is where an effect can act. Each has the units and the typical sizes that scale the
    plausible ranges of effects, and what the model file states there. Contacts and geoms are those
    of the recording (`RobotModel.contacts`); of the geoms, only those with a radius.

    Args:
        robot: robot whose places are listed.
        channels: names and units of the channels that it can observe.

    Returns:
        Places by kind, in the order of the joints, actuators and so on.
    """
    joints = _list_joint_places(robot)
    touching = {geom for pair in robot.contacts for geom in find_pair_geoms(robot, pair)}
    return {
        "joint": joints,
        "actuator": _list_actuator_places(robot, joints),
        "body": _list_body_places(robot),
        "channel": [_make_channel_place(name, unit, joints) for name, unit in channels],
        "contact": [make_contact_place(robot, pair, robot.contacts) for pair in robot.contacts],
        "geom": [
            make_geom_place(robot, get_geom_name(robot.compiled, geom))
            for geom in sorted(touching)
            if has_radius(robot, geom)
        ],
    }


def _list_joint_places(robot: RobotModel) -> list[EffectPlace]:
    """List the places of the joints with one coordinate, in the order of the coordinates.

    A place has the unit, the typical force and inertia of its joint, what the model file states
    there, and what kinds of effects it may have.

    Args:
        robot: robot whose joints are listed.
    """
    from sims.robot.dynamics.joint_scales import coefficient_scales

    scales = coefficient_scales(robot)
    # Joints whose drives may also drive the preceding joint.
    may_be_coupled = list_coupling_places(robot)
    bodies = robot.compiled.jnt_bodyid
    # Later joints of a body replace earlier ones in the dict.
    last_joint_of_body = {int(body): joint_id for joint_id, body in enumerate(bodies)}
    return [
        EffectPlace(
            name=joint.name,
            kind=joint.kind,
            coordinate=coordinate,
            signal="",
            unit=joint.unit,
            size=scales.force[coordinate],
            inertia=scales.inertia[coordinate],
            stated=_get_file_values(robot, joint.velocity, joint.id),
            words=f"joint {joint.name}",
            last=last_joint_of_body[int(bodies[joint.id])] == joint.id,
            coupled=joint.name in may_be_coupled,
            tilts=tuple("xyz"[axis] for axis in observable_tilts(robot, joint.name)),
            is_base=joint.name in robot.base_joints,
            servo_damping=sum(
                robot.compute_servo_damping(actuator)
                for actuator in robot.actuators
                if actuator.joint == joint.name and actuator.kind == "position"
            ),
        )
        for coordinate, joint in enumerate(j for j in robot.joints if j.has_one_coordinate)
    ]


def _list_actuator_places(robot: RobotModel, joints: Sequence[EffectPlace]) -> list[EffectPlace]:
    """List the actuators as places, which are like that of the joint that they drive.

    Their units and typical sizes are those of the joint. An actuator on a tendon or a site has
    similar sizes (`_make_actuator_place`). Actuators that act along neither an angle nor a length
    are left out.

    Args:
        robot: robot whose actuators are listed.
        joints: places of its joints.
    """
    mass = _compute_moving_mass(robot)
    joints_by_name = {place.name: place for place in joints}
    places = []
    for actuator in robot.actuators:
        # The place of its joint, or a similar one for a tendon or a site.
        driven_place = joints_by_name.get(actuator.joint or "")
        driven_place = driven_place or _make_actuator_place(actuator, joints, mass)
        if driven_place is None:
            continue
        places.append(
            driven_place._replace(
                name=actuator.name,
                signal=f"u.{actuator.name}",
                unit=actuator.control_unit,
                stated=_get_servo_gains(robot, actuator.id),
                words=f"actuator {actuator.name}",
                servo=actuator.kind == "position" and driven_place.coordinate is not None,
            )
        )
    return places


def _list_body_places(robot: RobotModel) -> list[EffectPlace]:
    """List the moving bodies, with the largest plausible offsets of centre of mass and payload.

    The offsets are boxes in the body's frame, relative to the stated centre of mass. That of the
    centre of mass is the box of the link. That of a payload is a cube about its middle, since a
    payload may stick out of the link: to the longest side of the box, or to half the length of the
    robot's longest link. Along axes in which offsets cannot be observed, both ends are zero.

    Args:
        robot: robot whose bodies are listed.
    """
    mass = _compute_moving_mass(robot)
    # The length of a link is the distance of its body from the parent body. Body 0 is the world.
    longest_link = float(np.linalg.norm(robot.compiled.body_pos[1:], axis=1).max(initial=0.0))
    places = []
    for body in robot.bodies:
        link_box = compute_centre_of_mass_limits(robot, body.name)  # (3, 2) lowest and highest
        box_centre = link_box.mean(axis=1)
        payload_reach = max(float(np.ptp(link_box, axis=1).max()), 0.5 * longest_link)
        payload_box = np.stack([box_centre - payload_reach, box_centre + payload_reach], axis=1)
        is_observed = np.isin(range(3), observable_axes(robot, body.name))
        limits = {}
        for effect, box in (("mass.offset", link_box), ("payload", payload_box)):
            ends = np.where(is_observed[:, None], box, 0.0).tolist()
            limits[effect] = {
                axis: (low, high) for axis, (low, high) in zip("xyz", ends, strict=True)
            }
        # Kind, size and inertia, which belong to a coordinate, do not matter to effects at bodies.
        places.append(
            EffectPlace(
                name=body.name,
                kind="hinge",
                coordinate=None,
                signal="",
                unit="kg",
                size=1.0,
                inertia=1.0,
                stated=_get_body_file_values(robot, body.id),
                words=f"body {body.name}",
                limits=limits,
                mass=mass,
            )
        )
    return places


def _make_channel_place(name: str, unit: str, joints: Sequence[EffectPlace]) -> EffectPlace:
    """Make the place of a channel, with kind and size of the joint that it shows, if it shows one.

    Args:
        name: name of the channel, such as ``q.elbow`` or ``s.gyro``.
        unit: its unit.
        joints: places of the joints.
    """
    quantity, _, joint_name = name.partition(".")
    joint = next((place for place in joints if place.name == joint_name), None)
    place = EffectPlace(
        name=name,
        kind="hinge",
        coordinate=None,
        signal=name,
        unit=unit,
        size=1.0,
        inertia=1.0,
        stated={},
        words=f"channel {name}",
    )
    if joint is None or quantity not in ("q", "qd", "tau"):
        return place
    return place._replace(kind=joint.kind, coordinate=joint.coordinate, size=joint.size)


def _compute_moving_mass(robot: RobotModel) -> float:
    """Return the mass of all moving bodies, kg."""
    return sum(body.mass for body in robot.bodies)


def make_contact_place(robot: RobotModel, pair: str, pairs: tuple[str, ...]) -> EffectPlace:
    """Return the contact of two geoms as a place at which effects can act.

    It has the friction that the model file states, and how much stiffer the contact may become: its
    time constant is reduced by at most `MAX_REDUCTION`, and not below MuJoCo's minimum. The limit
    is the lowest relative change of the time constant, such as -0.99.

    Args:
        robot: model of the robot.
        pair: name of the pair of geoms.
        pairs: pairs whose contacts get parameters of their own in the same model.

    Raises:
        InputError: there are no such geoms.
    """
    import mujoco

    friction, solref = read_contact_parameters(robot, pair)
    options = robot.compiled.opt
    time_constant = float(solref[0])  # negative if `solref` is a stiffness and a damping
    min_softness_change = -MAX_REDUCTION
    has_minimum = not options.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE
    if has_minimum and time_constant > 0:
        # MuJoCo uses no smaller time constant than two time steps, by default.
        change_to_minimum = 2.0 * options.timestep / time_constant - 1.0
        min_softness_change = max(min_softness_change, min(change_to_minimum, 0.0))
    names = [get_geom_name(robot.compiled, geom) for geom in find_pair_geoms(robot, pair)]
    # Size and inertia are those of a coordinate, which a contact does not have.
    return EffectPlace(
        name=pair,
        kind="contact",
        coordinate=None,
        signal="",
        unit="1",
        size=1.0,
        inertia=1.0,
        stated={"contact.friction": friction},
        words=f"the contact of {' and '.join(names)}",
        limits={"contact.softness": {"coefficient": (min_softness_change, np.inf)}},
        pairs=pairs,
    )


def has_radius(robot: RobotModel, geom: int) -> bool:
    """Return whether a geom is a sphere, capsule, ellipsoid or cylinder of a moving body.

    Such a geom, for example a wheel, may have a wrong radius in the model file that shows in the
    motion.

    Args:
        robot: Robot with its compiled model.
        geom: Index of the geom.
    """
    import mujoco

    kinds = mujoco.mjtGeom
    model = robot.compiled
    is_round = int(model.geom_type[geom]) in (
        int(kinds.mjGEOM_SPHERE),
        int(kinds.mjGEOM_CAPSULE),
        int(kinds.mjGEOM_ELLIPSOID),
        int(kinds.mjGEOM_CYLINDER),
    )
    return is_round and int(model.body_weldid[model.geom_bodyid[geom]]) != 0


def make_geom_place(robot: RobotModel, name: str) -> EffectPlace:
    """Make the place of a geom with a radius, such as a wheel, whose radius may be wrong.

    Args:
        robot: robot with the geom.
        name: name of the geom.

    Raises:
        InputError: there is no such geom, or it has no radius.
    """
    geom = find_geom(robot, name)
    if not has_radius(robot, geom):
        raise InputError(f"robot {robot.name}: geom {name} has no radius")
    radius = float(robot.compiled.geom_size[geom, 0])
    # Size and inertia are those of a coordinate, which a geom does not have.
    return EffectPlace(
        name=name,
        kind="geom",
        coordinate=None,
        signal="",
        unit="1",
        size=1.0,
        inertia=1.0,
        stated={"geom.radius": radius},
        words=f"geom {name}",
    )


def _make_actuator_place(
    actuator: Actuator, joints: Sequence[EffectPlace], mass: float
) -> EffectPlace | None:
    """Return the place of an actuator on a tendon or a site, with typical sizes like a joint's.

    Its typical force and inertia are the largest ones of the joints that its tendon moves. At a
    site, or on a tendon without joints, they are the weight and the mass of the robot.

    Args:
        actuator: an actuator that drives no single joint.
        joints: places of the joints.
        mass: mass in kg of all moving bodies.

    Returns:
        The place; None if the actuator acts along neither an angle nor a length.
    """
    if actuator.motion is None:
        return None
    moved_joints = [place for place in joints if place.name in actuator.moves]
    size = max((place.size for place in moved_joints), default=STANDARD_GRAVITY * mass)
    inertia = max((place.inertia for place in moved_joints), default=mass)
    # The caller replaces the signal, the unit, the stated numbers and the words.
    return EffectPlace(
        name=actuator.name,
        kind=actuator.motion,
        coordinate=None,
        signal="",
        unit="",
        size=size,
        inertia=inertia,
        stated={},
        words="",
    )


def _get_servo_gains(robot: RobotModel, actuator: int) -> dict[str, float]:
    """Return the negative servo gains of an actuator in the model file; zero if it is not a servo.

    MuJoCo's bias parameters hold them: the force on a servo per unit of its position and velocity.

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        actuator: number of the actuator.

    Returns:
        The two numbers by name of the effect that changes them.
    """
    _, stiffness, damping, *_ = robot.compiled.actuator_biasprm[actuator].tolist()
    return {"actuator.stiffness": stiffness, "actuator.damping": damping}


def _get_body_file_values(robot: RobotModel, body: int) -> dict[str, float]:
    """Return the gravity compensation of a body, and the length of the link that carries it, in m.

    The length is the distance from its parent body. It is zero if the parent does not move, since
    another distance would then only move the whole robot.

    Args:
        robot: robot with the body.
        body: number of the body in the compiled model.

    Returns:
        The two numbers by name of the effect that changes them.
    """
    model = robot.compiled
    has_moving_parent = int(model.body_weldid[model.body_parentid[body]]) != 0
    return {
        "gravity.compensation": float(model.body_gravcomp[body]),
        "link.length": float(np.linalg.norm(model.body_pos[body])) if has_moving_parent else 0.0,
    }


def _get_file_values(robot: RobotModel, dof: int, joint: int) -> dict[str, float]:
    """Return the numbers that the model file specifies at a joint, by effect.

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        dof: address of the joint's velocity.
        joint: number of the joint in the compiled model.

    Returns:
        Numbers by name of the effect that changes them, such as ``drag.linear``.
    """
    model = robot.compiled
    return {
        "drag.linear": float(model.dof_damping[dof]),
        "friction.coulomb": float(model.dof_frictionloss[dof]),
        "inertia.armature": float(model.dof_armature[dof]),
        "spring.linear": float(model.jnt_stiffness[joint]),
        "drag.quadratic": float(np.ravel(model.dof_dampingpoly[dof])[0]),
    }
