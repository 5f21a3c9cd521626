"""Kalman smoother with a kinematic model: states of joints from their readings, without simulation.

Each joint is filtered and smoothed separately, as a body whose jerk j is constant between samples
and otherwise unknown,

    (q, v, a)[i+1] = [[1, h, h²/2], [0, 1, h], [0, 0, 1]] (q, v, a)[i] + (h³/6, h²/2, h) j_i     (1)

(Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation,
2001, section 6.2). The size of the jerk is selected from a grid by maximum likelihood.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.kalman.kalman_recursions import LinearRuns, filter_runs, smooth_runs
from sims.core.simulator import Array

JERKS = 10.0 ** np.arange(-2.0, 3.1, 1.0)
"""Sizes of the jerk that are tried, in units of the range of positions over seconds cubed."""
PRIOR_WIDTHS = (10.0, 10.0, 100.0)
"""Prior deviations of position, velocity and acceleration.

They are in ranges of the position, per second and second squared.
"""


def estimate_measured_states(
    evaluator: RunEvaluator, sigma: Array, run: int
) -> Mapping[int, Array]:
    """Estimate positions, velocities and accelerations of the recorded joints of one run.

    Args:
        evaluator: the runs.
        sigma: (C,) standard deviation of the noise of each channel.
        run: index of the run.

    Returns:
        Position, velocity and acceleration (T, 3) at the samples, by index of the joint. They are
        cached in the evaluator.
    """
    if run not in evaluator.measured_states:
        evaluator.measured_states[run] = _compute_measured_states(evaluator, sigma, run)
    return evaluator.measured_states[run]


def _compute_measured_states(
    evaluator: RunEvaluator, sigma: Array, run: int
) -> Mapping[int, Array]:
    """Estimate the states of the joints of one run; `estimate_measured_states` caches the result.

    Only joints whose position is recorded, at three samples or more, are estimated; a recorded
    velocity is used too.

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
    for joint, (coordinate, rate) in enumerate(zip(coordinates, rates, strict=True)):
        if coordinate not in evaluator.channels:
            continue
        # Channel of the position.
        position = evaluator.channels.index(coordinate)
        if np.isfinite(observed[:, position]).sum() < 3:
            continue
        # A velocity that is not recorded is NaN at all samples, so that its noise has no influence.
        velocity_readings, velocity_sigma = np.full(times.size, np.nan), 1.0
        if rate in evaluator.channels:
            velocity = evaluator.channels.index(rate)
            velocity_readings, velocity_sigma = observed[:, velocity], sigma[velocity]
        joints.append(joint)
        readings.append(
            JointReadings(
                np.stack([observed[:, position], velocity_readings], axis=1),
                np.array([sigma[position], velocity_sigma]),
            )
        )
    if not joints:
        return {}
    states = track_joints(times, readings)
    return dict(zip(joints, states, strict=True))


class JointReadings(NamedTuple):
    """Readings of one joint.

    Attributes:
        values: (T, 2) positions and velocities, NaN where missing.
        sigma: (2,) standard deviations of their noise.
    """

    values: Array
    sigma: Array


def track_joints(times: Array, readings: list[JointReadings]) -> list[Array]:
    """Estimate position, velocity and acceleration of joints with a Kalman filter and smoother.

    Each joint moves with a constant, unknown jerk between two samples, eq. (1) of the module
    docstring. All joints are filtered with each size of the jerk (`JERKS`) in one batch, and the
    likeliest size of each joint is used.

    Args:
        times: (T,) times of the samples.
        readings: readings of each joint; at least one position must be recorded.

    Returns:
        Positions, velocities and accelerations (T, 3) of each joint.
    """
    steps = np.diff(times)
    count, samples = len(readings), times.size
    # Matrices of eq. (1): transitions (T - 1, 3, 3) of the state, and its responses (T - 1, 3, 1)
    # to the jerk.
    transitions = np.tile(np.eye(3), (samples - 1, 1, 1))
    transitions[:, 0, 1] = transitions[:, 1, 2] = steps
    transitions[:, 0, 2] = 0.5 * steps**2
    jerk_responses = np.stack([steps**3 / 6.0, 0.5 * steps**2, steps], axis=1)[:, :, None]
    # The state is the deviation from a joint that rests at its first reading. Readings are in units
    # of the noise, so that both channels, position and velocity, have variance one.
    residuals = np.stack([joint.values for joint in readings])
    scale = np.stack([joint.sigma for joint in readings])[:, None]
    positions = residuals[:, :, 0].copy()
    first_positions = np.array([one[np.isfinite(one)][0] for one in positions])
    residuals[:, :, 0] -= first_positions[:, None]
    recorded = np.isfinite(residuals)
    residuals = np.where(recorded, residuals, 0.0) / scale
    # Missing readings do not depend on the state.
    observation_matrices = np.zeros((count, samples, 2, 3))
    observation_matrices[..., 0, 0] = 1.0 / scale[..., 0]
    observation_matrices[..., 1, 1] = 1.0 / scale[..., 1]
    observation_matrices[~recorded] = 0.0
    # Range of each joint's positions (D,), at least their noise, as a scale of the jerks.
    position_ranges = np.maximum(
        np.nanmax(positions, axis=1) - np.nanmin(positions, axis=1), scale[:, 0, 0]
    )
    # The prior of position, velocity and acceleration is so wide that the readings decide. Its
    # scale is the range per second, or per duration of the run if that is shorter.
    span = min(float(times[-1] - times[0]), 1.0)
    widths = np.array(PRIOR_WIDTHS) / np.array([1.0, span, span**2])
    prior = widths * max(float(position_ranges.max()), 1e-9)
    jerk_count = JERKS.size
    joint_indices, zeros = np.arange(count), np.zeros((count, samples - 1, 3))
    # One "run" for each joint and size of the jerk, which acts like a missing force.
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
    # Standard deviation of the jerk of each of these runs.
    jerks = (position_ranges[:, None] * JERKS / span**3).reshape(-1, 1)
    # Both channels have noise of variance one, because readings are in units of the noise.
    filtered = filter_runs(runs, jerks, np.ones(2))
    log_likelihoods = filtered.log_likelihood.reshape(count, jerk_count)
    # Indices of the runs with the likeliest jerk of each joint.
    likeliest = np.argmax(log_likelihoods, axis=1) + jerk_count * joint_indices
    best_runs = runs.subset(likeliest)
    smoothed = smooth_runs(best_runs, filtered.subset(likeliest), jerks[likeliest])
    # Back from deviations to positions.
    states = smoothed.states
    states[:, :, 0] += first_positions[:, None]
    return list(states)
