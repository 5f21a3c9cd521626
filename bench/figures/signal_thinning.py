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
    # Each part has two extremes, and the first and the last sample are kept.
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
    edges = np.linspace(0, size, part_count + 1).astype(int)
    begins, ends = edges[:-1], edges[1:]
    # Each row has the samples of one part; shorter parts are padded with samples that are never
    # extremes.
    indices = np.minimum(begins[:, None] + np.arange((ends - begins).max()), size - 1)
    is_inside = indices < ends[:, None]
    parts = np.arange(part_count)
    selected_samples = [np.array([0, size - 1])]
    for signal in signals:
        for sign in (1.0, -1.0):  # Maximum and minimum.
            is_candidate = is_inside & np.isfinite(signal[indices])
            values = np.where(is_candidate, sign * signal[indices], -np.inf)
            selected_samples.append(indices[parts, values.argmax(axis=1)])
    return np.unique(np.concatenate(selected_samples))
