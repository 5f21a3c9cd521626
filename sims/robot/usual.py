"""What a robot is usually told and shows, where the user does not say: commands about its pose that
move every joint, within the limits of controls and joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sims.robot.model import Actuator, Joint, Robot
from sims.robot.quiet import quiet
from sims.robot.scales import scales
from sims.system import UsualRecording

SWING = {"hinge": 0.4, "slide": 0.1}
"""rad or m that a joint is moved to either side, where its range allows."""
SHARE = 0.25
"""Of a range, that is swung through at most."""
ROOM = 0.8
"""Of what is left of a joint's range to the nearer side."""
HEAVY = 0.5
"""Of the largest force of gravity on a joint, that it is swung with at least."""
SLOW, FAST = 0.3, 2.0
"""Hz, the lowest and the highest frequency of a command."""
MIDDLE = 2.0 * np.pi * np.sqrt(SLOW * FAST)
"""rad/s, between them."""
SECONDS = 4.0
"""That commands are tried for."""
TRIES = 6
"""Sizes of commands that are tried, each half the one before."""


class Command(NamedTuple):
    """A command: the input's name, what it swings about, how far, and its address, that of a
    control or of a generalised force.
    """

    name: str
    centre: float
    size: float
    address: int

    def text(self, share: float) -> str:
        """As a signal, with so much of its size."""
        swing = f"multisine:{share * self.size:.4g}:{SLOW:g}:{FAST:g}"
        return f"{self.centre:.6g} + {swing}" if self.centre else swing


class Usual:
    """The usual recording of a robot's system, made when it is first asked for."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = f"_made_{name}"

    def __get__(self, _instance: object, owner: Any) -> UsualRecording:
        # In the class itself: what it inherits is another robot's.
        if self._name not in vars(owner):
            setattr(owner, self._name, usual(owner.robot))
        made: UsualRecording = vars(owner)[self._name]
        return made


def usual(robot: Robot) -> UsualRecording:
    """Every joint's position, at commands that swing each joint about the pose of the file.

    A servo is told positions or velocities; a motor gets the force that holds the pose and, beside
    it, one that would swing a free joint. A robot without actuators is pushed at its joints.
    """
    joints = [joint for joint in robot.joints if joint.single]
    commands = _commands(robot, joints)
    shares = [0.5**k for k in range(TRIES)]
    with quiet():
        # What leaves its range at any size is not driven out by its commands.
        share = next((s for s in shares if _stays(robot, joints, commands, s)), 1.0)
    observe = tuple(f"q.{joint.name}" for joint in joints)
    return UsualRecording(observe=observe, inputs={c.name: c.text(share) for c in commands})


def _commands(robot: Robot, joints: Sequence[Joint]) -> list[Command]:
    holding, forces = _at_pose(robot, joints)
    driven = {joint.name: joint for joint in joints}
    commands = []
    for actuator in robot.actuators:
        if actuator.joint in driven:
            joint = driven[actuator.joint]
            held, force = holding[joint.name], forces[joint.name]
            commands.append(_command(robot, actuator, joint, held, force))
    if commands:
        return commands
    return [Command(f"force.{j.name}", holding[j.name], forces[j.name], j.velocity) for j in joints]


def _at_pose(robot: Robot, joints: Sequence[Joint]) -> tuple[dict[str, float], dict[str, float]]:
    """By joint the force that holds the pose of the file, and one that swings the joint."""
    import mujoco

    model = robot.compiled
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    bias = data.qfrc_bias - data.qfrc_passive
    sizes = scales(robot)
    holding, forces = {}, {}
    for number, joint in enumerate(joints):
        holding[joint.name] = float(bias[joint.velocity])
        swing = _swing(joint, float(model.qpos0[joint.position]))
        # Of a free joint, in the middle of the frequencies; gravity holds others back.
        free = sizes.inertia[number] * MIDDLE**2 * swing
        forces[joint.name] = float(max(free, HEAVY * sizes.force[number]))
    return holding, forces


def _swing(joint: Joint, start: float) -> float:
    """How far a joint is to move to either side."""
    swing = SWING[joint.kind]
    if joint.range is None:
        return swing
    low, high = joint.range
    room = ROOM * min(start - low, high - start)
    return min(swing, SHARE * (high - low), room if room > 0 else swing)


def _command(
    robot: Robot, actuator: Actuator, joint: Joint, holding: float, force: float
) -> Command:
    """The command of an actuator."""
    model = robot.compiled
    start = float(model.qpos0[joint.position])
    swing = _swing(joint, start)
    if actuator.kind in ("position", "pid"):
        centre, size = start, swing
    elif actuator.kind == "velocity":
        centre, size = 0.0, MIDDLE * swing
    else:
        gain = float(model.actuator_gear[actuator.id, 0] * model.actuator_gainprm[actuator.id, 0])
        gain = gain or 1.0
        centre, size = holding / gain, force / abs(gain)
    if actuator.range is not None:
        low, high = actuator.range
        centre = min(max(centre, low), high)
        room = min(centre - low, high - centre)
        # At the end of what it can be told it is told to come back from there.
        if room < SHARE * size:
            centre = 0.5 * (low + high)
            room = 0.5 * (high - low)
        size = min(size, room)
    return Command(f"u.{actuator.name}", centre, size, actuator.control)


def _stays(
    robot: Robot, joints: Sequence[Joint], commands: Sequence[Command], share: float
) -> bool:
    """Whether no joint leaves its range at so much of the commands, all of them in phase."""
    import mujoco

    model = robot.compiled
    data = mujoco.MjData(model)
    limited = [joint for joint in joints if joint.range is not None]
    places = [joint.position for joint in limited]
    low, high = np.array([joint.range for joint in limited]).reshape(-1, 2).T
    # Where it begins it may be: a file's pose need not heed the file's limits.
    low, high = np.minimum(low, model.qpos0[places]), np.maximum(high, model.qpos0[places])
    told: Any = data.ctrl if any(c.name.startswith("u.") for c in commands) else data.qfrc_applied
    addresses = [c.address for c in commands]
    centres = np.array([c.centre for c in commands])
    sizes = share * np.array([c.size for c in commands])
    for k in range(int(SECONDS / model.opt.timestep)):
        told[addresses] = centres + sizes * np.sin(MIDDLE * k * model.opt.timestep)
        mujoco.mj_step(model, data)
        at = data.qpos[places]
        if not np.isfinite(data.qpos).all() or (at < low).any() or (at > high).any():
            return False
    return True
