"""Effects at the joints of a robot: which of them act where, and which are alike."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from bench.gap.model.noise import Noise
from bench.gap.model.world import World
from sims.robot.loops import coupled_joints
from sims.robot.series import is_series
from sims.robot.simulator import RobotSimulator
from sims.system import members_of

JOINT_MODEL = ("friction.coulomb", "drag.linear", "inertia.armature")
"""Effects at a joint that are tried at the joint where most is missing."""
SERVO_MODEL = ("actuator.stiffness", "actuator.damping")
"""Effects at a servo that are tried at the servo of this joint."""
MANY_SHAPES = frozenset(
    {
        "force.periodic",
        "force.ripple",
        "friction.position",
        "friction.stribeck",
        "friction.warming",
        "sensor.slip",
        "state.limit",
    }
)
"""Effects that are tried at many shapes, and only where plain ones leave a force missing."""
OFFSET_THRESHOLD = 10.0
"""Multiple of the noise from which a difference of positions is an offset of an encoder."""


def joint_name(world: World, joint: int) -> str:
    """Return the name of a joint by its number."""
    coordinate: str = world.simulator.system.coordinates[joint]
    return coordinate.removeprefix("q.")


def servo_input(world: World, joint: int) -> str:
    """Return the input of the position servo of a joint; empty where it has none."""
    return str(getattr(world.simulator.system, "servos", {}).get(joint, ""))


def acts_at(world: World, name: str, joints: Collection[int]) -> bool:
    """Whether an effect acts at one of some joints."""
    names = {joint_name(world, joint) for joint in joints}
    return any(
        member.coordinate in joints or member.signal.partition(".")[2] in names
        for member in members_of(world.effects[name])
    )


def plain_effects_beside(world: World, name: str) -> set[str]:
    """Return the effects of the joint and servo models at the joint where an effect acts."""
    count = len(world.simulator.system.coordinates)
    joints = {joint for joint in range(count) if acts_at(world, name, {joint})}
    return {
        other
        for other in world.library
        if other.partition("@")[0] in JOINT_MODEL + SERVO_MODEL
        and not other.endswith("@*")
        and acts_at(world, other, joints)
    }


def at_coupled_joints(world: World, name: str) -> list[str]:
    """Return an effect's names at the other joints of its loop, where it may do the same: a filter
    tells little of joints that are not measured.
    """
    law, _, place = name.partition("@")
    count = len(world.simulator.system.coordinates)
    joints = {joint_name(world, joint): joint for joint in range(count)}
    if place not in joints:
        return []
    assert isinstance(world.simulator, RobotSimulator)
    velocities = world.simulator.addresses.velocities.tolist()
    groups = coupled_joints(world.simulator.wide().model, velocities)
    others = {joint for group in groups if joints[place] in group for joint in group}
    names = [f"{law}@{joint_name(world, joint)}" for joint in sorted(others - {joints[place]})]
    return [other for other in names if other in world.slots]


def has_series(world: World, names: Iterable[str]) -> bool:
    """Whether some effects are joints in series with others, which have states of their own."""
    return any(is_series(world.effects[name]) for name in names)


def has_many_shapes(name: str) -> bool:
    """Whether an effect is one of `MANY_SHAPES`."""
    return name.partition("@")[0] in MANY_SHAPES


def offset_from_command(world: World, noise: Noise, joint: int) -> float:
    """Return the mean difference of a joint's readings from the command of its position servo; zero
    without a servo, or where the difference is small.
    """
    system, servo = world.simulator.system, servo_input(world, joint)
    channel = system.coordinates[joint]
    if not servo or channel not in world.channels:
        return 0.0
    column = world.channels.index(channel)
    differences = [
        track.observed[:, column] - system.gear(joint) * track.scenario.inputs[servo]
        for track in world.tracks
        if servo in track.scenario.inputs
    ]
    offset = float(np.nanmean(np.concatenate(differences))) if differences else 0.0
    return offset if abs(offset) > OFFSET_THRESHOLD * noise.sigma[column] else 0.0
