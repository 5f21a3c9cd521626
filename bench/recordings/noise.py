"""How noisy a sampled signal is, judged from the signal alone."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sims.base import Array

_MAD = 1.4826
"""Times the median magnitude of a normal variable is its standard deviation."""
_SAME = 0.05
"""Share of samples that do not change from which on a signal counts as quantised."""
_GAP = 1.75
"""An interval longer than this many times the median one is a gap: a lost sample makes it twice as
long.
"""


class NoiseEstimate(NamedTuple):
    """An estimate of 1 sigma, and the step by which a quantised signal changes (0 where it is not);
    NaN if unknown.
    """

    sigma: float
    step: float


def estimated(signals: Iterable[tuple[Array, Array]]) -> NoiseEstimate:
    """Noise from what is left of samples when a parabola or a line through their neighbours is
    taken off.

    For even sampling these are third and second differences (von Neumann et al., Ann. Math. Stat.
    12, 153, 1941, doi:10.1214/aoms/1177731746), made robust by their median and generalised to
    uneven sampling by divided differences

        d = sum_i w_i y_i,  w_i ~ 1 / prod_(j != i) (t_i - t_j),  sum_i w_i^2 = 1       (1)

    The smaller of the two counts: what is left of the motion only adds. It assumes white noise;
    noise that is alike from one sample to the next looks smaller, motion that is fast against the
    sampling looks like noise. A quantised signal has at least the noise of its rounding.

    Args:
        signals: (times (T,), values (T,)) of each run; NaN values are missing.
    """
    runs = [(t[seen], y[seen]) for t, y in signals if (seen := np.isfinite(y)).any()]
    sigmas, step = [_sigma(runs, order) for order in (2, 3)], _step(runs)
    if not np.isfinite(sigmas).any():
        return NoiseEstimate(np.nan, step)
    # Rounding to steps errs evenly within half a step to either side: 1 sigma is step / sqrt(12).
    return NoiseEstimate(max(float(np.nanmin(sigmas)), step / 12**0.5), step)


def differences_sigma(signals: Iterable[tuple[Array, Array]], order: int) -> float:
    """1 sigma of white noise from divided differences (1) of one order, over all runs; NaN where
    all are too short. The higher the order, the less of a smooth motion is left.
    """
    return _sigma([(t[seen], y[seen]) for t, y in signals if (seen := np.isfinite(y)).any()], order)


def _sigma(runs: list[tuple[Array, Array]], order: int) -> float:
    """1 sigma from differences of one order, over all runs; NaN where all are too short."""
    rests = [_rests(t, y, order) for t, y in runs if t.size > order + 1]
    pooled = np.concatenate(rests) if rests else np.empty(0)
    return _MAD * float(np.median(np.abs(pooled))) if pooled.size else np.nan


def _rests(times: Array, values: Array, order: int) -> Array:
    """Divided differences of the given order, scaled to the variance of one sample; none across
    gaps.
    """
    t, y = sliding_window_view(times, order + 1), sliding_window_view(values, order + 1)
    # Across a gap the motion is no line any more.
    near = t[:, -1] - t[:, 0] <= _GAP * order * np.median(np.diff(times))
    t, y = t[near], y[near]
    # The ones on the diagonal leave out the factor t_i - t_i.
    between = t[:, :, None] - t[:, None, :] + np.eye(order + 1)
    # (1): a polynomial of a lower order is left as nothing, white noise with its own variance.
    weights = 1.0 / between.prod(axis=2)
    weights /= np.sqrt((weights * weights).sum(axis=1, keepdims=True))
    rests: Array = (weights * y).sum(axis=1)
    return rests


def _step(runs: list[tuple[Array, Array]]) -> float:
    """The smallest change of a signal that often does not change at all."""
    changes = np.abs(np.concatenate([np.empty(0), *(np.diff(y) for _, y in runs)]))
    # Equal values that were computed may differ by rounding: what is tiny is no change.
    moving = changes[changes > 1e-12 * np.max(changes, initial=0.0)]
    quantised = moving.size and np.mean(changes == 0) > _SAME
    return float(moving.min()) if quantised else 0.0


def gaps(times: Array) -> int:
    """Number of intervals much longer than the median one."""
    intervals = np.diff(times)
    return int((intervals > _GAP * np.median(intervals)).sum()) if intervals.size else 0
