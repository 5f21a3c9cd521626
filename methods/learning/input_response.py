"""Coefficients of a fitted equation of motion: how an observation responds to its inputs.

Each channel's acceleration is fitted by terms of the channels q and inputs u at the same time:

    (1)  q'' = k0 + k1 q + k3 q^3 + kf sense(q') + ku u + kd q'

The fit is in weak form (D. Messenger, D. Bortz, Weak SINDy, Multiscale Model. Simul. 19, 2021,
doi:10.1137/20M1343166): both sides are multiplied by a bump w that is zero at both ends, and
integrated by parts, so that no noisy signal is differentiated twice:

    (2)  integral of w q'' = integral of w'' q,   integral of w q' = -integral of w' q

    (3)  w(s) = (1 - s^2)^4, s from -1 to 1 over the bump
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from methods.learning.observation_features import resample_runs
from methods.tuner import Array

_BUMPS_PER_RUN = 12
"""Number of bumps that would fill a run without overlap.

They overlap: successive bumps are shifted by an eighth of their width.
"""
_MIN_SAMPLES = 7
"""Minimum number of samples of a run, for a bump of half width 3."""
_SIGN_STEEPNESS = 10.0
"""Factor in the smoothed sign: it saturates at a fraction of the mean rate of change."""
_MIN_DIVISOR = 1e-300
"""Minimum divisor, so that a zero signal stays zero."""
_RIDGE_PARAMETER = 1e-6
"""Ridge parameter, per mean square of a regressor.

With it, two collinear regressors, such as a constant input and 1, share a coefficient.
"""


def compute_response_coefficients(
    observations: Array, inputs: Array, lengths: tuple[int, ...]
) -> Array:
    """Fit an equation of motion (1) to each run and channel, with time in samples.

    The acceleration of a channel is fitted by a constant, and by position, its cube, a smoothed
    sign of the velocity, velocity and inputs.

    Args:
        observations: (n, T, C) observations with the runs concatenated along T; NaN for missing
            samples.
        inputs: (T, U) inputs of the scenario of all observations.
        lengths: number of samples of each run; a run of fewer than seven gives no coefficients.

    Returns:
        (n, runs * C * (1 + 4 C + U)) coefficients: for each channel those of (1), with the terms of
        every channel.
    """
    coefficients = [np.empty((len(observations), 0))]
    first = 0
    for length in lengths:
        run = slice(first, first + length)
        first += length
        if length < _MIN_SAMPLES:
            continue
        # Resampling to the run's own length fills missing samples and changes nothing else.
        resampled = resample_runs(observations[:, run], (length,), length)
        series = np.nan_to_num(resampled).transpose(0, 2, 1)
        coefficients.append(_compute_run_response(series, inputs[run]))
    return np.concatenate(coefficients, axis=1)


def _compute_run_response(series: Array, inputs: Array) -> Array:
    """Compute the coefficients (n, C * R) of one run from series (n, T, C) and inputs (T, U)."""
    half_width = max(3, series.shape[1] // (2 * _BUMPS_PER_RUN))
    bump_width = half_width + 1
    s = np.arange(-half_width, half_width + 1) / (half_width + 1.0)
    parabola = 1 - s**2
    bump = parabola**4  # (3)
    # Derivatives w' and w'' of the bump, per sample.
    slope = -8 * s * parabola**3 / bump_width
    second_derivative = (48 * s**2 * parabola**2 - 8 * parabola**3) / bump_width**2
    stride = max(1, half_width // 4)

    def integral(signal: Array, kernel: Array) -> Array:
        windows = sliding_window_view(signal, len(s), axis=1)[:, ::stride]
        return np.asarray(windows @ kernel, dtype=np.float64)

    # An input is constant until the next sample, so around a sample it is the mean of two values.
    earlier_inputs = np.concatenate([inputs[:1], inputs[:-1]])
    held_inputs = (inputs + earlier_inputs) / 2.0
    driven = np.broadcast_to(held_inputs, (len(series), *inputs.shape))
    constant = np.ones_like(driven[..., :1])
    # All terms of (1) except the last one, which needs the derivative w'.
    signals = np.concatenate(
        [constant, series, series**3, _compute_smoothed_velocity_signs(series), driven], axis=2
    )
    regressors = np.concatenate([integral(signals, bump), -integral(series, slope)], axis=2)  # (2)
    accelerations = integral(series, second_derivative)  # (2)
    return _fit_ridge_regression(regressors, accelerations).reshape(len(series), -1)


def _compute_smoothed_velocity_signs(series: Array) -> Array:
    """Compute smoothed signs of the rates of change (n, T, C), a regressor for dry friction."""
    # Slopes of lines through seven samples; noise would change the sign of single differences.
    offsets = np.arange(-3, 4)
    line = offsets / (offsets**2).sum()
    padded = np.pad(series, ((0, 0), (3, 3), (0, 0)), mode="edge")
    rates = sliding_window_view(padded, len(offsets), axis=1) @ line
    mean_rate = np.abs(rates).mean(axis=1, keepdims=True) + _MIN_DIVISOR
    # tanh replaces the sign function, which would jump where noise crosses zero.
    return np.asarray(np.tanh(_SIGN_STEEPNESS * rates / mean_rate), dtype=np.float64)


def _fit_ridge_regression(regressors: Array, values: Array) -> Array:
    """Compute ridge least squares (n, R, C) of values (n, J, C) on regressors (n, J, R).

    Each of the n observations is fitted separately.
    """
    # Scaled to mean square 1, so that the ridge has the same effect on every regressor.
    size = np.sqrt((regressors**2).mean(axis=1, keepdims=True)) + _MIN_DIVISOR
    scaled = regressors / size
    transposed = scaled.transpose(0, 2, 1)
    count = scaled.shape[1]
    ridge = _RIDGE_PARAMETER * np.eye(scaled.shape[2])
    normal = transposed @ scaled / count + ridge
    coefficients = np.linalg.solve(normal, transposed @ values / count)
    return np.asarray(coefficients / size.transpose(0, 2, 1), dtype=np.float64)
