"""Select samples: thin out slow motion, leave out unsettled filters, fill in lost commands.

Neighbouring samples of a slow motion share the rounding errors of an encoder and vibrations that no
model of the robot contains: at 500 Hz and more they, and not the motion, decide a likelihood. Each
k-th sample is kept, with the largest k that preserves all motion: the other samples follow from a
cubic spline through the kept ones (C. de Boor, A Practical Guide to Splines, 1978, chapter 4) as
well as from one through every second sample.

The activation of a filter at the start of a run is not recorded. For a robot at rest it equals the
first command, MuJoCo starts it at zero, and in a log that was cut out of a motion it can have any
value. After a few time constants nothing depends on it, and the commands up to then are known.

A row that a logger has lost lacks a command, too. To hold the previous command in its place would
be an error of the first order in the interval, which resembles a delay; cubic interpolation between
its neighbours (H. Akima, J. ACM 17(4), 589, 1970) leaves one of a higher order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.logs.quality.noise_estimation import SIGMA_PER_MEDIAN
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array, Simulator
from sims.recording.recording import Recording, Run

MAX_UNCHANGED_RATE = 400.0
"""Sampling rate in Hz up to which a recording is kept unchanged."""
MIN_THINNED_RATE = 100.0
"""Minimum sampling rate in Hz after thinning."""
MAX_ERROR_RATIO = 1.25
"""Maximum ratio of the interpolation error to that of keeping every second sample."""
NEGLIGIBLE_ERROR_SHARE = 1e-4
"""Negligible interpolation error as a fraction of a channel's range: a simulation's accuracy."""
MIN_AVAILABLE_SHARE = 0.9
"""Minimum share of available samples of each channel."""
INTEGER_INTERVAL_TOLERANCE = 0.3
"""Tolerance for lost samples, as a fraction of the sampling interval.

An interval that is so close to a whole multiple of the median interval has lost the samples
between.
"""
MAX_FILLED_SAMPLES = 5
"""Maximum number of successive lost samples whose commands are interpolated."""
MAX_FILLED_JITTER = 0.05
"""Maximum jitter, as a share of the sampling interval, at which lost commands are interpolated."""
MIN_RUN_SAMPLES = 40
"""Minimum number of samples that each run must keep."""


def thin_recording(recording: Recording, kind: type[Simulator]) -> tuple[Recording, str]:
    """Keep each k-th sample of a robot's recording if these samples contain all motion.

    Inputs with zero-order hold are averaged between the samples that are kept.

    Args:
        recording: Recording as it was read.
        kind: Simulator class of its system.

    Returns:
        The recording, and a message for the user, which is empty if it is unchanged.
    """
    rate = min(
        (
            float(1.0 / np.median(np.diff(run.times))) if run.times.size > 1 else 0.0
            for run in recording.runs
        ),
        default=0.0,
    )
    if not kind.has_model or rate <= MAX_UNCHANGED_RATE:
        return recording, ""
    stride = next(
        (
            k
            for k in range(round(rate / MIN_THINNED_RATE), 1, -1)
            if _preserves_motion(recording, k)
        ),
        1,
    )
    if stride == 1:
        return recording, ""
    runs = tuple(_thin_run(run, stride) for run in recording.runs)
    note = (
        f"sampled at {rate:.4g} Hz, much faster than the motion: one sample in {stride} is "
        "used, and the mean of the inputs between them"
    )
    return replace(recording, runs=runs), note


class LostSamples(NamedTuple):
    """Samples that are lost between those of a run.

    Attributes:
        counts: (T - 1,) number of lost samples in each interval.
        jitter: standard deviation of the intervals, as a share of the median interval.
    """

    counts: NDArray[np.intp]
    jitter: float


def find_lost_samples(times: Array) -> LostSamples:
    """Find lost samples: where an interval is a multiple of the median interval.

    An interval of about three median intervals has lost two samples. Intervals that are not close
    to a whole multiple, within the jitter of the clock, count as they are.

    Args:
        times: (T,) sample times, s; at least three.
    """
    steps = np.diff(times)
    ratios = steps / np.median(steps)
    multiples = np.maximum(np.round(ratios), 1.0)
    deviations = ratios - multiples
    jitter = SIGMA_PER_MEDIAN * float(np.median(np.abs(deviations - np.median(deviations))))
    is_multiple = np.abs(deviations) < max(INTEGER_INTERVAL_TOLERANCE, 3.0 * jitter)
    return LostSamples(np.where(is_multiple, multiples - 1, 0).astype(np.intp), jitter)


def fill_lost_commands(recording: Recording) -> tuple[Recording, str]:
    """Insert a sample with interpolated commands and empty channels where a row was lost.

    Runs without inputs, or with uneven sampling intervals, and longer gaps stay as they are.

    Returns:
        The recording, and a message for the user, which is empty if nothing was lost.
    """
    count, runs = 0, []
    for run in recording.runs:
        if run.inputs and run.times.size > 2:
            lost = find_lost_samples(run.times)
            filled = np.where(lost.counts <= MAX_FILLED_SAMPLES, lost.counts, 0)
            if lost.jitter <= MAX_FILLED_JITTER and filled.sum() > 0:
                count += int(filled.sum())
                run = _insert_samples(run, filled)
        runs.append(run)
    if not count:
        return recording, ""
    note = (
        f"{count} commands of rows that are lost are interpolated: log commands in a separate file "
        "if they jump"
    )
    return replace(recording, runs=tuple(runs)), note


def _insert_samples(run: Run, counts: NDArray[np.intp]) -> Run:
    """Insert evenly spaced samples into a run, with interpolated inputs and without readings.

    Args:
        run: the run.
        counts: (T - 1,) number of samples to insert into each interval.
    """
    # For each inserted sample, the index of the sample before its interval.
    first = np.repeat(np.arange(counts.size), counts)
    inserted_before = np.cumsum(counts) - counts
    fractions = (np.arange(first.size) - inserted_before[first] + 1.0) / (counts[first] + 1.0)
    times = run.times[first] + fractions * np.diff(run.times)[first]
    indices = first + 1

    def interpolate(values: Array) -> Any:
        """Return a local cubic interpolation, which does not overshoot where commands jump."""
        # Imported here, because few recordings need it.
        from scipy.interpolate import Akima1DInterpolator

        return Akima1DInterpolator(run.times, values, method="makima")

    def insert(signals: Mapping[str, Any], values: Callable[[Any], Any]) -> dict[str, Any]:
        """Insert the values that a function gives for each signal."""
        return {name: np.insert(old, indices, values(old)) for name, old in signals.items()}

    return replace(
        run,
        times=np.insert(run.times, indices, times),
        channels=insert(run.channels, lambda _: np.nan),
        inputs=insert(run.inputs, lambda old: interpolate(old)(times)),
        extra=insert(run.extra, lambda old: old[first]),
        off=insert(run.off, lambda old: old[first]),
    )


def _preserves_motion(recording: Recording, stride: int) -> bool:
    """Return whether every k-th sample still shows the whole motion.

    The motion between the kept samples is interpolated by a spline. If every second sample is kept,
    the error of this is only noise. With every k-th one it may hardly be larger.

    Args:
        recording: recorded runs, with their channels, inputs and constants.
        stride: the number k.
    """
    for run in recording.runs:
        if run.times.size < MIN_RUN_SAMPLES * stride:
            return False
        for values in run.channels.values():
            if np.isfinite(values).mean() < MIN_AVAILABLE_SHARE:
                return False
            min_error = NEGLIGIBLE_ERROR_SHARE * float(np.ptp(values[np.isfinite(values)]))
            allowed_error = max(
                MAX_ERROR_RATIO * _compute_interpolation_error(run.times, values, 2), min_error
            )
            if _compute_interpolation_error(run.times, values, stride) > allowed_error:
                return False
    return True


def _compute_interpolation_error(times: Array, values: Array, stride: int) -> float:
    """Return the RMS error of a cubic spline through every k-th sample at the other samples.

    Args:
        times: (T,) times in seconds.
        values: (T,) signal, NaN where missing.
        stride: the number k.
    """
    # Import SciPy here, since only fast recordings need it.
    from scipy.interpolate import CubicSpline

    is_recorded = np.isfinite(values)
    is_node = is_recorded & (np.arange(times.size) % stride == 0)
    first, last = np.flatnonzero(is_node)[[0, -1]]
    is_left_out = is_recorded & ~is_node
    is_left_out[:first] = is_left_out[last:] = False
    if not is_left_out.any():
        return 0.0
    errors = CubicSpline(times[is_node], values[is_node])(times[is_left_out]) - values[is_left_out]
    return compute_rms(errors)


def _thin_run(run: Run, stride: int) -> Run:
    """Keep every k-th sample of a run, and average its inputs from each one to the next.

    Inputs that are interpolated linearly between samples are not averaged.

    Args:
        run: recorded run: times, channels and inputs.
        stride: the number k.
    """
    thinned_run = run.part(slice(None, None, stride))
    first = np.arange(0, run.times.size, stride)
    spans = np.diff(run.times, append=run.times[-1] + np.median(np.diff(run.times)))
    inputs = dict(thinned_run.inputs)
    for name in thinned_run.inputs:
        if name not in run.linear:
            weighted_sums = np.add.reduceat(run.inputs[name] * spans, first)
            inputs[name] = weighted_sums / np.add.reduceat(spans, first)
    return replace(thinned_run, inputs=inputs)


LARGEST_SHARE = 0.5
"""Maximum share of a run that may be left out."""


def leave_out_settling(recording: Recording, kind: type[Simulator]) -> tuple[Recording, str]:
    """Leave out the first samples of runs whose first activations (filter outputs) are not known.

    A filter before an actuator depends on commands before the run; after a few time constants this
    is forgotten. A run keeps all of its samples if its filters take more than half of it to settle,
    or if the robot has floating bodies, whose later poses are not recorded; its filters then begin
    at the first commands.

    Args:
        recording: Recording as it was read.
        kind: Simulator class of its system.

    Returns:
        The recording, and a message for the user, which is empty if nothing is left out.
    """
    if not kind.has_model:
        return recording, ""
    robot: Any = kind
    if robot.system.floating_state_units or not robot.system.activations:
        return recording, ""
    from sims.robot.dynamics.activation_filters import activation_filters, compute_settling_time

    runs: list[Run] = []
    seconds = 0.0
    longest = compute_settling_time(robot.robot, {})
    for run in recording.runs:
        run = replace(run, memory=max(run.memory, longest))
        settling = 0.0 if run.before else compute_settling_time(robot.robot, run.initial)
        first = int(np.searchsorted(run.times, run.times[0] + settling))
        if settling > 0 and settling <= LARGEST_SHARE * (run.times[-1] - run.times[0]):
            seconds = max(seconds, settling)
            run = run.part(slice(first, None))
        runs.append(run)
    if not seconds:
        return recording, ""
    filters = activation_filters(robot.robot)
    names = ", ".join(state_filter.actuator.name for state_filter in filters)
    note = (
        f"the first {seconds:.3g} s of runs are left out, in which the filters of {names} settle: "
        "their first activations are not recorded (state them if they are known: "
        f'[runs.NAME.initial] "{filters[0].state}" = 0.0)'
    )
    return replace(recording, runs=tuple(runs)), note
