"""Joint forces of a robot by inverse dynamics at its recorded motion, without simulation.

The motion is estimated from the readings (`kinematic_smoother`). Comparing the force that it
requires with the force of the model's drive shows whether the drive was active.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.diagnosis.kalman.kinematic_smoother import JointReadings, track_joints
from sims.core.noise_estimation import estimate_noise
from sims.core.simulator import Array
from sims.recording.recording import Recording, Run
from sims.robot.dynamics.activation_filters import activation_filters
from sims.robot.dynamics.inverse_dynamics import motion_forces
from sims.robot.robot_model import RobotModel

DEFAULT_SIGMA = 1e-6
"""Noise of a channel whose noise is neither stated nor visible, in rad or m (and per second)."""


class JointForces(NamedTuple):
    """Forces at the D joints of a robot in the T samples of a run, (T, D) each.

    Attributes:
        needed: forces that the measured motion requires.
        driven: forces of the model's drives at the measured motion.
        holding: forces that hold the joints still.
        velocity: velocities of the joints.
    """

    needed: Array
    driven: Array
    holding: Array
    velocity: Array

    def residuals(self, joint: int) -> Array:
        """Return the residuals (3, T) at a joint of a drive that is on, off, or held by a brake."""
        needed = self.needed[:, joint]
        return np.stack([needed - self.driven[:, joint], needed, needed - self.holding[:, joint]])


def has_joint_forces(robot: RobotModel, recording: Recording) -> bool:
    """Return whether joint forces can be computed from the recorded positions.

    All joints must be recorded, and have one coordinate each. The model must have an actuator, and
    no equality constraint, which would couple joints.

    Args:
        robot: model of the robot.
        recording: its recording; the channels of the first run count.
    """
    recorded = recording.runs[0].channels
    # ``q.NAME`` is the channel of a joint's position.
    are_recorded = all(
        joint.has_one_coordinate and f"q.{joint.name}" in recorded for joint in robot.joints
    )
    # `neq` is MuJoCo's number of equality constraints.
    return are_recorded and not robot.compiled.neq and bool(robot.actuators)


def compute_joint_forces(robot: RobotModel, recording: Recording, run: Run) -> JointForces:
    """Compute the joint forces of a run by MuJoCo's inverse dynamics.

    They show whether a drive is active, without a fit. Positions, velocities and accelerations are
    estimated from the readings first. Recorded external forces are subtracted from the required
    ones.

    Args:
        robot: robot as read from its model file.
        recording: the recording.
        run: the recorded run.

    Returns:
        Forces (T, D) that the motion requires, that the drives exert, and that would hold the robot
        still, and the velocities, at T samples and D joints. A drive that is recorded as off exerts
        no force.
    """
    model = robot.compiled
    # Position, velocity and acceleration (T, 3) of each of the D joints, (D, T, 3) together.
    states = np.stack(track_joints(run.times, _get_readings(robot, recording, run)))
    # (3, T, D)
    motion = np.transpose(states, (2, 1, 0))
    # The same positions without velocity and acceleration.
    rest_motion = np.stack([motion[0], np.zeros_like(motion[0]), np.zeros_like(motion[0])])
    controls, activations = _compute_controls(robot, run)
    # Recorded external forces (T, D) at the joints.
    applied = np.zeros(motion.shape[1:])
    for column, joint in enumerate(robot.joints):
        name = f"force.{joint.name}"
        if name in run.inputs:
            applied[:, column] = _compute_mean_input(run, name)
    needed, driven = motion_forces(model, robot.joints, motion, controls, activations)
    holding, _ = motion_forces(model, robot.joints, rest_motion, controls, activations)
    names = [joint.name for joint in robot.joints]
    # By name of an actuator: the mask (T,) of the samples at which it is recorded as off.
    for name, off_mask in run.off.items():
        joint_name = robot.actuator(name).joint
        # An actuator may act on something else than one joint.
        if joint_name is not None:
            # Without a driving force, the hypotheses that the drive is on or off, which
            # `JointForces.residuals` compares, have the same residual there.
            driven[off_mask, names.index(joint_name)] = 0.0
    return JointForces(needed - applied, driven, holding - applied, motion[1])


def _get_readings(robot: RobotModel, recording: Recording, run: Run) -> list[JointReadings]:
    """Return the recorded positions and velocities of each joint, with their noise.

    A velocity that is not recorded is NaN. Noise that is not stated is estimated.

    Args:
        robot: robot as read from its model file.
        recording: the recording.
        run: the recorded run.
    """
    readings = []
    for joint in robot.joints:
        columns, noise = [], []
        # Channels of the position and the velocity.
        for name in (f"q.{joint.name}", f"qd.{joint.name}"):
            values = run.channels.get(name, np.full(run.times.size, np.nan))
            columns.append(values)
            # Noise is unknown if it is not stated, or stated as zero.
            sigma = recording.noise.get(name, 0.0)
            if not sigma > 0 and name in run.channels:
                sigma = estimate_noise([(run.times, values)]).sigma
            noise.append(sigma if np.isfinite(sigma) and sigma > 0 else DEFAULT_SIGMA)
        readings.append(JointReadings(np.stack(columns, axis=1), np.array(noise)))
    return readings


def _compute_mean_input(run: Run, name: str) -> Array:
    """Return an input (T,) at each sample: the mean of its values before and after the sample.

    An input is held between samples, so that it jumps at a sample. Before the first sample, it has
    its first value. It is returned as it is if the run interpolates it linearly.

    Args:
        run: the run.
        name: name of the input.
    """
    values = run.inputs[name]
    if name in run.linear:
        return values
    earlier = np.concatenate([values[:1], values[:-1]])
    mean: Array = 0.5 * (values + earlier)
    return mean


def _compute_controls(robot: RobotModel, run: Run) -> tuple[Array, Array]:
    """Return the controls (T, nu) and filtered activations (T, na) of a run at its samples.

    nu and na are MuJoCo's numbers of actuators and of activation states. Some actuators filter
    their control with a first-order lag; the activation is the output of this filter, stepped
    exactly between samples. At the first sample it equals the control.

    Args:
        robot: model of the robot.
        run: the run, with inputs ``u.NAME`` of the actuators; an actuator without input has control
            zero.
    """
    model = robot.compiled
    controls = np.zeros((run.times.size, model.nu))
    activations = np.zeros((run.times.size, model.na))
    for actuator in robot.actuators:
        name = f"u.{actuator.name}"
        if name in run.inputs:
            controls[:, actuator.control] = _compute_mean_input(run, name)
    steps = np.diff(run.times)
    for activation_filter in activation_filters(robot):
        clipped_controls = activation_filter.clip_controls(
            controls[:, activation_filter.actuator.control]
        )
        activation = float(clipped_controls[0])
        # A lag decays exponentially to the control, which is constant in each step. The last sample
        # has no step after it; its decay is not used.
        decays = np.exp(-np.append(steps, 0.0) / max(activation_filter.seconds, 1e-9))
        for sample, decay in enumerate(decays.tolist()):
            activations[sample, activation_filter.address] = activation
            activation = clipped_controls[sample] + decay * (activation - clipped_controls[sample])
    return controls, activations
