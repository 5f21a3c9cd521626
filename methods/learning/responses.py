"""How an observation responds to the inputs of its scenario: coefficients of a fitted equation of
motion.

Each channel's acceleration is fitted by what the channels and inputs do at the time. The fit is in
weak form (D. Messenger, D. Bortz, Weak SINDy, Multiscale Model. Simul. 19, 2021,
doi:10.1137/20M1343166): both sides are multiplied by bumps and integrated by parts, so that no
noisy signal is differentiated twice.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from methods.base import Array
from methods.learning.pair_inputs import resample

_SIDE_BY_SIDE = 12
"""Bumps that would fill a run; they overlap, each moved by an eighth of its width."""
_RIDGE = 1e-6
"""Per mean square of a regressor: two that say the same, a constant input and 1, share a
coefficient.
"""


def responses(observations: Array, inputs: Array, lengths: tuple[int, ...]) -> Array:
    """Coefficients of each run's channels, time being counted in samples.

    Args:
        observations: (n, T, C), the runs following one another along T; NaN where a sample is
            missing.
        inputs: (T, U) of the scenario in which all were made.
        lengths: samples of each run; one of fewer than seven gives none.

    Returns:
        (n, runs * C * (2 + 4 C + U)).
    """
    found, first = [np.empty((len(observations), 0))], 0
    for length in lengths:
        part = slice(first, first := first + length)
        if length >= 7:
            series = np.nan_to_num(resample(observations[:, part], (length,), length)).transpose(
                0, 2, 1
            )
            found.append(_response(series, inputs[part]))
    return np.concatenate(found, axis=1)


def _response(series: Array, inputs: Array) -> Array:
    """(n, C * R) of one run: series (n, T, C), inputs (T, U)."""
    half = max(3, series.shape[1] // (2 * _SIDE_BY_SIDE))
    s = np.arange(-half, half + 1) / (half + 1.0)
    bump, slope = (1 - s**2) ** 4, -8 * s * (1 - s**2) ** 3 / (half + 1)
    bend = (48 * s**2 * (1 - s**2) ** 2 - 8 * (1 - s**2) ** 3) / (half + 1) ** 2

    def integral(signal: Array, kernel: Array) -> Array:
        windows = sliding_window_view(signal, len(s), axis=1)[:, :: max(1, half // 4)]
        return np.asarray(windows @ kernel, dtype=np.float64)

    held = (
        inputs + np.concatenate([inputs[:1], inputs[:-1]])
    ) / 2.0  # an input is held until the next sample
    told = np.broadcast_to(held, (len(series), *inputs.shape))
    beside = np.concatenate(
        [np.ones_like(told[..., :1]), series, series**3, _sense(series), told], axis=2
    )
    regressors = np.concatenate([integral(beside, bump), -integral(series, slope)], axis=2)
    return _fitted(regressors, integral(series, bend)).reshape(len(series), -1)


def _sense(series: Array) -> Array:
    """Smoothed signs of the rates of change (n, T, C): what dry friction follows."""
    reach = np.arange(-3, 4)
    padded = np.pad(series, ((0, 0), (3, 3), (0, 0)), mode="edge")
    rates = sliding_window_view(padded, len(reach), axis=1) @ (reach / (reach**2).sum())
    typical = np.abs(rates).mean(axis=1, keepdims=True) + 1e-300
    return np.asarray(np.tanh(10.0 * rates / typical), dtype=np.float64)


def _fitted(regressors: Array, values: Array) -> Array:
    """Least squares (n, R, C) of values (n, J, C) on regressors (n, J, R), each lane for itself."""
    size = np.sqrt((regressors**2).mean(axis=1, keepdims=True)) + 1e-300
    scaled = regressors / size
    across = scaled.transpose(0, 2, 1)
    normal = across @ scaled / scaled.shape[1] + _RIDGE * np.eye(scaled.shape[2])
    coefficients = np.linalg.solve(normal, across @ values / scaled.shape[1])
    return np.asarray(coefficients / size.transpose(0, 2, 1), dtype=np.float64)
