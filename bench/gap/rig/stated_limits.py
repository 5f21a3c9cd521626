"""Limits that a robot's model file states: of commands, positions, velocities and forces.

An MJCF states joint ranges, force limits of joints (`actuatorfrcrange`), control ranges and force
ranges of actuators. A URDF states joint ranges, efforts and velocities; MuJoCo does not compile the
velocities, so they are read from the file (`sims.robot.urdf.speeds`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.gap.model.world import World

Interval = tuple[float, float]
UNLIMITED: Interval = (-np.inf, np.inf)


@dataclass(frozen=True)
class StatedLimits:
    """Limits of a robot's model file; empty for a system without one.

    Attributes:
        commands: lowest and highest value of each limited input, in its unit. What an actuator of a
            joint is commanded keeps to its control range and to the limits of the joint: a torque
            to effort and force range, a set point to the joint's range or velocity.
        positions: of limited joints, by channel ``q.JOINT``, rad or m.
        velocities: of limited joints, by channel ``qd.JOINT``, rad/s or m/s.
        forces: of limited joints, by channel ``tau.JOINT``, N m or N; infinite where the simulation
            limits the force of every actuator of the joint by itself.
    """

    commands: Mapping[str, Interval] = field(default_factory=dict)
    positions: Mapping[str, Interval] = field(default_factory=dict)
    velocities: Mapping[str, Interval] = field(default_factory=dict)
    forces: Mapping[str, Interval] = field(default_factory=dict)

    @property
    def states(self) -> Mapping[str, Interval]:
        """Limits of positions and velocities, by name of the state."""
        return {**self.positions, **self.velocities}

    @property
    def channels(self) -> Mapping[str, Interval]:
        """Limits of all channels, by name."""
        return {**self.states, **self.forces}


def stated_limits(world: World) -> StatedLimits:
    """Read the limits that the model file of the recorded robot states."""
    if not world.kind.has_model:
        return StatedLimits()
    kind: Any = world.kind
    robot = kind.robot
    joints = {joint.name: joint for joint in robot.joints if joint.single}
    forces = {}
    for name, joint in joints.items():
        drives = [actuator for actuator in robot.actuators if actuator.joint == name]
        if joint.effort is not None:
            forces[f"tau.{name}"] = _effort(robot, joint)
        elif drives and all(actuator.force is not None for actuator in drives):
            forces[f"tau.{name}"] = UNLIMITED
    commands = {f"u.{actuator.name}": _command(robot, actuator) for actuator in robot.actuators}
    commands |= {f"force.{name}": _effort(robot, joint) for name, joint in joints.items()}
    return StatedLimits(
        {name: interval for name, interval in commands.items() if interval != UNLIMITED},
        {f"q.{name}": joint.range for name, joint in joints.items() if joint.range},
        {f"qd.{name}": (-v, v) for name, v in robot.speeds.items() if name in joints},
        forces,
    )


def _command(robot: Any, actuator: Any) -> Interval:
    """The interval of an actuator's control within all limits."""
    own = actuator.range or UNLIMITED
    if actuator.joint is None:
        return own
    joint = robot.joint(actuator.joint)
    gear = float(robot.compiled.actuator_gear[actuator.id, 0])
    if actuator.kind == "motor":
        # Force of the actuator: gain times control; on the joint: gear times force.
        gain = float(robot.compiled.actuator_gainprm[actuator.id, 0])
        own = _both(own, _divided(actuator.force, gain))
        # Several motors of a joint may pull at once.
        motors = [a for a in robot.actuators if a.joint == joint.name and a.kind == "motor"]
        return _both(own, _divided(_effort(robot, joint), gear * gain * len(motors)))
    # The set point of a servo is the gear times what the joint is to reach.
    if actuator.kind in ("position", "pid"):
        own = _both(own, _multiplied(joint.range, gear))
    elif actuator.kind == "velocity" and joint.name in robot.speeds:
        speed = robot.speeds[joint.name]
        own = _both(own, _multiplied((-speed, speed), gear))
    return own


def _effort(robot: Any, joint: Any) -> Interval:
    """The interval of what all actuators of a joint may exert on it."""
    if joint.effort is None:
        return UNLIMITED
    low, high = robot.compiled.jnt_actfrcrange[joint.id].tolist()
    return low, high


def _both(one: Interval, other: Interval) -> Interval:
    """The intersection of two intervals; the first where they are disjoint."""
    low, high = max(one[0], other[0]), min(one[1], other[1])
    return (low, high) if low <= high else one


def _multiplied(interval: Interval | None, factor: float) -> Interval:
    """An interval times a factor; unlimited where there is none."""
    if interval is None or not factor:
        return UNLIMITED
    low, high = sorted((interval[0] * factor, interval[1] * factor))
    return low, high


def _divided(interval: Interval | None, divisor: float) -> Interval:
    return _multiplied(interval, 1.0 / divisor) if divisor else UNLIMITED
