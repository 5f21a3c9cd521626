"""Features of scenarios: initial values, and how the observation responds to the inputs.

Each channel's acceleration is fitted by terms of the channels q and inputs u at the same time:

    (1)  q'' = k0 + k1 q + k3 q^3 + kf sense(q') + ku u + kd q'

The fit is in weak form (D. Messenger, D. Bortz, Weak SINDy, Multiscale Model. Simul. 19, 2021,
doi:10.1137/20M1343166): both sides are multiplied by a bump w that is zero at both ends, and
integrated by parts, so that no noisy signal is differentiated twice:

    (2)  integral of w q'' = integral of w'' q,   integral of w q' = -integral of w' q

    (3)  w(s) = (1 - s^2)^4, s from -1 to 1 over the bump

Initial values that no channel shows are inputs as they are. Input signals are not: appended to the
observation they were measured to be worth next to nothing, since what a sample means depends on all
inputs before it (docs/tunenet.md). The network reads how the observation responds to them, much the
same whatever they were; and then that alone, since samples whose meaning changes from scenario to
scenario only mislead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from methods.learning.observation_features import resample_runs
from methods.tuner import Array, ScenarioInfo

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
    """Fit an equation of motion to each run and channel, with time in samples.

    The acceleration of a channel is fitted by q'' = k0 + k1 q + k3 q^3 + kf sign(q') + ku u + kd q'
    (1), with the terms of all channels q and inputs u, and a smoothed sign.

    Shapes: n observations, T samples, C channels, U inputs.

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
    """Compute the coefficients (n, C * R) of one run from series (n, T, C) and inputs (T, U).

    Both sides of the equation of motion (1) of `compute_response_coefficients` are multiplied by a
    bump w, which is zero at both ends, and integrated, at many places of the run. By parts, the
    integral of w q'' is that of w'' q, and the integral of w q' is minus that of w' q (2), so that
    no noisy signal is differentiated. The result is a linear regression on R terms for each of n
    observations.

    Shapes: T samples, C channels, U inputs.

    Args:
        series: (n, T, C) channels without gaps.
        inputs: (T, U) inputs, held between samples.
    """
    half_width = max(3, series.shape[1] // (2 * _BUMPS_PER_RUN))
    bump_width = half_width + 1
    # Position in the bump, from -1 to 1, without its ends, where the bump is zero.
    s = np.arange(-half_width, half_width + 1) / (half_width + 1.0)
    parabola = 1 - s**2
    bump = parabola**4
    # Derivatives w' and w'' of the bump, per sample.
    slope = -8 * s * parabola**3 / bump_width
    second_derivative = (48 * s**2 * parabola**2 - 8 * parabola**3) / bump_width**2
    stride = max(1, half_width // 4)

    def integral(signal: Array, kernel: Array) -> Array:
        # The sum of signal times kernel, for the kernel at every `stride`-th sample.
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
    """Compute smoothed signs of the rates of change (n, T, C), a regressor for dry friction.

    Shapes: n observations, T samples, C channels.

    Args:
        series: (n, T, C) observed channels.

    Returns:
        (n, T, C) values in -1 to 1.
    """
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

    Args:
        regressors: (n, J, R) values of R terms in J equations.
        values: (n, J, C) right-hand sides of the J equations for each of C channels.
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


_EQUALITY_TOLERANCE = 1e-9
"""Relative difference below which numbers count as equal."""
_STD_PER_MAD = 1.4826
"""Standard deviations of a normal distribution per median absolute deviation."""


@dataclass(frozen=True)
class ScenarioFeatures:
    """Map from scenarios and observations to network inputs that describe the scenario.

    Attributes:
        centre: (K,) medians of the training data: first the initial values, then the response
            coefficients if inputs vary.
        spread: (K,) scaled median absolute deviations from them; 0 for a constant number.
        initial: number of initial values among the K numbers.
    """

    centre: Array
    spread: Array
    initial: int

    @classmethod
    def fit(
        cls, scenes: Sequence[ScenarioInfo], observations: Array, lengths: tuple[int, ...]
    ) -> ScenarioFeatures | None:
        """Compute the map from training scenarios.

        Shapes: T samples, C channels.

        Args:
            scenes: scenario information of each scenario.
            observations: (scenarios, m, T, C) observations of m simulations per scenario.
            lengths: number of samples of each run.

        Returns:
            The map; None if all scenarios are equal.
        """
        initial = np.array([scene.initial for scene in scenes])
        has_varying_inputs = _differs_between_scenarios(
            np.array([scene.inputs for scene in scenes])
        )
        # Equal scenarios give constant inputs, which carry no information.
        if not has_varying_inputs and not _differs_between_scenarios(initial):
            return None
        table = np.concatenate(
            [
                _compute_unscaled_numbers(observation, lengths, scene, has_varying_inputs)
                for observation, scene in zip(observations, scenes, strict=True)
            ]
        )
        # Medians are used, because a fitted coefficient can be far off if a run hardly moves.
        centre = np.median(table, axis=0)
        distances = np.abs(table - centre)
        return cls(centre, _STD_PER_MAD * np.median(distances, axis=0), initial.shape[1])

    @property
    def has_varying_inputs(self) -> bool:
        """True if inputs vary between scenarios, so that response coefficients are computed."""
        return self.initial < len(self.centre)

    def __call__(self, observations: Array, lengths: tuple[int, ...], scene: ScenarioInfo) -> Array:
        """Compute network inputs, which grow logarithmically far from the training data.

        Shapes: n observations, T samples, C channels, K inputs of the network.

        Args:
            observations: (n, T, C) observations in SI units.
            lengths: number of samples of each run.
            scene: scenario information.

        Returns:
            (n, K) network inputs.

        Raises:
            ValueError: the scenario has another number of values than those of the training.
        """
        features = _compute_unscaled_numbers(observations, lengths, scene, self.has_varying_inputs)
        if len(scene.initial) != self.initial or features.shape[1] != len(self.centre):
            raise ValueError(
                f"the network expects {len(self.centre)} numbers of a scenario, "
                f"this one has {features.shape[1]}; "
                "train on scenarios with the same inputs and channels"
            )
        is_varying = self.spread > 0
        # A number that was constant in training gets no weight.
        scale = np.where(is_varying, 1.0 / np.where(is_varying, self.spread, 1.0), 0.0)
        # arcsinh is the identity near zero and logarithmic far out, so outliers do not saturate
        # units.
        return np.asarray(np.arcsinh((features - self.centre) * scale), dtype=np.float64)


def _compute_unscaled_numbers(
    observations: Array, lengths: tuple[int, ...], scene: ScenarioInfo, has_varying_inputs: bool
) -> Array:
    """Compute the K numbers (n, K) that describe a scenario, for each of n observations (n, T, C).

    They are the initial values, and the response coefficients if inputs vary between scenarios.

    Args:
        observations: (n, T, C) observations in this scenario.
        lengths: number of samples of each run; T in total.
        scene: initial values and inputs of the scenario.
        has_varying_inputs: whether inputs vary between the scenarios of the training.
    """
    initial = np.broadcast_to(scene.initial, (len(observations), len(scene.initial)))
    if not has_varying_inputs:
        return initial
    coefficients = compute_response_coefficients(observations, scene.inputs, lengths)
    return np.concatenate([initial, coefficients], axis=1)


def _differs_between_scenarios(numbers: Array) -> bool:
    """Return whether any number of an array (scenarios, ...) differs between scenarios."""
    if not numbers.size:
        return False
    sizes = np.abs(numbers).max(axis=0)
    return bool(np.any(np.ptp(numbers, axis=0) > _EQUALITY_TOLERANCE * sizes))
