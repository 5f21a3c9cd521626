"""Resamples of targets, and percentile-bootstrap intervals over targets.

Source: B. Efron, R. Tibshirani, An Introduction to the Bootstrap, 1993, ch. 13.

A resample is represented by the number of times that it contains each target. A mean is then a
weighted mean, and a median is found by counting along the sorted values, once for all resamples.
scipy's bootstrap builds every resample as an array, which takes twenty times as long for 825
targets and 48 columns. It gives the same numbers from the same draws; the tests compare both.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.core.random_streams import make_rng
from sims.core.simulator import Array

ResampleCounts = NDArray[np.unsignedinteger[Any]]
"""Number of times that each target is in each resample, shape (n, resamples).

The smallest unsigned integer type that holds n is used.
"""
INTERVAL_QUANTILES = (0.025, 0.975)
"""Quantiles of the bootstrap distribution that bound a 95 % interval."""


def compute_bootstrap_interval(
    values: Array,
    statistic: Callable[[Array, ResampleCounts], Array],
    *names: str,
    resamples: int = 2000,
) -> tuple[Array, Array]:
    """Compute the 95 % percentile-bootstrap interval of a statistic over the rows of an array.

    Targets are drawn with replacement many times; the statistic of each resample is computed, and
    the interval contains 95 % of these values.

    Args:
        values: (n, m) measured values, one row per target, one column per number of simulations;
            rows that are not finite are left out.
        statistic: `compute_resampled_means` or `compute_resampled_medians`.
        names: names that determine the random stream of the bootstrap.
        resamples: number of resamples.

    Returns:
        Lower and upper bounds (m,); NaN if there are fewer than two rows.
    """
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) < 2:
        return np.full(values.shape[1], np.nan), np.full(values.shape[1], np.nan)
    counts = draw_resample_counts(len(values), resamples, make_rng("bootstrap", *names))
    low, high = np.quantile(statistic(values, counts), INTERVAL_QUANTILES, axis=1)
    return low, high


def draw_resample_counts(n: int, resamples: int, rng: np.random.Generator) -> ResampleCounts:
    """Draw n targets with replacement, and count how often each one is drawn.

    Args:
        n: number of targets.
        resamples: number of resamples.
        rng: random generator.

    Returns:
        (n, resamples) counts.
    """
    indices = rng.integers(n, size=(resamples, n))
    # The indices of resample r are moved to n r ... n r + n - 1, so that one call counts all.
    indices += n * np.arange(resamples)[:, None]
    counts = np.bincount(indices.ravel(), minlength=resamples * n)
    return np.ascontiguousarray(counts.reshape(resamples, n).T.astype(np.min_scalar_type(n)))


def compute_resampled_means(values: Array, counts: ResampleCounts) -> Array:
    """Compute means of resampled rows.

    Args:
        values: (n, m) one row per target.
        counts: (n, resamples) number of times that each row is in each resample.

    Returns:
        (m, resamples) means.
    """
    total = np.zeros((values.shape[1], counts.shape[1]))
    # Rows are added one by one: the summation order of a matrix product depends on the machine.
    for row, draw_counts in zip(values, counts, strict=True):
        total += row[:, None] * draw_counts
    return total / len(values)


def compute_resampled_medians(values: Array, counts: ResampleCounts) -> Array:
    """Compute medians of resampled rows, without building the resamples.

    The values are sorted once. The number of times that each value occurs in a resample then tells
    which of them are in the middle; for an even number of rows the median is the mean of two.

    Args:
        values: (n, m) one row per target.
        counts: (n, resamples) number of times that each row is in each resample.

    Returns:
        (m, resamples) medians.
    """
    n = len(values)
    resampled_medians = np.empty((values.shape[1], counts.shape[1]))
    for column, medians in zip(values.T, resampled_medians, strict=True):
        order = np.argsort(column)
        cumulative_counts = np.cumsum(counts[order], axis=0, dtype=counts.dtype)
        # With k counted from 0, the k-th smallest value of a resample is the first sorted value
        # whose cumulative count is larger than k. Its index is the
        # number of cumulative counts that are not larger than k.
        lower, upper = (
            np.add.reduce(cumulative_counts <= k, axis=0, dtype=counts.dtype)
            for k in ((n - 1) // 2, n // 2)
        )
        medians[:] = 0.5 * (column[order[lower]] + column[order[upper]])
    return resampled_medians


RESAMPLES = 1000
"""Number of resamples of a 95 % interval."""


def draw_target_resamples(targets: int, *names: str) -> NDArray[np.int64]:
    """Draw target indices with replacement, from a random stream that depends on names only.

    Tuners that share the targets get the same draws, so that their statistics can be compared.

    Args:
        targets: number of targets.
        names: names that determine the random stream.

    Returns:
        (RESAMPLES, targets) indices.
    """
    return make_rng("resample", *names).integers(targets, size=(RESAMPLES, targets))


def compute_percentile_interval(values: Array) -> tuple[float, float]:
    """Return the 95 % percentile interval of resampled values (n,), which may be infinite.

    The ends are values themselves, without interpolation, which would fail for infinite ones.
    Positions between two values are rounded outwards.
    """
    ordered = np.sort(values)
    n = len(ordered)
    lower, upper = (share * (n - 1) for share in INTERVAL_QUANTILES)
    return float(ordered[int(lower)]), float(ordered[int(np.ceil(upper))])
