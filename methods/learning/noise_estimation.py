"""Estimate the white noise of observations from third differences."""

from __future__ import annotations

import numpy as np

from methods.tuner import Array

_MAX_PARTS = 8
"""Maximum number of parts of a run for the noise estimate."""


_MIN_PART_DIFFERENCES = 16
"""Minimum number of third differences in a part."""


_NORMAL_MAD = 0.6745
"""Median absolute value of a normal variable, in standard deviations."""


_THIRD_DIFFERENCE_STD: float = 20.0**0.5
"""Standard deviation of third differences of white noise with variance 1.

The variance is 1 + 9 + 9 + 1 = 20.
"""


def estimate_noise_sigma(observations: Array, lengths: tuple[int, ...]) -> Array:
    """Estimate the standard deviation of white noise from the third differences of each run.

    It is the one that explains the median third difference of the run's smoothest part, because
    smooth motion has nearly none. A run is divided into up to eight parts of at least sixteen
    differences, so that impacts and rattling elsewhere do not count.

    Args:
        observations: (n, T, C) observations; NaN for missing samples.
        lengths: number of samples of each run.

    Returns:
        (n, C) noise in SI units: for each channel the largest one of all runs, 0 if no run has four
        successive samples.
    """
    sigmas = np.zeros((observations.shape[0], observations.shape[2]))
    for run in np.split(observations, np.cumsum(lengths)[:-1], axis=1):
        # Third differences of a parabola are zero, so those of smooth motion are small.
        third_differences = np.abs(np.diff(run, n=3, axis=1))
        count = min(_MAX_PARTS, max(1, third_differences.shape[1] // _MIN_PART_DIFFERENCES))
        parts = np.array_split(third_differences, count, axis=1)
        for i, c in np.ndindex(sigmas.shape):
            min_median = _compute_min_part_median([part[i, :, c] for part in parts])
            noise = min_median / (_NORMAL_MAD * _THIRD_DIFFERENCE_STD)
            sigmas[i, c] = max(float(sigmas[i, c]), noise)
    return sigmas


def _compute_min_part_median(parts: list[Array]) -> float:
    """Return the smallest median of the parts, without NaN; 0 if there are no values."""
    medians = []
    for part in parts:
        available_values = part[~np.isnan(part)]
        if available_values.size:
            medians.append(float(np.median(available_values)))
    return min(medians, default=0.0)
