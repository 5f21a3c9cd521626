"""Thinning of long signals for figures and charts: their extremes stay visible."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Array


def thin_signal(values: Array, max_samples: int) -> NDArray[np.intp]:
    """Select at most `max_samples` samples: the minimum and maximum of each part of a signal.

    Args:
        values: signal (T,), NaN where missing.
        max_samples: maximum number of samples; a signal that is not longer is not thinned.

    Returns:
        Sorted indices of the samples.
    """
    if values.size <= max_samples:
        return np.arange(values.size)
    return select_extreme_samples([values], max_samples // 2 - 1)


def select_extreme_samples(signals: Sequence[Array], part_count: int) -> NDArray[np.intp]:
    """Select the samples at which any signal has its minimum or maximum within a part of the run.

    The first and the last sample are included.

    Args:
        signals: Signals (T,), NaN where missing.
        part_count: Number of parts, of nearly equal length.

    Returns:
        Sorted indices of the samples.
    """
    size = len(signals[0])
    edges = np.linspace(0, size, part_count + 1).astype(int)[:-1]
    part_length = np.diff([*edges, size]).max()
    # Each row holds one part; shorter parts are padded with values that are never extremes.
    indices = np.minimum(edges[:, None] + np.arange(part_length), size - 1)
    is_inside = indices < np.append(edges[1:], size)[:, None]
    rows = np.arange(len(edges))
    selected_samples = [np.array([0, size - 1])]
    for signal in signals:
        for sign in (1.0, -1.0):
            values = np.where(
                is_inside & np.isfinite(signal[indices]), sign * signal[indices], -np.inf
            )
            selected_samples.append(indices[rows, values.argmax(axis=1)])
    return np.unique(np.concatenate(selected_samples))
