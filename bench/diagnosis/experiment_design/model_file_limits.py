"""Limits of commands, positions, velocities and forces that a robot's model file specifies.

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

    Proposed runs must stay within them. A system without a model file has none. A force is
    unlimited here if the simulation itself limits that of every actuator of the joint.

    Args:
        evaluator: Evaluator of the recorded runs.
    """
    if not evaluator.kind.has_model:
        return StatedLimits()
    kind: Any = evaluator.kind
    robot = kind.robot
    joints = {joint.name: joint for joint in robot.joints if joint.has_one_coordinate}
    forces = {}
    for name, joint in joints.items():
        actuators = [actuator for actuator in robot.actuators if actuator.joint == name]
        # A joint with neither has no entry: `RigLimits` limits its force by the present runs.
        if joint.effort is not None:
            forces[f"tau.{name}"] = _get_effort_limit(robot, joint)
        elif actuators and all(actuator.force is not None for actuator in actuators):
            forces[f"tau.{name}"] = UNLIMITED
    commands = {
        f"u.{actuator.name}": _compute_command_range(robot, actuator)
        for actuator in robot.actuators
    }
    commands |= {f"force.{name}": _get_effort_limit(robot, joint) for name, joint in joints.items()}
    return StatedLimits(
        commands={name: interval for name, interval in commands.items() if interval != UNLIMITED},
        positions={f"q.{name}": joint.range for name, joint in joints.items() if joint.range},
        velocities={
            f"qd.{name}": (-speed, speed) for name, speed in robot.speeds.items() if name in joints
        },
        forces=forces,
    )


def _compute_command_range(robot: Any, actuator: Any) -> Interval:
    """Compute the range of an actuator's command that respects all limits of actuator and joint.

    It is in the unit of the command: a force for a motor, a position or velocity for a servo.
    Limits of the joint are converted by gear and gain.

    Args:
        robot: model of the robot.
        actuator: actuator whose command is limited.
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
        # All motors of the joint may act at the same time with this control.
        motor_count = sum(
            other.joint == joint.name and other.kind == "motor" for other in robot.actuators
        )
        control_interval = _divide_interval(
            _get_effort_limit(robot, joint), gear * gain * motor_count
        )
        return _intersect(interval, control_interval)
    # The set point of a servo is the gear times the desired value at the joint.
    if actuator.kind in ("position", "pid"):
        interval = _intersect(interval, _multiply_interval(joint.range, gear))
    elif actuator.kind == "velocity" and joint.name in robot.speeds:
        speed = robot.speeds[joint.name]
        interval = _intersect(interval, _multiply_interval((-speed, speed), gear))
    return interval


def _get_effort_limit(robot: Any, joint: Any) -> Interval:
    """Return the interval of the effort of all actuators on a joint, in N or N·m.

    A proposed run must not ask for more than the joint's limit. It is unlimited if the model file
    states no limit of the effort (``actuatorfrcrange`` in MJCF, ``effort`` in URDF).

    Args:
        robot: model of the robot.
        joint: the joint.
    """
    if joint.effort is None:
        return UNLIMITED
    # `joint.effort` is only the upper limit; the compiled model has both.
    low, high = robot.compiled.jnt_actfrcrange[joint.id].tolist()
    return low, high


def _intersect(first: Interval, second: Interval) -> Interval:
    """Intersect two intervals; return the first if they are disjoint."""
    (first_low, first_high), (second_low, second_high) = first, second
    low, high = max(first_low, second_low), min(first_high, second_high)
    return (low, high) if low <= high else first


def _multiply_interval(interval: Interval | None, factor: float) -> Interval:
    """Multiply an interval by a factor; unlimited without an interval or with a zero factor."""
    if interval is None or not factor:
        return UNLIMITED
    low, high = sorted(factor * end for end in interval)
    return low, high


def _divide_interval(interval: Interval | None, divisor: float) -> Interval:
    """Return an interval divided by a number; unlimited if the number is zero.

    Args:
        interval: lower and upper end; None for no limit.
        divisor: the number, such as a gear ratio; a negative one swaps the ends.
    """
    return _multiply_interval(interval, 1.0 / divisor) if divisor else UNLIMITED
