"""Limits that a robot's model file specifies: of commands, positions, velocities and forces.

An MJCF specifies joint ranges, force limits of joints (`actuatorfrcrange`), control ranges and
force ranges of actuators. A URDF specifies joint ranges, efforts and velocities; MuJoCo does not
compile the velocities, so they are read from the file (`urdf_loading.read_velocity_limits`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator

Interval = tuple[float, float]
UNLIMITED: Interval = (-np.inf, np.inf)


@dataclass(frozen=True)
class StatedLimits:
    """Limits of a robot's model file; empty for a system without one.

    Attributes:
        commands: Minimum and maximum of each limited input, in its unit. The command of a joint's
            actuator respects its control range and the limits of the joint: a torque respects
            effort and force range, a set point the joint's range or velocity.
        positions: Limits of joints by channel ``q.JOINT``, in rad or m.
        velocities: Limits of joints by channel ``qd.JOINT``, in rad/s or m/s.
        forces: Limits of joints by channel ``tau.JOINT``, in N m or N; infinite if the simulation
            itself limits the force of every actuator of the joint.
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


def read_model_file_limits(evaluator: RunEvaluator) -> StatedLimits:
    """Read the limits of commands, positions, velocities and forces from a robot's model file.

    A system without a model file has none.
    """
    if not evaluator.kind.has_model:
        return StatedLimits()
    kind: Any = evaluator.kind
    robot = kind.robot
    joints = {joint.name: joint for joint in robot.joints if joint.has_one_coordinate}
    forces = {}
    for name, joint in joints.items():
        drives = [actuator for actuator in robot.actuators if actuator.joint == name]
        if joint.effort is not None:
            forces[f"tau.{name}"] = _get_effort_limit(robot, joint)
        elif drives and all(actuator.force is not None for actuator in drives):
            forces[f"tau.{name}"] = UNLIMITED
    commands = {
        f"u.{actuator.name}": _compute_command_range(robot, actuator)
        for actuator in robot.actuators
    }
    commands |= {f"force.{name}": _get_effort_limit(robot, joint) for name, joint in joints.items()}
    return StatedLimits(
        {name: interval for name, interval in commands.items() if interval != UNLIMITED},
        {f"q.{name}": joint.range for name, joint in joints.items() if joint.range},
        {f"qd.{name}": (-v, v) for name, v in robot.speeds.items() if name in joints},
        forces,
    )


def _compute_command_range(robot: Any, actuator: Any) -> Interval:
    """Compute the range of an actuator's control that respects all limits of actuator and joint.

    It is in the unit of the control: a force for a motor, a position or velocity for a servo.
    """
    interval = actuator.range or UNLIMITED
    if actuator.joint is None:
        return interval
    joint = robot.joint(actuator.joint)
    gear = float(robot.compiled.actuator_gear[actuator.id, 0])
    if actuator.kind == "motor":
        # The actuator force is gain times control, and the joint force is gear times actuator
        # force.
        gain = float(robot.compiled.actuator_gainprm[actuator.id, 0])
        interval = _intersect(interval, _divide_interval(actuator.force, gain))
        # Several motors of a joint may act at the same time.
        motors = [a for a in robot.actuators if a.joint == joint.name and a.kind == "motor"]
        return _intersect(
            interval, _divide_interval(_get_effort_limit(robot, joint), gear * gain * len(motors))
        )
    # The set point of a servo is the gear times the desired value at the joint.
    if actuator.kind in ("position", "pid"):
        interval = _intersect(interval, _multiply_interval(joint.range, gear))
    elif actuator.kind == "velocity" and joint.name in robot.speeds:
        speed = robot.speeds[joint.name]
        interval = _intersect(interval, _multiply_interval((-speed, speed), gear))
    return interval


def _get_effort_limit(robot: Any, joint: Any) -> Interval:
    """Return the interval of the total actuator force on a joint."""
    if joint.effort is None:
        return UNLIMITED
    low, high = robot.compiled.jnt_actfrcrange[joint.id].tolist()
    return low, high


def _intersect(first: Interval, second: Interval) -> Interval:
    """Intersect two intervals; return the first if they are disjoint."""
    low, high = max(first[0], second[0]), min(first[1], second[1])
    return (low, high) if low <= high else first


def _multiply_interval(interval: Interval | None, factor: float) -> Interval:
    """Multiply an interval by a factor; unlimited without an interval or with a zero factor."""
    if interval is None or not factor:
        return UNLIMITED
    low, high = sorted((interval[0] * factor, interval[1] * factor))
    return low, high


def _divide_interval(interval: Interval | None, divisor: float) -> Interval:
    return _multiply_interval(interval, 1.0 / divisor) if divisor else UNLIMITED
