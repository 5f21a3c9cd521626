"""Check the clock of a recording: jitter, lost samples, impossible stamps, drift of the sensors.

To find time stamps in a wrong unit, the time in which a coordinate moves is estimated twice. From
the recording: the shortest lag T after which its values x differ by as much as their spread,

    mean (x(t + T) - x(t))^2 >= var x                                      (1)

and from the system: at rest in the recorded positions, driven by the recorded inputs, its own
forces would move it equally far within

    T' = (var x / mean a^2)^(1/4)                                          (2)

with its acceleration a at nominal parameters. An oscillation has T = 1.05/w and T' = 1/w. Dust,
friction and a wrong mass change the ratio a few times, milliseconds read as seconds a thousand
times; then the sampling interval exceeds (2), too, which nobody would record on purpose.

To find a drift of the sensors, the response of a position y to a command u is modelled as linear
with finite memory,

    p(t) = c + d t + sum_k h_k <u>_k(t),  <u>_k the mean of u over the k-th interval before t  (3)

so that slow and fast commands each have the lag that the drive gives them. A position whose delay
grows by a share e of the time is

    y(t) = p(t - T - e t) = p - (T + e t) p' + ...                                             (4)

Least squares for T and e finds the shift at which the two are most similar (the maximum of the
cross-correlation, to first order; C. Knapp, G. Carter, IEEE Trans. ASSP 24(4), 320, 1976). The
standard error of e is computed from sums over blocks longer than the memory, since the residual of
(3) is not white (W. Newey, K. West, Econometrica 55, 703, 1987).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from bench.logs.lost_samples import MAX_FILLED_SAMPLES, find_lost_samples
from bench.logs.quality.quality_finding import SIGNIFICANCE_SIGMAS, Anomaly, QualityFinding
from sims.core.simulator import Array, Simulator
from sims.core.system import StateSnapshot, System
from sims.core.user_messages import join_first_names
from sims.recording.recording import Recording, Run
from sims.system_simulator import SystemSimulator

JITTER_THRESHOLD = 0.02
"""Smallest jitter that is reported, 1 sigma, as a fraction of the sampling interval."""
LOST_SAMPLE_SHARE_THRESHOLD = 0.002
"""Smallest share of lost or repeated samples that is reported."""
UNEVEN_SHARE = 0.01
"""Relative difference from the median interval from which an interval counts as uneven."""


def check_intervals(recording: Recording) -> Iterator[QualityFinding]:
    """Find irregular sampling intervals (jitter) and lost samples, summarised over all runs.

    Intervals are compared with the median interval of their run. A lost sample makes an interval a
    multiple of it.

    Args:
        recording: Recording with the time stamps of each run.
    """
    jitters: list[float] = []
    lost_count, sample_count = 0, 0
    runs_with_jitter, runs_with_losses = [], []
    for run in recording.runs:
        times = _select_timestamps(run)
        if times.size < 3:
            continue
        steps, lost = np.diff(times), find_lost_samples(times)
        jitters.append(lost.jitter)
        if lost.jitter > JITTER_THRESHOLD:
            runs_with_jitter.append(run.name)
        # If the clock jitters strongly, a long interval means a lost sample only if no short
        # interval compensates for it: the duration of the run limits the number of lost samples.
        expected_count = int(steps.sum() / np.median(steps))
        run_lost_count = min(int(lost.counts.sum()), max(expected_count - steps.size, 0))
        # The jitters of n intervals add up to an error of the duration by sqrt(n) of one, in
        # samples. Fewer lost samples than several times this error are not significant.
        if run_lost_count < SIGNIFICANCE_SIGMAS * lost.jitter * steps.size**0.5:
            run_lost_count = 0
        lost_count += run_lost_count
        sample_count += steps.size + run_lost_count
        if run_lost_count:
            runs_with_losses.append(run.name)
    if runs_with_jitter:
        yield QualityFinding(
            "clock",
            f"intervals vary by {max(jitters):.0%} of one (1 sigma) in "
            f"{join_first_names(runs_with_jitter)}",
            "every sample is simulated at its own stamp, so use the times of measurement as "
            "stamps, not the times of writing",
        )
    if sample_count and lost_count > LOST_SAMPLE_SHARE_THRESHOLD * sample_count:
        yield QualityFinding(
            "clock",
            f"{lost_count} samples ({lost_count / sample_count:.1%}) are lost in "
            f"{join_first_names(runs_with_losses)}",
            "readings are not interpolated; commands of a robot of up to "
            f"{MAX_FILLED_SAMPLES} lost samples are, unless they were held: log commands in a "
            "separate file if they jump",
        )


def _select_timestamps(run: Run) -> Array:
    """Return the times at which the sensors of a run were read.

    The sample times of a run also contain those of commands and of other sensors, which may have
    their own clocks. There are two cases:

    * All sample times are at least as regular as those of the sensor that was read most often: then
      the sensors share one clock, and the samples that a sensor lacks are empty cells. All sample
      times are returned.
    * Otherwise, those of the sensor that was read most often are returned.

    Args:
        run: recorded run; a channel is NaN where its sensor was not read.
    """
    recorded_masks = [np.isfinite(values) for values in run.channels.values()]
    is_recorded = max(
        recorded_masks, key=lambda mask: int(mask.sum()), default=np.ones(run.times.size, np.bool_)
    )
    sensor_times = run.times[is_recorded]
    if _compute_uneven_share(run.times) <= _compute_uneven_share(sensor_times):
        return run.times
    return sensor_times


def _compute_uneven_share(times: Array) -> float:
    """Return the share of intervals that differ from the median interval (`UNEVEN_SHARE`)."""
    steps = np.diff(times)
    if not steps.size:
        return 1.0
    median_step = float(np.median(steps))
    return float(np.mean(np.abs(steps - median_step) > UNEVEN_SHARE * median_step))


TIME_UNIT_RATIO_THRESHOLD = 300.0
"""Ratio of the two times (1) and (2) above which a unit is wrong."""
DRIVEN_SYSTEM_FACTOR = 10.0
"""Minimum ratio of the sampling interval to (2) for a certain anomaly of a driven system.

A driven system may be moved arbitrarily slowly.
"""
MIN_MOTION_SHARE = 0.01
"""Minimum spread of a coordinate for this check, as a fraction of its usual size."""
MAX_GAP_RATIO = 100.0
"""Ratio of a gap to the rest of its run above which the run is rejected.

The samples before such a gap do not determine the motion after it.
"""
_MIN_CHECKED_SAMPLES = 10
"""Minimum number of samples of a run that is checked."""
_TIME_UNITS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}


def find_anomalies(recording: Recording, kind: type[Simulator]) -> Iterator[Anomaly]:
    """Yield the anomalies of time stamps, at most one for each run.

    Args:
        recording: Recording to check.
        kind: Simulator class of its system.
    """
    for run in recording.runs:
        if run.times.size < _MIN_CHECKED_SAMPLES:
            continue
        anomaly = _check_gap(run) or _check_time_scale(recording, run, kind)
        if anomaly is not None:
            yield anomaly


def _check_gap(run: Run) -> Anomaly | None:
    """Find a gap that is more than `MAX_GAP_RATIO` times as long as the rest of the run.

    Such a run probably consists of two. Return None if there is no such gap.

    Args:
        run: recorded run with its sample times.
    """
    intervals = np.diff(run.times)
    longest = int(intervals.argmax())
    gap = float(intervals[longest])
    sampled_seconds = float(intervals.sum()) - gap
    if gap <= MAX_GAP_RATIO * sampled_seconds:
        return None
    gap_text = f"{gap:.4g} s without a sample from t = {run.times[longest]:.6g} s on"
    sampled_text = f"in a run that has samples for {sampled_seconds:.4g} s"
    return Anomaly(
        f"run {run.name}: {gap_text}, {sampled_text}; split it there into two runs", True
    )


def _check_time_scale(recording: Recording, run: Run, kind: type[Simulator]) -> Anomaly | None:
    """Find time stamps in a wrong unit: every coordinate moves far too slowly or far too fast.

    For each recorded coordinate, the time in which it moves in the recording is compared with the
    time that its own forces would need. There are three cases:

    * Far too fast, by `TIME_UNIT_RATIO_THRESHOLD`: an anomaly that is not certain.
    * Far too slow, and the sampling interval exceeds the expected time, for a robot with inputs by
      `DRIVEN_SYSTEM_FACTOR`: an anomaly. It is certain, so that it stops the program, if there are
      no inputs, or the interval exceeds the expected time by that factor.
    * Otherwise the time stamps are right. All coordinates share them, so nothing is reported even
      if another coordinate is too slow or too fast; it may belong to a link without inertia in the
      model file.

    The anomaly of the first coordinate is returned, or None.

    Args:
        recording: recorded runs, with their channels, inputs and constants.
        run: recorded run: times, channels and inputs.
        kind: simulator class.
    """
    # The forces of a system with its own stepping are not accessible.
    if not issubclass(kind, SystemSimulator) or (kind.own_engine and not kind.has_model):
        return None
    system = kind.system()
    interval = float(np.median(np.diff(run.times)))
    if kind.has_model:
        accelerations = _compute_static_accelerations(run, kind)
    else:
        accelerations = _compute_rest_accelerations(recording, run, system)
    # A servo holds its position by force, so large forces at rest are normal.
    is_driven = kind.has_model and _has_inputs(run)
    typical_sizes = {channel.name: channel.scale for channel in system.channels}
    first_anomaly: Anomaly | None = None
    for column, name in enumerate(system.coordinates):
        values = run.channels.get(name)
        if values is None:
            continue
        min_spread = MIN_MOTION_SHARE * typical_sizes.get(name, 1.0)
        expected_seconds = _compute_free_motion_time(values, accelerations[:, column], min_spread)
        if expected_seconds is None:
            continue
        # Shortest time after which the recorded values differ by as much as their spread (standard
        # deviation).
        recorded_seconds = interval * _estimate_lag(values)
        ratio = recorded_seconds / expected_seconds
        expected_text = f"as {kind.name} would within {expected_seconds:.2g} s"
        if 0 < ratio < 1 / TIME_UNIT_RATIO_THRESHOLD:
            moves = f"{name} moves in {recorded_seconds:.3g} s {expected_text}"
            anomaly = Anomaly(f"run {run.name}: {moves}; are the stamps seconds?", False)
        else:
            min_interval = (DRIVEN_SYSTEM_FACTOR if is_driven else 1.0) * expected_seconds
            if ratio < TIME_UNIT_RATIO_THRESHOLD or interval < min_interval:
                return None  # this coordinate shows that the time stamps are right
            moves = f"{name} takes {recorded_seconds:.3g} s to move {expected_text}"
            interval_text = f"samples lie {interval:.3g} s apart"
            is_certain = not _has_inputs(run) or interval >= DRIVEN_SYSTEM_FACTOR * expected_seconds
            anomaly = Anomaly(
                f"run {run.name}: {moves}, and {interval_text}; {_recommend_time_unit(ratio)}",
                is_certain,
            )
        first_anomaly = first_anomaly or anomaly
    return first_anomaly


def _recommend_time_unit(ratio: float) -> str:
    """Return the advice for time stamps that are too large by a factor: the unit that explains it.

    Args:
        ratio: recorded over expected time of a motion.
    """
    # The unit whose number in a second is closest to the factor, as a ratio.
    divisor = min(_TIME_UNITS, key=lambda factor: abs(np.log(ratio / factor)))
    return f"are the stamps {_TIME_UNITS[divisor]}? then divide t by {divisor:g}"


def _compute_free_motion_time(
    values: Array, accelerations: Array, min_spread: float
) -> float | None:
    """Return the time in s in which its own forces would move a coordinate as far as recorded.

    It is T' = (var x / mean a^2)^(1/4) (2), with the acceleration a that the forces cause at rest
    in the recorded positions x; None if the coordinate hardly moves, or no force acts.

    Args:
        values: (T,) recorded positions x.
        accelerations: (T,) accelerations a.
        min_spread: smallest standard deviation of the positions that counts as motion.
    """
    spread = float(np.nanstd(values))
    rms_acceleration = float(np.sqrt(np.nanmean(accelerations**2)))
    if not (spread > min_spread and rms_acceleration > 0):
        return None
    seconds: float = (spread / rms_acceleration) ** 0.5
    return seconds


def _has_inputs(run: Run) -> bool:
    return any(np.any(signal) for signal in run.inputs.values())


def _compute_rest_accelerations(recording: Recording, run: Run, system: System) -> Array:
    """Compute the accelerations (T, D) that the system's forces cause at the recorded positions.

    The system is at rest, so drag and friction do not act; D is the number of coordinates.
    Coordinates that are not recorded are at their default position, inputs that are missing are
    zero, and parameters are nominal.

    Args:
        recording: recorded runs, with their channels, inputs and constants.
        run: recorded run: times, channels and inputs.
        system: system of the recording.
    """
    # Each sample of the run is an element of a batch of T states.
    count = run.times.size
    values = {**recording.constants, **run.constants}
    constants = {c.name: np.full((count, 1), values.get(c.name, c.value)) for c in system.constants}
    theta = np.tile([p.nominal for p in system.parameters], (count, 1))
    default = [np.full(count, system.states[name]) for name in system.coordinates]
    columns = [
        run.channels.get(name, default_position)
        for name, default_position in zip(system.coordinates, default, strict=True)
    ]
    positions = np.stack(columns, axis=1)
    zeros = np.zeros((count, 1))
    inputs = {c.name: zeros for c in system.inputs}
    inputs |= {name: signal[:, None] for name, signal in run.inputs.items()}
    moment = StateSnapshot(
        system, theta, constants, zeros, positions, np.zeros_like(positions), inputs
    )
    with np.errstate(all="ignore"):
        accelerations: Array = system.force(moment) / system.mass(theta, constants)
    return accelerations


def _compute_static_accelerations(run: Run, kind: type[Simulator]) -> Array:
    """Compute accelerations of a robot at rest in recorded positions under recorded commands.

    They show how fast the robot could move, by which time stamps in a wrong unit are found.

    Args:
        run: run of the robot.
        kind: simulator class of the robot.

    Returns:
        (N, D) accelerations of the D joints with one coordinate, at N times of the run, at most
        `CHECKED_INSTANTS`.
    """
    # This import is needed for robots only.
    from sims.robot.contact_pairs import iterate_poses

    joints = [
        joint
        for joint in kind.robot.joints  # type: ignore[attr-defined]
        if joint.has_one_coordinate
    ]
    return np.array(
        [
            [data.qacc[joint.velocity] for joint in joints]
            for data in iterate_poses(kind, run.channels, run.inputs)
        ]
    )


def _estimate_lag(x: Array) -> float:
    """Estimate the shortest lag in samples after which values differ by their spread.

    It is the smallest T with mean (x(t + T) - x(t))^2 >= var x (1). Lags 1, 2, 4, ... are tried,
    and the last one below T is returned, so that the motion never seems slower than it is. It is 0
    if values differ as much from one sample to the next.

    Args:
        x: (T,) signal, NaN where missing.
    """
    variance = float(np.nanvar(x))
    lag, previous_lag = 1, 0
    while lag < x.size:
        differences = x[lag:] - x[:-lag]
        differences = differences[np.isfinite(differences)]
        if differences.size and float(np.mean(differences**2)) >= variance:
            return float(previous_lag)
        previous_lag, lag = lag, 2 * lag
    return float(previous_lag)


MAX_COMPARED_INSTANTS = 8000
"""Maximum number of times of a run at which command and position are compared."""
LAG_BIN_EDGES = (-2, -1, 0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)
"""Bounds of the intervals of equation (3), in grid steps before the time considered."""
BLOCK_COUNT = 4
"""Minimum number of blocks of a run for estimating the standard error of its drift."""
STUDENT_T_FACTORS = (
    9.0,
    9.0,
    9.0,
    2.7,
    1.9,
    1.6,
    1.43,
    1.35,
    1.3,
    1.25,
    1.2,
    1.18,
    1.16,
    1.14,
    1.12,
    1.1,
    1.05,
)
"""Correction factors of the standard error, indexed by the number of blocks.

They are the factors by which an error from few blocks is too small (Student's t at 95 %, one block
lost).
"""
MODEL_ERROR_SHARE = 0.01
"""Relative error of the drift from truncating equation (4)."""
MIN_EXPLAINED_VARIANCE = 0.9
"""Minimum share of a position's variance that equation (3) must explain."""
MIN_REPORTED_DRIFT = 2e-5
"""Smallest reported drift (dimensionless); ordinary quartz clocks differ by less."""


class _Estimate(NamedTuple):
    """Relative clock drift and its standard error, both dimensionless."""

    drift: float
    error: float


def check_clock_drift(recording: Recording, kind: type[Simulator]) -> Iterator[QualityFinding]:
    """Find the clock drift, pooled over all runs and driven coordinates, if it is significant.

    The clock of the sensors may run faster or slower than that of the commands. Then measured
    positions follow their commands later and later.

    Args:
        recording: Recording to check.
        kind: Simulator class of its system.

    Returns:
        At most one finding.
    """
    estimates = [
        estimate
        for command, position in _list_driven_positions(kind)
        for run in recording.runs
        if command in run.inputs and position in run.channels
        for estimate in _estimate_run_drifts(run, command, position)
    ]
    if not estimates:
        return
    drift, error = _pool_estimates(estimates)
    if abs(drift) < max(MIN_REPORTED_DRIFT, SIGNIFICANCE_SIGMAS * error):
        return
    word = "fast" if drift > 0 else "slow"
    yield QualityFinding(
        "drift",
        f"the sensors' clock runs {1e6 * abs(drift):.3g} ppm (±{2e6 * error:.2g}) {word} against "
        "the commands'",
        "stamp both with one clock; the effect clock.skew of simgap explain estimates and "
        "removes it",
    )


def _list_driven_positions(kind: type[Simulator]) -> list[tuple[str, str]]:
    """Return pairs of names: an input, and the channel of a position that it may drive.

    For a robot, it is the position of the actuator's joint; for other systems, each coordinate.

    Args:
        kind: simulator class of the recording's system.
    """
    if not issubclass(kind, SystemSimulator):
        return []
    if kind.has_model:
        robot: Any = kind
        return [(f"u.{a.name}", f"q.{a.joint}") for a in robot.robot.actuators if a.joint]
    return [(u.name, name) for u in kind.inputs for name in kind.system.coordinates]


def _estimate_run_drifts(run: Run, command: str, position: str) -> Iterator[_Estimate]:
    """Estimate the drift of the sensors' clock against the commands' clock in one run.

    1. The position is predicted from past commands, p(t) = c + d t + sum_k h_k <u>_k(t) (3), where
       <u>_k is the mean command over the k-th interval before t.
    2. A delay T that grows by a share e of the time, the drift, gives y(t) = p - (T + e t) p' to
       first order (4). So e is estimated by least squares from the part of y that is proportional
       to t times the velocity p'.

    Nothing is yielded if the run is short, or the commands explain too little of the motion;
    otherwise one estimate.

    Args:
        run: Run with its times, inputs and channels.
        command: Name of the input.
        position: Name of the channel that follows it.
    """
    t, u, y = run.times, run.inputs[command], run.channels[position]
    is_recorded = np.isfinite(y)
    if is_recorded.sum() < 2 * len(LAG_BIN_EDGES) or not (np.nanstd(y) > 0 and np.std(u) > 0):
        return
    # An even grid with the usual interval, or a longer one if the run has very many samples.
    step = max(float(np.median(np.diff(t))), float(t[-1] - t[0]) / MAX_COMPARED_INSTANTS)
    grid = np.arange(t[0], t[-1], step)
    positions = np.interp(grid, t[is_recorded], y[is_recorded])
    past_command_means = _average_over_intervals(np.interp(grid, t, u))
    # Samples for which all intervals lie within the run. The last edge is the longest time before a
    # sample, and the first one, which is negative, lies after it.
    fitted_part = slice(LAG_BIN_EDGES[-1], len(grid) + LAG_BIN_EDGES[0])
    time = (grid - grid.mean())[fitted_part]
    positions, past_command_means = positions[fitted_part], past_command_means[fitted_part]
    if time.size < BLOCK_COUNT * LAG_BIN_EDGES[-1] or not np.std(positions) > 0:
        return
    regressors = np.column_stack([np.ones_like(time), time, past_command_means])
    coefficients, *_ = np.linalg.lstsq(regressors, positions, rcond=1e-10)
    predicted = regressors @ coefficients  # Equation (3).
    if np.var(positions - predicted) > (1.0 - MIN_EXPLAINED_VARIANCE) * np.var(positions):
        return
    estimate = _fit_drift(time, positions, regressors, np.gradient(predicted, step))
    if estimate is not None:
        yield estimate


def _fit_drift(
    time: Array, positions: Array, regressors: Array, velocity: Array
) -> _Estimate | None:
    """Fit the drift e, the growth of a delay per time, to a position by least squares.

    To first order, the position changes by -e t p' (4), with the predicted velocity p'. What the
    regressors and a constant delay (the velocity) explain must not count as drift: only the part of
    -t p' that is orthogonal to both determines it.

    Args:
        time: (N,) times of the N samples about their mean, s.
        positions: (N,) recorded positions.
        regressors: (N, K) K columns by which the commands explain the position, equation (3).
        velocity: (N,) velocity p' that the commands predict.

    Returns:
        The drift and its standard error; None if nothing is orthogonal.
    """
    basis, _ = np.linalg.qr(np.column_stack([regressors, velocity]))
    # Response of the position to the drift, of which the orthogonal part is kept.
    delay_response = -time * velocity
    delay_response = delay_response - basis @ (basis.T @ delay_response)
    response_power = float(delay_response @ delay_response)
    if not response_power > 0:
        return None
    drift = float(delay_response @ positions) / response_power
    residual = positions - basis @ (basis.T @ positions) - drift * delay_response
    # The residual is autocorrelated, but hardly over more than the memory of (3): sums over blocks
    # of that length are independent, and their scatter gives the standard error.
    block_sums = np.add.reduceat(
        delay_response * residual, np.arange(0, time.size, LAG_BIN_EDGES[-1])
    )
    # The error from few blocks is too small by this factor.
    student_factor = STUDENT_T_FACTORS[min(len(block_sums), len(STUDENT_T_FACTORS) - 1)]
    error = student_factor * float(np.sqrt(block_sums @ block_sums)) / response_power
    # The truncation of (4) adds an error in proportion to the drift.
    return _Estimate(drift, float(np.hypot(error, MODEL_ERROR_SHARE * drift)))


def _average_over_intervals(command: Array) -> Array:
    """Return the means of a command over K intervals before each of its N samples.

    The ends of the intervals are `LAG_BIN_EDGES` samples before the sample; the first ones are
    negative, which is after it. Beyond the ends of the command, it counts as zero.

    Args:
        command: (N,) samples of the command.

    Returns:
        (N, K) means.
    """
    cumulative_sum = np.concatenate([[0.0], np.cumsum(command)])
    samples = np.arange(command.size)
    columns = []
    for shortest_lag, longest_lag in pairwise(LAG_BIN_EDGES):
        # The sum over an interval is the difference of the cumulative sum at its ends.
        first = np.clip(samples - longest_lag + 1, 0, command.size)
        end = np.clip(samples - shortest_lag + 1, 0, command.size)
        columns.append((cumulative_sum[end] - cumulative_sum[first]) / (longest_lag - shortest_lag))
    return np.column_stack(columns)


def _pool_estimates(estimates: list[_Estimate]) -> _Estimate:
    """Return the mean of estimates weighted by their inverse variances, and its standard error.

    If estimates scatter more than their errors allow, these are too small: the error is multiplied
    by the ratio of both (the square root of the reduced chi-squared, known as Birge ratio).

    Args:
        estimates: Drift and standard error of each run.
    """
    drifts, errors = np.array(estimates).T
    weights = np.maximum(errors, 1e-12) ** -2.0
    drift = float(weights @ drifts / weights.sum())
    error = float(weights.sum() ** -0.5)
    if len(estimates) > 1:
        reduced_chi_squared = float(weights @ (drifts - drift) ** 2) / (len(estimates) - 1)
        error *= max(reduced_chi_squared, 1.0) ** 0.5
    return _Estimate(drift, error)
