"""Default channels and excitation of a robot, for recordings without specified ones.

The commands move every joint about its reference pose, within the limits of controls and joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sims.core.system import DefaultRecording
from sims.robot.dynamics.joint_scales import compute_joint_scales
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.robot_model import Actuator, Joint, RobotModel

SWING_AMPLITUDES = {"hinge": 0.4, "slide": 0.1}
"""Amplitude of a joint's motion, in rad or m, by joint kind, if its range allows it."""
MAX_RANGE_SHARE = 0.25
"""Maximum amplitude of a joint's motion, as a share of its range."""
MAX_MARGIN_SHARE = 0.8
"""Maximum amplitude, as a share of the distance from the pose to the nearer joint limit."""
MIN_GRAVITY_FORCE_SHARE = 0.5
"""Minimum force amplitude, as a share of the typical force of the joint."""
MIN_COMMAND_HZ, MAX_COMMAND_HZ = 0.3, 2.0
"""Lowest and highest frequency of a command, in Hz."""
CENTRE_FREQUENCY = 2.0 * np.pi * np.sqrt(MIN_COMMAND_HZ * MAX_COMMAND_HZ)
"""Geometric mean of the lowest and highest frequency, in rad/s."""
TRIAL_SECONDS = 4.0
"""Duration of the trial simulation of commands, in seconds."""
MAX_AMPLITUDE_HALVINGS = 6
"""Number of command amplitudes that are tried; each is half the previous one."""


class ExcitationCommand(NamedTuple):
    """Excitation command of one input.

    Attributes:
        name: name of the input.
        centre: mean value.
        amplitude: amplitude of the oscillation about `centre`.
        address: index of the control, or of the generalised force.
    """

    name: str
    centre: float
    amplitude: float
    address: int

    def to_signal_text(self, share: float) -> str:
        """Format as the text that describes a signal in a recording's description file.

        Args:
            share: factor of the amplitude, from 0 to 1, which keeps the joints in their ranges.
        """
        amplitude = share * self.amplitude
        signal_text = f"multisine:{amplitude:.4g}:{MIN_COMMAND_HZ:g}:{MAX_COMMAND_HZ:g}"
        return f"{self.centre:.6g} + {signal_text}" if self.centre else signal_text


class LazyDefaultRecording:
    """Default recording of a robot's system, created on first access (a descriptor)."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = f"_made_{name}"

    def __get__(self, _instance: object, owner: Any) -> DefaultRecording:
        """Return the default recording of the robot, created on first access."""
        # The value is stored in the class itself, since an inherited value belongs to another
        # robot.
        if self._name not in vars(owner):
            setattr(owner, self._name, make_default_recording(owner.robot))
        recording: DefaultRecording = vars(owner)[self._name]
        return recording


def make_default_recording(robot: RobotModel) -> DefaultRecording:
    """Make the default recording: all joint positions are observed, and commands move each joint.

    The commands oscillate about the reference pose of the file:

    * A servo receives positions or velocities.
    * A motor receives the force that holds the pose, plus a force that would move a free joint.
    * A robot without actuators is moved by forces at its joints.

    Args:
        robot: robot whose joints move.
    """
    joints = [joint for joint in robot.joints if joint.has_one_coordinate]
    commands = _make_commands(robot, joints)
    amplitude_shares = [0.5**k for k in range(MAX_AMPLITUDE_HALVINGS)]
    with capture_mujoco_warnings():
        # The largest amplitude at which all joints stay within their ranges. If they leave them
        # at every amplitude, the commands are not the cause, and the full amplitude is used.
        share = next(
            (s for s in amplitude_shares if _stays_within_ranges(robot, joints, commands, s)), 1.0
        )
    return DefaultRecording(
        observe=tuple(f"q.{joint.name}" for joint in joints),
        inputs={command.name: command.to_signal_text(share) for command in commands},
    )


def _make_commands(robot: RobotModel, joints: Sequence[Joint]) -> list[ExcitationCommand]:
    """Make the commands of all actuators on the joints, or forces at the joints if there are none.

    Each command oscillates about a value that holds the reference pose.

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        joints: joints to excite.
    """
    holding, forces = _compute_reference_forces(robot, joints)
    joints_by_name = {joint.name: joint for joint in joints}
    commands = []
    for actuator in robot.actuators:
        if actuator.joint in joints_by_name:
            joint = joints_by_name[actuator.joint]
            holding_force, force = holding[joint.name], forces[joint.name]
            commands.append(_make_command(robot, actuator, joint, holding_force, force))
    if commands:
        return commands
    return [
        ExcitationCommand(f"force.{j.name}", holding[j.name], forces[j.name], j.velocity)
        for j in joints
    ]


def _compute_reference_forces(
    robot: RobotModel, joints: Sequence[Joint]
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the two forces of which a motor's command consists: to hold a joint, and to move it.

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        joints: all joints with one coordinate.

    Returns:
        By the name of the joint, in N or N·m: the force that holds it in the reference pose against
        gravity and springs; and the amplitude of an oscillating force that moves it visibly.
    """
    import mujoco

    model = robot.compiled
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    # Forces (nv,) that balance gravity and springs in the reference pose, in which the data begin.
    balancing_forces = data.qfrc_bias - data.qfrc_passive
    scales = compute_joint_scales(robot)
    holding, forces = {}, {}
    for number, joint in enumerate(joints):
        holding[joint.name] = float(balancing_forces[joint.velocity])
        amplitude = _choose_amplitude(joint, float(model.qpos0[joint.position]))
        # The inertia force of a free joint at the centre frequency; gravity restrains other joints,
        # which need a share of their typical force.
        inertia_force = scales.inertia[number] * CENTRE_FREQUENCY**2 * amplitude
        forces[joint.name] = float(
            max(inertia_force, MIN_GRAVITY_FORCE_SHARE * scales.force[number])
        )
    return holding, forces


def _choose_amplitude(joint: Joint, start: float) -> float:
    """Return the amplitude of a joint's motion, in rad or m; it stays clear of the joint's limits.

    If the motion begins at a limit or beyond it, only a share of the range limits the amplitude.

    Args:
        joint: joint to move.
        start: position about which it moves, in rad or m.
    """
    amplitude = SWING_AMPLITUDES[joint.kind]
    if joint.range is None:
        return amplitude
    low, high = joint.range
    margin = MAX_MARGIN_SHARE * min(start - low, high - start)
    return min(amplitude, MAX_RANGE_SHARE * (high - low), margin if margin > 0 else amplitude)


def _make_command(
    robot: RobotModel, actuator: Actuator, joint: Joint, holding: float, force: float
) -> ExcitationCommand:
    """Make an oscillating command of an actuator that moves its joint within all limits.

    Its unit depends on the actuator: a position, a velocity, or for a motor a force on the joint
    divided by gear and gain. The control range limits centre and amplitude. If the centre is so
    near to an end of the range that no oscillation is possible, it becomes the middle of the range.

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        actuator: actuator that receives the command.
        joint: joint of the actuator.
        holding: force that holds the reference pose, N or N m.
        force: amplitude of a force that would move the joint visibly, N or N m.
    """
    model = robot.compiled
    start = float(model.qpos0[joint.position])
    amplitude = _choose_amplitude(joint, start)
    # Centre and amplitude without limits, in the unit of the control.
    if actuator.kind in ("position", "pid"):
        centre, command_amplitude = start, amplitude
    elif actuator.kind == "velocity":
        centre, command_amplitude = 0.0, CENTRE_FREQUENCY * amplitude
    else:
        gain = float(model.actuator_gear[actuator.id, 0] * model.actuator_gainprm[actuator.id, 0])
        gain = gain or 1.0  # Without a gain the control has no force, whatever it is.
        centre, command_amplitude = holding / gain, force / abs(gain)
    # Limits.
    if actuator.range is not None:
        low, high = actuator.range
        centre = min(max(centre, low), high)
        margin = min(centre - low, high - centre)
        if margin < MAX_RANGE_SHARE * command_amplitude:
            centre = 0.5 * (low + high)
            margin = 0.5 * (high - low)
        command_amplitude = min(command_amplitude, margin)
    return ExcitationCommand(f"u.{actuator.name}", centre, command_amplitude, actuator.control)


def _stays_within_ranges(
    robot: RobotModel, joints: Sequence[Joint], commands: Sequence[ExcitationCommand], share: float
) -> bool:
    """Simulate commands of reduced amplitude, and return whether no joint leaves its range.

    The largest share for which this holds becomes the amplitude of the default recording. As the
    worst case, all commands are one sine with the frequency `CENTRE_FREQUENCY`, in phase, for
    `TRIAL_SECONDS`.

    Args:
        robot: the robot with its compiled MuJoCo model.
        joints: joints to check.
        commands: commands with full amplitude.
        share: factor of all amplitudes, from 0 to 1.
    """
    import mujoco

    model = robot.compiled
    data = mujoco.MjData(model)
    limited_joints = [joint for joint in joints if joint.range is not None]
    addresses_of_joints = [joint.position for joint in limited_joints]
    low, high = np.array([joint.range for joint in limited_joints]).reshape(-1, 2).T
    # The reference pose of a file may violate the file's limits, so limits include it.
    low = np.minimum(low, model.qpos0[addresses_of_joints])
    high = np.maximum(high, model.qpos0[addresses_of_joints])
    # Inputs named "u.NAME" are commands of actuators; others are forces applied at the joints.
    has_actuators = any(command.name.startswith("u.") for command in commands)
    control_array: Any = data.ctrl if has_actuators else data.qfrc_applied
    addresses = [command.address for command in commands]
    centres = np.array([command.centre for command in commands])
    amplitudes = share * np.array([command.amplitude for command in commands])
    for k in range(int(TRIAL_SECONDS / model.opt.timestep)):
        control_array[addresses] = centres + amplitudes * np.sin(
            CENTRE_FREQUENCY * k * model.opt.timestep
        )
        mujoco.mj_step(model, data)
        positions = data.qpos[addresses_of_joints]
        if not np.isfinite(data.qpos).all() or (positions < low).any() or (positions > high).any():
            return False
    return True
