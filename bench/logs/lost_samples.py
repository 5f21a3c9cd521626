"""Find samples that a logger has lost, and fill in their commands.

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

from sims.core.noise_estimation import SIGMA_PER_MEDIAN
from sims.core.simulator import Array
from sims.recording.recording import Recording, Run

INTEGER_INTERVAL_TOLERANCE = 0.3
"""Tolerance for lost samples, as a fraction of the sampling interval.

An interval that is so close to a whole multiple of the median interval has lost the samples
between.
"""
MAX_FILLED_SAMPLES = 5
"""Maximum number of successive lost samples whose commands are interpolated."""
MAX_FILLED_JITTER = 0.05
"""Maximum jitter, as a share of the sampling interval, at which lost commands are interpolated."""


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

    An interval of about three median intervals has lost two samples. An interval that is not close
    to a whole multiple, within the jitter of the clock, has lost none.

    Args:
        times: (T,) sample times, s; at least three.
    """
    steps = np.diff(times)
    ratios = steps / np.median(steps)
    multiples = np.maximum(np.round(ratios), 1.0)
    deviations = ratios - multiples
    # Robust standard deviation, from the median absolute deviation.
    jitter = SIGMA_PER_MEDIAN * float(np.median(np.abs(deviations - np.median(deviations))))
    is_multiple = np.abs(deviations) < max(INTEGER_INTERVAL_TOLERANCE, 3.0 * jitter)
    return LostSamples(np.where(is_multiple, multiples - 1, 0).astype(np.intp), jitter)


def fill_lost_commands(recording: Recording) -> tuple[Recording, str]:
    """Insert a sample with interpolated commands and missing readings where a row was lost.

    Runs without inputs, or with uneven sampling intervals, and gaps of more than
    `MAX_FILLED_SAMPLES` samples stay as they are.

    Args:
        recording: Recording as it was read.

    Returns:
        The recording, and a message for the user, which is empty if nothing was lost.
    """
    count, runs = 0, []
    for run in recording.runs:
        if run.inputs and run.times.size > 2:
            lost = find_lost_samples(run.times)
            fill_counts = np.where(lost.counts <= MAX_FILLED_SAMPLES, lost.counts, 0)
            if lost.jitter <= MAX_FILLED_JITTER and fill_counts.sum() > 0:
                count += int(fill_counts.sum())
                run = _insert_samples(run, fill_counts)
        runs.append(run)
    if not count:
        return recording, ""
    note = (
        f"{count} commands of rows that are lost are interpolated: log commands in a separate file "
        "if they jump"
    )
    return replace(recording, runs=tuple(runs)), note


def _insert_samples(run: Run, counts: NDArray[np.intp]) -> Run:
    """Insert evenly spaced samples into a run, with interpolated inputs and missing readings.

    Extra columns and the masks of drives that are off keep the value of the sample before.

    Args:
        run: the run.
        counts: (T - 1,) number of samples to insert into each interval.
    """
    # For each inserted sample, the index of the interval, and of the sample before it.
    intervals = np.repeat(np.arange(counts.size), counts)
    # Number of the inserted sample in its interval, from 1.
    numbers = np.arange(intervals.size) - (np.cumsum(counts) - counts)[intervals] + 1.0
    fractions = numbers / (counts[intervals] + 1.0)
    times = run.times[intervals] + fractions * np.diff(run.times)[intervals]
    indices = intervals + 1

    def interpolate(values: Array) -> Any:
        """Return a local cubic interpolation, which does not overshoot where commands jump."""
        # Imported here, because few recordings need it.
        from scipy.interpolate import Akima1DInterpolator

        return Akima1DInterpolator(run.times, values, method="makima")

    def insert(signals: Mapping[str, Any], values: Callable[[Any], Any]) -> dict[str, Any]:
        """Insert new samples into each signal; `values` computes them from the old signal."""
        return {name: np.insert(old, indices, values(old)) for name, old in signals.items()}

    return replace(
        run,
        times=np.insert(run.times, indices, times),
        channels=insert(run.channels, lambda _: np.nan),
        inputs=insert(run.inputs, lambda old: interpolate(old)(times)),
        extra=insert(run.extra, lambda old: old[intervals]),
        off=insert(run.off, lambda old: old[intervals]),
    )
