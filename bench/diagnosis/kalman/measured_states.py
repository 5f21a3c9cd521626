"""States and joint forces of a robot from its recorded motion alone, without simulation.

Each joint is filtered separately, as a body whose jerk j is constant between samples and otherwise
unknown,

    (q, v, a)[i+1] = [[1, h, h²/2], [0, 1, h], [0, 0, 1]] (q, v, a)[i] + (h³/6, h²/2, h) j_i     (1)

(Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation,
2001, section 6.2). The size of the jerk is selected from a grid by maximum likelihood.

Positions, velocities and accelerations are estimated from the readings alone (`track_joints`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.kalman.filter_and_smoother import LinearRuns, filter_runs, smooth_runs
from bench.logs.quality.noise_estimation import estimate_noise
from sims.core.simulator import Array
from sims.recording.recording import Recording, Run
from sims.robot.dynamics.activation_filters import activation_filters
from sims.robot.dynamics.inverse_dynamics import motion_forces
from sims.robot.robot_model import RobotModel

JERKS = 10.0 ** np.arange(-2.0, 3.1, 1.0)
"""Sizes of the jerk that are tried, in units of the range of positions over seconds cubed."""
PRIOR_WIDTHS = (10.0, 10.0, 100.0)
"""Prior deviations of position, velocity and acceleration.

They are in ranges of the position, per second and second squared.
"""
MIN_RESTING_READINGS = 10
"""Minimum number of readings whose mean is the position of a joint that rests."""
MAX_RESTING_DEVIATION = 3.0
"""Maximum excess of the scatter of readings at rest, in its standard deviations."""
DEFAULT_SIGMA = 1e-6
"""Noise of a channel whose noise is neither stated nor visible, in rad or m (and per second)."""


def estimate_measured_states(
    evaluator: RunEvaluator, sigma: Array, run: int
) -> Mapping[int, Array]:
    """Estimate positions, velocities and accelerations of the recorded joints of one run.

    Args:
        evaluator: the runs.
        sigma: (C,) standard deviation of the noise of each channel.
        run: index of the run.

    Returns:
        States (T, 3) at the samples, by index of the joint.
    """
    if run not in evaluator.measured_states:
        evaluator.measured_states[run] = _compute_measured_states(evaluator, sigma, run)
    return evaluator.measured_states[run]


def _compute_measured_states(
    evaluator: RunEvaluator, sigma: Array, run: int
) -> Mapping[int, Array]:
    """Estimate the states of the joints of one run; `estimate_measured_states` caches the result.

    Only joints whose position is recorded are estimated; a recorded velocity is used too. Joints
    with fewer than three recorded positions are left out.

    Args:
        evaluator: the runs.
        sigma: (C,) standard deviation of the noise of each channel.
        run: index of the run.

    Returns:
        Position, velocity and acceleration (T, 3) of each joint, by the index of the joint.
    """
    coordinates, rates = evaluator.simulator.system.coordinates, evaluator.simulator.system.rates
    run_data = evaluator.prepared_runs[run]
    times, observed = run_data.scenario.times, run_data.observed
    joints, readings = [], []
    for joint, names in enumerate(zip(coordinates, rates, strict=True)):
        if names[0] not in evaluator.channels:
            continue
        columns = [evaluator.channels.index(n) if n in evaluator.channels else -1 for n in names]
        values = [observed[:, c] if c >= 0 else np.full(times.size, np.nan) for c in columns]
        noise = [sigma[c] if c >= 0 else 1.0 for c in columns]
        if np.isfinite(values[0]).sum() < 3:
            continue
        joints.append(joint)
        readings.append((np.stack(values, axis=1), np.array(noise)))
    if not joints:
        return {}
    states = track_joints(times, readings)
    return dict(zip(joints, states, strict=True))


def estimate_resting_position(readings: Array, sigma: float) -> float | None:
    """Estimate the position of a joint that rests at the beginning of a run.

    It rests as long as the readings scatter about their mean no more than the noise does. Only the
    first half of these readings counts, since a slow beginning of motion shows late.

    Args:
        readings: (T,) recorded positions; NaN where there are none.
        sigma: standard deviation of their noise.

    Returns:
        The mean of the readings at rest; None if the joint does not rest for more than `2 *
        MIN_RESTING_READINGS` readings.
    """
    present = readings[np.isfinite(readings)]
    counts = np.arange(1, present.size + 1)
    scaled = (present - present[:1]) / sigma
    # Sums of squares about the mean of the first 1, 2, ... readings are chi-squared at rest.
    squares = np.cumsum(scaled**2) - np.cumsum(scaled) ** 2 / counts
    moves = squares > counts - 1 + MAX_RESTING_DEVIATION * np.sqrt(2.0 * counts)
    # One wrong reading is no motion.
    moves[: 2 * MIN_RESTING_READINGS] = False
    resting = int(np.argmax(moves)) if moves.any() else present.size
    if resting <= 2 * MIN_RESTING_READINGS:
        return None
    return float(present[: resting // 2].mean())


def track_joints(times: Array, readings: list[tuple[Array, Array]]) -> list[Array]:
    """Estimate position, velocity and acceleration of joints with a Kalman filter and smoother.

    Each joint moves with a constant, unknown jerk between two samples, eq. (1) of the module
    docstring. All joints are filtered with each size of the jerk in one batch, and the likeliest
    size of each joint is used. Positions are relative to the first reading, in units of the noise.

    Args:
        times: (T,) times of the samples.
        readings: for each joint, positions and velocities (T, 2), NaN where missing, and the
            standard deviations of their noise (2,).

    Returns:
        Positions, velocities and accelerations (T, 3) of each joint.
    """
    steps = np.diff(times)
    count, samples = len(readings), times.size
    transitions = np.tile(np.eye(3), (samples - 1, 1, 1))
    transitions[:, 0, 1] = transitions[:, 1, 2] = steps
    transitions[:, 0, 2] = 0.5 * steps**2
    jerk_responses = np.stack([steps**3 / 6.0, 0.5 * steps**2, steps], axis=1)[:, :, None]
    values = np.stack([v for v, _ in readings])
    # Use units of the noise, so that both channels have variance one.
    scale = np.stack([n for _, n in readings])[:, None]
    first_readings = np.array([v[np.isfinite(v[:, 0]), 0][0] for v, _ in readings])
    residuals = values.copy()
    residuals[:, :, 0] -= first_readings[:, None]
    recorded = np.isfinite(residuals)
    residuals = np.where(recorded, residuals, 0.0) / scale
    observation_matrices = np.zeros((count, samples, 2, 3))
    observation_matrices[..., 0, 0] = 1.0 / scale[..., 0]
    observation_matrices[..., 1, 1] = 1.0 / scale[..., 1]
    observation_matrices[~recorded] = 0.0
    position_ranges = np.array(
        [max(float(np.nanmax(v[:, 0]) - np.nanmin(v[:, 0])), n[0]) for v, n in readings]
    )
    # The prior of position, velocity and acceleration is so wide that the readings decide. Its
    # scale is the range per second, or per duration of the run if that is shorter.
    span = min(float(times[-1] - times[0]), 1.0)
    widths = np.array(PRIOR_WIDTHS) / np.array([1.0, span, span**2])
    prior = widths * max(float(position_ranges.max()), 1e-9)
    jerk_count = JERKS.size
    joint_indices, zeros = np.arange(count), np.zeros((count, samples - 1, 3))
    runs = LinearRuns(
        states=np.tile(transitions, (count, 1, 1, 1)),
        defects=zeros,
        forces=np.tile(jerk_responses, (count, 1, 1, 1)),
        inputs=np.zeros((count, samples - 1, 3, 0)),
        readings=observation_matrices,
        residuals=residuals,
        recorded=recorded,
        prior=prior,
        jumps=zeros,
    ).subset(np.repeat(joint_indices, jerk_count))
    force = (position_ranges[:, None] * JERKS / span**3).reshape(-1, 1)
    filtered = filter_runs(runs, force, np.ones(2))
    log_likelihoods = filtered.log_likelihood.reshape(count, jerk_count)
    likeliest = np.argmax(log_likelihoods, axis=1) + jerk_count * joint_indices
    best_runs = runs.subset(likeliest)
    smoothed = smooth_runs(best_runs, filtered.subset(likeliest), force[likeliest])
    states = smoothed.states
    states[:, :, 0] += first_readings[:, None]
    return list(states)


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

    All joints must be recorded, and have one coordinate each; none is coupled by an equality.

    Args:
        robot: model of the robot.
        recording: its recording; the channels of the first run count.
    """
    recorded = recording.runs[0].channels
    singles = all(
        joint.has_one_coordinate and f"q.{joint.name}" in recorded for joint in robot.joints
    )
    return singles and not robot.compiled.neq and bool(robot.actuators)


def compute_joint_forces(robot: RobotModel, recording: Recording, run: Run) -> JointForces:
    """Compute the joint forces of a run by MuJoCo's inverse dynamics.

    They show whether a drive is active, without a fit. Positions, velocities and accelerations are
    estimated from the recorded positions first. Recorded external forces are subtracted from the
    required ones.

    Args:
        robot: robot as read from its model file.
        recording: the recording.
        run: the recorded run.

    Returns:
        Forces that the motion requires, that the drives exert, and that would hold the robot still.
    """
    model = robot.compiled
    states = np.stack(track_joints(run.times, _get_readings(robot, recording, run)))
    motion = np.transpose(states, (2, 1, 0))
    rest_motion = np.stack([motion[0], np.zeros_like(motion[0]), np.zeros_like(motion[0])])
    controls, activations = _compute_controls(robot, run)
    applied = np.zeros(motion.shape[1:])
    for column, joint in enumerate(robot.joints):
        name = f"force.{joint.name}"
        if name in run.inputs:
            applied[:, column] = _compute_mean_input(run, name)
    needed, driven = motion_forces(model, robot.joints, motion, controls, activations)
    holding, _ = motion_forces(model, robot.joints, rest_motion, controls, activations)
    names = [joint.name for joint in robot.joints]
    for name, off_mask in run.off.items():
        joint_name = robot.actuator(name).joint
        if joint_name is not None:
            # Where the drive is known to be off, both hypotheses agree.
            driven[off_mask, names.index(joint_name)] = 0.0
    return JointForces(needed - applied, driven, holding - applied, motion[1])


def _get_readings(robot: RobotModel, recording: Recording, run: Run) -> list[tuple[Array, Array]]:
    """Return for each joint its recorded positions and velocities (T, 2), and their noise (2,).

    A velocity that is not recorded is NaN. Noise that is not stated is estimated.

    Args:
        robot: robot as read from its model file.
        recording: the recording.
        run: the recorded run.
    """
    readings = []
    for joint in robot.joints:
        columns, noise = [], []
        for name in (f"q.{joint.name}", f"qd.{joint.name}"):
            values = run.channels.get(name, np.full(run.times.size, np.nan))
            columns.append(values)
            # Zero stands for unknown noise.
            sigma = recording.noise.get(name, 0.0)
            if not sigma > 0 and name in run.channels:
                sigma = estimate_noise([(run.times, values)]).sigma
            noise.append(sigma if np.isfinite(sigma) and sigma > 0 else DEFAULT_SIGMA)
        readings.append((np.stack(columns, axis=1), np.array(noise)))
    return readings


def _compute_mean_input(run: Run, name: str) -> Array:
    """Return an input (T,) at each sample: the mean of its values before and after the sample.

    Args:
        run: the run.
        name: name of the input. It is held between samples, unless the run interpolates it
            linearly.
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
    exactly between samples.

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
        for sample, decay in enumerate(
            np.exp(-np.append(steps, 0.0) / max(activation_filter.seconds, 1e-9)).tolist()
        ):
            activations[sample, activation_filter.address] = activation
            activation = clipped_controls[sample] + decay * (activation - clipped_controls[sample])
    return controls, activations
