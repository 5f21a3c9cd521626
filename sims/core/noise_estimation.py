"""Estimate the noise of a sampled signal from the signal alone.

`estimate_noise` uses differences of samples at any times, and recognises quantised signals.
`estimate_roughness` fits cubics to windows of uniformly sampled signals.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sims.core.simulator import Array

SIGMA_PER_MEDIAN = 1.4826
"""Ratio of the standard deviation of a normal variable to its median magnitude."""
_QUANTISED_SHARE = 0.05
"""Share of unchanged samples above which a signal counts as quantised."""
_GAP_RATIO = 1.75
"""Ratio of an interval to the median interval above which it is a gap.

A lost sample makes an interval twice as long.
"""

NOISE_WINDOW_SAMPLES = 9
"""Length in samples of the windows to which cubics are fitted; shorter signals are not smoothed."""

_MIN_MOTION_SHARE = 1e-3
"""Smallest motion per sample of a window that is evaluated, as a share of the travel."""


class NoiseEstimate(NamedTuple):
    """An estimate of noise.

    Attributes:
        sigma: Standard deviation (1 sigma); NaN if unknown.
        step: Quantisation step; 0 if the signal is not quantised.
    """

    sigma: float
    step: float


def estimate_noise(signals: Iterable[tuple[Array, Array]]) -> NoiseEstimate:
    """Estimate white noise of a signal from its second and third differences.

    Shapes: T samples.

    The differences are the residuals of samples against a line or parabola through their neighbours
    (von Neumann et al., Ann. Math. Stat. 12, 153, 1941, doi:10.1214/aoms/1177731746). They are made
    robust by their median, and generalised to non-uniform sampling by divided differences

        d = sum_i w_i y_i,  w_i ~ 1 / prod_(j != i) (t_i - t_j),  sum_i w_i^2 = 1       (1)

    The smaller of the two estimates is used, since residual motion only increases them.
    Autocorrelated noise is underestimated, and motion that is fast relative to the sampling looks
    like noise. A quantised signal has at least its rounding noise.

    Args:
        signals: (times (T,), values (T,)) of each run; NaN values are missing.
    """
    runs = [
        (t[is_recorded], y[is_recorded])
        for t, y in signals
        if (is_recorded := np.isfinite(y)).any()
    ]
    sigmas = [estimate_differences_sigma(runs, order) for order in (2, 3)]
    step = _find_quantisation_step(runs)
    if not np.isfinite(sigmas).any():
        return NoiseEstimate(np.nan, step)
    # Rounding errors are uniform within half a step to either side: 1 sigma is step / sqrt(12).
    return NoiseEstimate(max(float(np.nanmin(sigmas)), step / 12**0.5), step)


def estimate_differences_sigma(signals: Iterable[tuple[Array, Array]], order: int) -> float:
    """Estimate white noise (1 sigma) from divided differences of one order, over all runs.

    Shapes: T samples.

    A difference of order n is the residual of a sample against a polynomial of degree n - 1 through
    n neighbours. The higher the order, the less a smooth motion contributes.

    Args:
        signals: (times (T,), values (T,)) of each run; NaN values are missing.
        order: Order of the differences.

    Returns:
        Standard deviation; NaN if all runs are too short.
    """
    differences = [
        _compute_divided_differences(t[is_recorded], y[is_recorded], order)
        for t, y in signals
        if (is_recorded := np.isfinite(y)).sum() > order + 1
    ]
    pooled = np.concatenate(differences) if differences else np.empty(0)
    return SIGMA_PER_MEDIAN * float(np.median(np.abs(pooled))) if pooled.size else np.nan


def _compute_divided_differences(times: Array, values: Array, order: int) -> Array:
    """Compute divided differences of samples: smooth motion cancels, noise stays.

    Shapes: T samples.

    With windows of order + 1 samples y_i at the times t_i, they are d = sum_i w_i y_i with
    w_i ~ 1 / prod_(j != i) (t_i - t_j), scaled by sum_i w_i^2 = 1 so that white noise keeps its
    variance (1). Windows across a gap are left out.

    Args:
        times: (T,) times, s.
        values: (T,) signal without missing samples.
        order: order of the differences.
    """
    t, y = sliding_window_view(times, order + 1), sliding_window_view(values, order + 1)
    # Motion across a gap is no longer close to a polynomial.
    is_gapless = t[:, -1] - t[:, 0] <= _GAP_RATIO * order * np.median(np.diff(times))
    t, y = t[is_gapless], y[is_gapless]
    # (windows, order + 1, order + 1); ones on the diagonal instead of the factors t_i - t_i = 0.
    time_differences = t[:, :, None] - t[:, None, :] + np.eye(order + 1)
    weights = 1.0 / time_differences.prod(axis=2)
    weights /= np.sqrt((weights * weights).sum(axis=1, keepdims=True))
    differences: Array = (weights * y).sum(axis=1)
    return differences


def estimate_roughness(values: Array) -> float:
    """Estimate the noise of a signal from the residuals of local cubic fits.

    Shapes: T samples.

    A cubic is fitted to each window of `NOISE_WINDOW_SAMPLES` samples in which the signal moves.
    Windows with gaps are skipped, and the median makes the result insensitive to bounces.

    Args:
        values: (T,) signal, NaN where missing.

    Returns:
        Standard deviation of the noise; NaN if the signal is too short or never moves.
    """
    if len(values) < NOISE_WINDOW_SAMPLES:
        return float("nan")
    windows = sliding_window_view(values, NOISE_WINDOW_SAMPLES)
    windows = windows[np.isfinite(windows).all(axis=1)]
    if not len(windows):
        return float("nan")
    # At rest the same pixels give the same error again and again, which is no scatter.
    finite_values = values[np.isfinite(values)]
    travel = max(float(np.ptp(finite_values)), 1e-12)
    min_motion = _MIN_MOTION_SHARE * travel * NOISE_WINDOW_SAMPLES
    windows = windows[np.ptp(windows, axis=1) > min_motion]
    if not len(windows):
        return float("nan")
    # A cubic has four coefficients, which reduces the degrees of freedom by four. With an
    # orthonormal basis of cubics, the fit is a projection.
    cubic = np.vander(np.linspace(-1, 1, NOISE_WINDOW_SAMPLES), 4)
    basis, _ = np.linalg.qr(cubic)
    residuals = windows - windows @ basis @ basis.T
    squares = (residuals**2).sum(axis=1)
    return float(np.sqrt(np.median(squares) / (NOISE_WINDOW_SAMPLES - 4)))


def _find_quantisation_step(runs: list[tuple[Array, Array]]) -> float:
    """Return the smallest change of a signal that often does not change at all; 0 otherwise."""
    changes = np.abs(np.concatenate([np.empty(0), *(np.diff(y) for _, y in runs)]))
    # Computed values that should be equal may differ by rounding, so tiny changes count as none.
    moving = changes[changes > 1e-12 * np.max(changes, initial=0.0)]
    quantised = moving.size and np.mean(changes == 0) > _QUANTISED_SHARE
    return float(moving.min()) if quantised else 0.0


def count_gaps(times: Array) -> int:
    """Count intervals that are much longer than the median interval."""
    intervals = np.diff(times)
    return int((intervals > _GAP_RATIO * np.median(intervals)).sum()) if intervals.size else 0
