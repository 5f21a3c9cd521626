"""Thin out the samples of slow motion.

Neighbouring samples of a slow motion share the rounding errors of an encoder and vibrations that no
model of the robot contains: at 500 Hz and more they, and not the motion, decide a likelihood. Each
k-th sample is kept, with the largest k that preserves all motion: the other samples follow from a
cubic spline through the kept ones (C. de Boor, A Practical Guide to Splines, 1978, chapter 4) as
well as from one through every second sample.

`take_every_nth` thins a run by a factor that the caller states, whatever motion is lost.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array, Indices, Simulator
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
MIN_RUN_SAMPLES = 40
"""Minimum number of samples that each run must keep."""

MIN_CHANNEL_SAMPLE_SHARE = 0.5
"""Minimum number of samples of a channel after thinning, as a share of the expected number.

A channel that is sampled rarely might otherwise lose all its samples.
"""


def thin_recording(recording: Recording, kind: type[Simulator]) -> tuple[Recording, str]:
    """Keep each k-th sample of a robot's recording if these samples contain all motion.

    The largest such k is taken with which the sampling rate stays above `MIN_THINNED_RATE`. Inputs
    with zero-order hold are averaged between the samples that are kept.

    Args:
        recording: Recording as it was read.
        kind: Simulator class of its system.

    Returns:
        The recording, and a message for the user, which is empty if it is unchanged.
    """
    # Sampling rate of the slowest run, Hz; a run of one sample has none.
    rate = min(
        (
            float(1.0 / np.median(np.diff(run.times))) if run.times.size > 1 else 0.0
            for run in recording.runs
        ),
        default=0.0,
    )
    if not kind.has_model or rate <= MAX_UNCHANGED_RATE:
        return recording, ""
    # The stride is the number k. The largest one is tried first; None if each would lose motion.
    strides = range(round(rate / MIN_THINNED_RATE), 1, -1)
    stride = next((k for k in strides if _preserves_motion(recording, k)), None)
    if stride is None:
        return recording, ""
    runs = tuple(_thin_run(run, stride) for run in recording.runs)
    note = (
        f"sampled at {rate:.4g} Hz, much faster than the motion: one sample in {stride} is "
        "used, and the mean of the inputs between them"
    )
    return replace(recording, runs=runs), note


def _preserves_motion(recording: Recording, stride: int) -> bool:
    """Return whether every k-th sample still shows the whole motion of each channel in each run.

    The samples between the kept ones are predicted by a spline. If every second sample is kept, the
    error of the prediction is only noise. With every k-th one it may be hardly larger, or else
    negligible compared with the range of the channel. Short runs and channels with many missing
    samples count as not preserved.

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
            # An error that is a tiny share of the range of the channel is allowed in any case.
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
    # The spline is not extrapolated.
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
    kept_indices = np.arange(0, run.times.size, stride)
    # Seconds for which each sample of an input holds; the last one for a usual interval.
    durations = np.diff(run.times, append=run.times[-1] + np.median(np.diff(run.times)))
    inputs = dict(thinned_run.inputs)
    for name in thinned_run.inputs:
        if name not in run.linear:
            # Mean over time from each kept sample to the next.
            integrals = np.add.reduceat(run.inputs[name] * durations, kept_indices)
            inputs[name] = integrals / np.add.reduceat(durations, kept_indices)
    return replace(thinned_run, inputs=inputs)


def take_every_nth(run: Run, factor: int) -> Run:
    """Return the run with every n-th sample of its channels; n is `factor`.

    An input becomes its mean between the kept samples, so that it has the same effect. Columns that
    are neither channels nor inputs (`extra`) are left out.

    Args:
        run: Recorded run: times, channels and inputs.
        factor: The number n.
    """
    kept = np.arange(0, run.times.size, factor)
    return replace(
        run,
        times=run.times[kept],
        channels={name: values[kept] for name, values in run.channels.items()},
        inputs={
            name: _average_input(run.times, values, kept) for name, values in run.inputs.items()
        },
        extra={},
    )


def _average_input(times: Array, values: Array, kept: Indices) -> Array:
    """Return the mean (K,) of an input over the samples from each kept sample to the next one.

    Args:
        times: (T,) sample times in seconds.
        values: (T,) input, held from each sample to the next one.
        kept: (K,) indices of the kept samples.

    Returns:
        Means, weighted by duration; after the last kept sample, the mean of the rest of the run.
    """
    durations = np.diff(times, append=times[-1])
    # The last sample has no duration; a tiny one avoids 0 / 0 if it is a kept sample.
    durations[-1] = 1e-9 * max(float(times[-1] - times[0]), 1e-9)
    # `reduceat` sums from each kept sample to the next one, exclusive.
    weighted_sums = np.add.reduceat(values * durations, kept)
    means: Array = weighted_sums / np.add.reduceat(durations, kept)
    return means


def has_enough_samples(thinned_run: Run, run: Run, factor: int) -> bool:
    """Return whether every channel of a thinned run has about its expected number of samples.

    A channel that is recorded at a lower rate than the others could lose nearly all its samples.

    Args:
        thinned_run: The run after subsampling.
        run: The run before.
        factor: Every `factor`-th sample was kept.
    """
    for name, values in run.channels.items():
        sample_count = int(np.isfinite(values).sum())
        thinned_count = int(np.isfinite(thinned_run.channels[name]).sum())
        if thinned_count < MIN_CHANNEL_SAMPLE_SHARE * sample_count / factor:
            return False
    return True
