"""Input rows of the networks of learned tuners: features of an observation and of its scenario.

Pure numpy, so that tuning needs no torch.

Features of an observation (`ObservationFeatures`). An observation (T, C) becomes a row of numbers
in three steps: each run is resampled to a fixed number of points (RESAMPLE in Algorithm 1, arXiv
1907.11200); rates of change and sorted copies are added; each number is centred, and weighed by how
reliably it followed the parameters in training.

With x a number, d its parameters' differences from their mean within a scenario, and strictness s:

    (1)  x - mean = d slopes + residual, by least squares in each scenario
    (2)  reliability of a parameter = e / (e + s * residual), e = |slope| * spread of the parameter
    (3)  weight = (largest reliability, scaled to the same maximum for each parameter)^2, per
         deviation
    (4)  weight for the scenario = (b / (b + s * w))^2, per deviation, with b and w the standard
         deviations between and within scenarios

Features of a scenario (`ScenarioFeatures`): initial values, and how the observation responds to the
inputs. Each channel's acceleration is fitted by terms of the channels q and inputs u at the same
time:

    (5)  q'' = k0 + k1 q + k3 q^3 + kf sign(q') + ku u + kd q'

The fit is in weak form (D. Messenger, D. Bortz, Weak SINDy, Multiscale Model. Simul. 19, 2021,
doi:10.1137/20M1343166): both sides are multiplied by a bump w that is zero at its ends, and
integrated by parts, so that no noisy signal is differentiated twice:

    (6)  integral of w q'' = integral of w'' q,   integral of w q' = -integral of w' q

    (7)  w(s) = (1 - s^2)^4, s from -1 to 1 over the bump

Initial values that no channel shows are inputs of the network. Input signals are not: appended to
the observation, they hardly improved the estimates, since a sample depends on all inputs
before it (docs/tunenet.md). If the signals differ between scenarios, the network reads only the
response to them, which depends little on the signals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from methods.learning.network_training import check_shapes
from methods.learning.training_data import TrainingData
from methods.tuner import Array, ScenarioInfo

_ROUNDING_SHARE = 1e-9
"""Threshold of rounding errors, as a share of the largest deviation."""
_MIN_DEVIATION_SHARE = 1e-3
"""Minimum deviation, as a share of the largest one; smaller ones are not scaled up further."""
_MIN_DIVISOR = 1e-300
"""Minimum divisor, so that zero divided by zero is finite, and a zero signal stays zero."""
_BUMPS_PER_RUN = 12
"""Number of bumps (7) that would fill a run without overlap.

They overlap: successive bumps are shifted by an eighth of their width.
"""
_MIN_FITTED_SAMPLES = 7
"""Minimum number of samples of a run for the fit of (5), for a bump of half width 3."""
_SIGN_STEEPNESS = 10.0
"""Factor in the smoothed sign: it saturates at a fraction of the mean rate of change."""
_RIDGE_PARAMETER = 1e-6
"""Ridge parameter of the fit of (5), per mean square of a regressor.

With it, two collinear regressors, such as a constant input and 1, share a coefficient.
"""
_EQUALITY_TOLERANCE = 1e-9
"""Relative difference below which numbers of two scenarios count as equal."""
_STD_PER_MAD = 1.4826
"""Standard deviations of a normal distribution per median absolute deviation."""
_OBSERVATION_FEATURE_ARRAYS = ("chosen", "centre", "gain")
"""Names of the arrays of `ObservationFeatures` that are stored."""
_SCENARIO_FEATURE_ARRAYS = ("centre", "spread", "initial")
"""Names of the arrays of `ScenarioFeatures` that are stored."""
_MISSING_ARRAY = np.empty(0)
"""Replacement of a missing array."""


def resample_runs(observations: Array, lengths: tuple[int, ...], points: int) -> Array:
    """Resample every run to the same number of points by linear interpolation, without gaps.

    A network needs inputs of one size, but runs differ in length and lack samples.

    Shapes: n observations, T samples, C channels.

    Args:
        observations: (n, T, C) observations with the runs concatenated along T; NaN for missing
            samples.
        lengths: number of samples of each run; their sum is T.
        points: number of points of each resampled run, evenly spaced over its samples.

    Returns:
        (n, runs * C, points); NaN in a series without any sample.

    Raises:
        ValueError: the lengths do not add up to T.
    """
    observation_count, samples, channels = observations.shape
    if sum(lengths) != samples:
        raise ValueError(
            f"runs of {lengths} samples add up to {sum(lengths)}, the observation has {samples}"
        )
    resampled = np.empty((observation_count, len(lengths), channels, points))
    first = 0
    for run, length in enumerate(lengths):
        series = observations[:, first : first + length].transpose(0, 2, 1)
        first += length
        # Interpolation at the samples would return them; most runs need no interpolation.
        if length == points and not np.isnan(series).any():
            resampled[:, run] = series
            continue
        sample_indices = np.arange(length)
        positions = np.linspace(0, length - 1, points)
        for observation_index, channel_index in np.ndindex(observation_count, channels):
            resampled[observation_index, run, channel_index] = _interpolate_channel(
                positions, sample_indices, series[observation_index, channel_index]
            )
    return resampled.reshape(observation_count, len(lengths) * channels, points)


def _interpolate_channel(positions: Array, samples: NDArray[np.intp], values: Array) -> Array:
    """Interpolate linearly between available samples of one channel of one run.

    Args:
        positions: (points,) sample indices at which values are computed; they need not be whole.
        samples: (T,) indices of the samples.
        values: (T,) samples; NaN for missing ones.

    Returns:
        (points,) values; NaN if all samples are missing.
    """
    is_available = ~np.isnan(values)
    if not is_available.any():
        return np.full(len(positions), np.nan)
    interpolated: Array = np.interp(positions, samples[is_available], values[is_available])
    return interpolated


def compute_descriptors(series: Array) -> Array:
    """Describe each series by values and rates of change, in order of time and sorted by size.

    Sorted values are independent of time, so they do not change if the motion is shifted in time.

    Args:
        series: (n, series, points) resampled series of n observations.

    Returns:
        (n, series * (4 * points - 2)) numbers of each observation.
    """
    rates = np.diff(series, axis=-1)
    parts = (
        series,
        rates,
        np.sort(series, axis=-1),
        np.sort(rates, axis=-1),
    )
    return np.concatenate(parts, axis=-1).reshape(len(series), -1)


@dataclass(frozen=True)
class ObservationFeatures:
    """Map from observations to a network's input rows.

    Attributes:
        points: number of points to which each run is resampled.
        plain: True to use the resampled series only, without rates and sorting.
        chosen: (D,) indices of the numbers that are used.
        centre: (D,) values that are subtracted from them.
        gain: (D,) factors that they are then multiplied by.
    """

    points: int
    plain: bool
    chosen: Array
    centre: Array
    gain: Array

    def __call__(self, observations: Array, lengths: tuple[int, ...]) -> Array:
        """Compute input rows (n, D) from observations (n, T, C).

        Shapes: n observations, T samples, C channels, D inputs of the network.

        Args:
            observations: observations in SI units; NaN for missing samples.
            lengths: number of samples of each run.

        Raises:
            ValueError: the observation yields fewer numbers than the network was trained on.
        """
        # No number of an observation is used if the network reads features of scenarios alone.
        if not self.chosen.size:
            return np.empty((len(observations), 0))
        raw_features = _compute_feature_rows(observations, lengths, self.points, self.plain)
        chosen_numbers = self.chosen.astype(np.intp)
        if chosen_numbers.max() >= raw_features.shape[1]:
            raise ValueError(
                f"the network reads entry {chosen_numbers.max()} of an observation, "
                f"this one has {raw_features.shape[1]}; "
                "train on observations of the same runs and channels"
            )
        centred = raw_features[:, chosen_numbers] - self.centre
        scaled = centred * self.gain
        # A series without any sample is replaced by its mean.
        return np.nan_to_num(scaled)


def _compute_feature_rows(
    observations: Array, lengths: tuple[int, ...], points: int, is_raw: bool
) -> Array:
    """Compute all candidate numbers (n, D) of observations (n, T, C).

    Shapes: n observations, T samples, C channels, D candidate numbers.

    Args:
        observations: (n, T, C) observations.
        lengths: number of samples of each run; T in total.
        points: number of points to which each run is resampled.
        is_raw: whether the numbers are the resampled values, and not descriptors of them.
    """
    series = resample_runs(observations, lengths, points)
    return series.reshape(len(series), -1) if is_raw else compute_descriptors(series)


def make_raw_features(
    observations: Array, lengths: tuple[int, ...], points: int
) -> ObservationFeatures:
    """Make the published inputs: resampled series in SI units, neither centred nor scaled.

    Shapes: n observations, T samples, C channels.

    Args:
        observations: (n, T, C) observations in SI units.
        lengths: number of samples of each run.
        points: number of points to which each run is resampled.
    """
    size = _compute_feature_rows(observations[:1], lengths, points, is_raw=True).shape[1]
    indices = np.arange(size, dtype=np.float64)
    return ObservationFeatures(points, True, indices, np.zeros(size), np.ones(size))


def make_weighted_features(
    data: TrainingData, points: int, max_inputs: int, strictness: float
) -> ObservationFeatures:
    """Choose and scale inputs by how closely they follow the parameters.

    Within each scenario every candidate number is fitted as a linear function of the parameters
    (1). Each number then has two weights, of which the larger one counts; s is the strictness:

    * For the parameters: its reliability is e / (e + s u), with the RMS e that a parameter explains
      and the RMS u of the residual (2). A large residual (jumps, curvature, noise) means a poor
      predictor, above all outside the training range. Each parameter's reliabilities are scaled to
      the same maximum, so that a parameter with strong effects does not hide the others. The weight
      is the square of the largest one (3).
    * For the scenario: (b / (b + s w))^2, with the standard deviations b between and w within
      scenarios (4). It is large if the number describes the scenario.

    Args:
        data: training simulations.
        points: number of points to which each run is resampled.
        max_inputs: maximum number of inputs, those with the largest weights; 0 for none.
        strictness: factor s.

    Returns:
        The inputs; their mean square over the training data is 1.
    """
    raw_features = _compute_feature_rows(
        data.flattened_observations, data.lengths, points, is_raw=False
    )
    grouped = raw_features.reshape(*data.parameters.shape[:2], -1)
    spread, explained, unexplained = _compute_sensitivities(data.parameters, grouped)
    deviation = raw_features.std(axis=0)
    scenario_spread = grouped.mean(axis=1).std(axis=0)
    floor = _ROUNDING_SHARE * max(float(deviation.max()), _MIN_DIVISOR)
    reliability = explained / (explained + strictness * unexplained + floor)  # (2)
    best = reliability.max(axis=1, keepdims=True)
    relative_reliability = reliability / np.where(best > 0, best, 1.0)
    parameter_weight = np.max(relative_reliability**2, axis=0)  # (3)
    scenario_weight = (
        scenario_spread / (scenario_spread + strictness * spread + floor)
    ) ** 2  # (4)
    # A stable sort chooses the same numbers on every machine if weights are equal.
    order = np.argsort(-np.maximum(parameter_weight, scenario_weight), kind="stable")
    chosen_numbers = np.sort(order[:max_inputs])
    # A number's factor is its weight per unit of its deviation, so that the inputs are comparable:
    # the deviation within scenarios for the parameters, in all of the data for the scenario.
    by_parameters = _compute_weight_per_deviation(
        parameter_weight[chosen_numbers], spread[chosen_numbers]
    )
    by_context = _compute_weight_per_deviation(
        scenario_weight[chosen_numbers], deviation[chosen_numbers]
    )
    gain = np.maximum(by_parameters, by_context)
    # The network's initial weights and learning rate assume inputs of mean square 1.
    rms_input = np.sqrt(np.mean((gain * deviation[chosen_numbers]) ** 2)) if max_inputs else 1.0
    return ObservationFeatures(
        points,
        False,
        chosen_numbers.astype(np.float64),
        raw_features[:, chosen_numbers].mean(axis=0),
        gain / rms_input if rms_input > 0 else gain,
    )


def _compute_weight_per_deviation(weight: Array, deviation: Array) -> Array:
    """Return the weight per unit of deviation, limited for small deviations."""
    min_deviation = _MIN_DEVIATION_SHARE * deviation.max(initial=0.0)
    scaled: Array = weight / (deviation + min_deviation + _MIN_DIVISOR)
    return scaled


def _compute_sensitivities(parameters: Array, rows: Array) -> tuple[Array, Array, Array]:
    """Fit each number as a linear function of the parameters within scenarios.

    In each scenario, x - mean = d slopes + residual (1) is solved by least squares, with the number
    x of a simulation and the differences d of its parameters from their mean.

    Args:
        parameters: (scenarios, m, dim) parameters of m simulations in each scenario.
        rows: (scenarios, m, D) the D numbers of each of their observations.

    Returns:
        Root mean squares of each number (D,), of the part that each parameter explains (dim, D),
        and of the residual (D,).
    """
    scenarios, simulations_per_scenario, dim = parameters.shape
    count = rows.shape[2]
    offsets = parameters - parameters.mean(axis=1, keepdims=True)
    # A fit with 1 + dim free numbers leaves this share of the variance of pure noise, by which the
    # residual is corrected.
    residual_share = max(simulations_per_scenario - 1 - dim, 1) / simulations_per_scenario
    total = np.zeros(count)
    residual_variance = np.zeros(count)
    explained = np.zeros((dim, count))
    for delta, values in zip(offsets, rows, strict=True):
        centred = values - values.mean(axis=0)
        slopes, *_ = np.linalg.lstsq(delta, centred, rcond=None)  # (1)
        residuals = centred - delta @ slopes
        total += np.mean(centred**2, axis=0)
        residual_variance += np.mean(residuals**2, axis=0) / residual_share
        explained += np.mean(delta**2, axis=0)[:, None] * slopes**2
    return (
        np.sqrt(total / scenarios),
        np.sqrt(explained / scenarios),
        np.sqrt(residual_variance / scenarios),
    )


def compute_response_coefficients(
    observations: Array, inputs: Array, lengths: tuple[int, ...]
) -> Array:
    """Fit an equation of motion to each run and channel, with time in samples.

    The acceleration of a channel is fitted by q'' = k0 + k1 q + k3 q^3 + kf sign(q') + ku u + kd q'
    (5), with the terms of all channels q and inputs u, and a smoothed sign.

    Shapes: n observations, T samples, C channels, U inputs.

    Args:
        observations: (n, T, C) observations with the runs concatenated along T; NaN for missing
            samples.
        inputs: (T, U) inputs of the scenario of all observations.
        lengths: number of samples of each run; a run of fewer than seven gives no coefficients.

    Returns:
        (n, runs * C * (1 + 4 C + U)) coefficients: for each channel those of (5), with the terms of
        every channel.
    """
    coefficients = [np.empty((len(observations), 0))]
    first = 0
    for length in lengths:
        run = slice(first, first + length)
        first += length
        if length < _MIN_FITTED_SAMPLES:
            continue
        # Resampling to the run's own length fills missing samples and changes nothing else.
        resampled = resample_runs(observations[:, run], (length,), length)
        series = np.nan_to_num(resampled).transpose(0, 2, 1)
        coefficients.append(_compute_run_response(series, inputs[run]))
    return np.concatenate(coefficients, axis=1)


def _compute_run_response(series: Array, inputs: Array) -> Array:
    """Compute the coefficients (n, C * R) of one run from series (n, T, C) and inputs (T, U).

    Both sides of the equation of motion (5) of `compute_response_coefficients` are multiplied by a
    bump w, which is zero at both ends, and integrated, at many places of the run. By parts, the
    integral of w q'' is that of w'' q, and the integral of w q' is minus that of w' q (6), so that
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
    bump = parabola**4  # (7)
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
    # All terms of (5) except the last one, which needs the derivative w'.
    signals = np.concatenate(
        [constant, series, series**3, _compute_smoothed_velocity_signs(series), driven], axis=2
    )
    regressors = np.concatenate([integral(signals, bump), -integral(series, slope)], axis=2)  # (6)
    accelerations = integral(series, second_derivative)  # (6)
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


@dataclass(frozen=True)
class FeatureConfig:
    """Configuration of network inputs and of the noise in training.

    Attributes:
        points: number of points to which each run is resampled; L in Algorithm 1.
        inputs: maximum number of inputs that are used from an observation.
        strictness: see `make_weighted_features`.
        noise: sensor noise that a second network is trained with, as standard deviation in units of
            each channel's standard deviation in training; 0 for no second network.
        raw: True for the resampled series in SI units without weights, as published; the other
            settings then have no effect.
        use_scenario_features: True to use scenario information too, if scenarios differ in it; see
            `ScenarioFeatures`.
        channels: indices of the first and the last channel that are used; None for all.
        clean: whether targets may be noise-free; if not, only the network for noisy targets is
            trained.
        proposed: configuration of the inputs of the network's proposed side, if it differs.
    """

    points: int = 400
    inputs: int = 400
    strictness: float = 1000.0
    noise: float = 0.01
    raw: bool = False
    use_scenario_features: bool = True
    channels: tuple[int, int] | None = None
    clean: bool = True
    proposed: FeatureConfig | None = None

    def select_channels(self, observations: Array) -> Array:
        """Return the channels (..., c) that are used, of observations (..., C) with C channels.

        Indices beyond the last channel are replaced by the last one.
        """
        if self.channels is None:
            return observations
        last_channel = observations.shape[-1] - 1
        first, last = (min(channel, last_channel) for channel in self.channels)
        return observations[..., first : last + 1]


@dataclass(frozen=True)
class InputFeatures:
    """Map to input rows, chosen and scaled by the training simulations.

    Attributes:
        reading: configuration from which it was made.
        observation_features: map from observations to input rows.
        scenario_features: map from scenario information to further inputs; None if scenarios were
            equal in training.
    """

    reading: FeatureConfig
    observation_features: ObservationFeatures
    scenario_features: ScenarioFeatures | None = None

    @classmethod
    def fit(cls, data: TrainingData, reading: FeatureConfig) -> InputFeatures:
        """Choose the inputs from training data: samples that follow the parameters.

        If scenarios differ, numbers that describe them are added; if their input signals differ,
        these numbers replace the samples. As published (`reading.raw`) all resampled samples are
        inputs.

        Args:
            data: training simulations.
            reading: configuration of the inputs.
        """
        data = data._replace(observations=reading.select_channels(data.observations))
        if reading.raw:
            raw_features = make_raw_features(
                data.flattened_observations, data.lengths, reading.points
            )
            return cls(reading, raw_features)
        scenario_features = None
        if reading.use_scenario_features:
            scenario_features = ScenarioFeatures.fit(data.scenes, data.observations, data.lengths)
        # If inputs vary, samples have another meaning in each scenario, so only responses are used.
        has_varying_inputs = scenario_features is not None and scenario_features.has_varying_inputs
        input_count = 0 if has_varying_inputs else reading.inputs
        observation_features = make_weighted_features(
            data, reading.points, input_count, reading.strictness
        )
        return cls(reading, observation_features, scenario_features)

    @property
    def feature_count(self) -> int:
        """Length of an input row."""
        scenario_size = 0 if self.scenario_features is None else self.scenario_features.centre.size
        return self.observation_features.chosen.size + scenario_size

    def __call__(
        self,
        observations: Array,
        lengths: tuple[int, ...],
        scene: ScenarioInfo,
        missing: Array | None = None,
    ) -> Array:
        """Compute input rows (n, D) from observations (n, T, C) of one scenario.

        Shapes: n observations, T samples, C channels, D inputs of the network.

        Args:
            observations: observations in SI units; NaN for missing samples.
            lengths: number of samples of each run.
            scene: scenario information.
            missing: (T, C) mask of further samples to treat as missing: those missing in the
                target, so that a simulation with the true parameters gives the target's own row.

        Raises:
            ValueError: the observation or the scenario differs in its shape from those of the
                training.
        """
        if missing is not None and missing.any():
            observations = np.where(missing, np.nan, observations)
        observations = self.reading.select_channels(observations)
        rows = self.observation_features(observations, lengths)
        if self.scenario_features is None:
            return rows
        further = self.scenario_features(observations, lengths, scene)
        return np.concatenate([rows, further], axis=1)

    def compute_rows(self, data: TrainingData) -> Array:
        """Compute the input rows of training simulations.

        Returns:
            (scenarios, simulations per scenario, D) inputs of the network.
        """
        if self.scenario_features is None:
            # All scenarios are computed in one call, because the rows do not depend on the
            # scenario.
            rows = self.observation_features(
                self.reading.select_channels(data.flattened_observations), data.lengths
            )
            return rows.reshape(*data.parameters.shape[:2], -1)
        observed_scenarios = zip(data.observations, data.scenes, strict=True)
        return np.array(
            [self(observations, data.lengths, scene) for observations, scene in observed_scenarios]
        )

    def to_arrays(self) -> dict[str, Array]:
        """Return everything as plain arrays by name, as a weights file stores it."""
        state: dict[str, Array] = {}
        for name in _OBSERVATION_FEATURE_ARRAYS:
            state[f"inputs.{name}"] = np.asarray(getattr(self.observation_features, name))
        if self.scenario_features is not None:
            for name in _SCENARIO_FEATURE_ARRAYS:
                state[f"told.{name}"] = np.asarray(
                    getattr(self.scenario_features, name), dtype=np.float64
                )
        return state

    @classmethod
    def from_arrays(
        cls, state: dict[str, Array], reading: FeatureConfig
    ) -> tuple[InputFeatures, dict[str, Array]]:
        """Restore the map from the arrays of `to_arrays`.

        Arrays named `inputs.*` describe the features of observations, arrays named `told.*` those
        of scenarios.

        Args:
            state: arrays by name; other names, such as those of weights, are allowed.
            reading: configuration of the inputs.

        Returns:
            The map, and the arrays of other names.

        Raises:
            ValueError: arrays are missing or have other shapes, or numbers that are not finite.
        """
        arrays = {name: np.array(array, dtype=np.float64) for name, array in state.items()}
        own_arrays = {
            name: arrays.pop(name) for name in state if name.startswith(("inputs.", "told."))
        }
        # The size of one array of each part determines the shapes of the others.
        sizes = {
            part: own_arrays.get(f"{part}.centre", _MISSING_ARRAY).size
            for part in ("inputs", "told")
        }
        shapes: dict[str, tuple[int, ...]] = {
            f"inputs.{name}": (sizes["inputs"],) for name in _OBSERVATION_FEATURE_ARRAYS
        }
        has_scenario_features = any(name.startswith("told.") for name in own_arrays)
        if has_scenario_features:
            shapes |= {f"told.{name}": (sizes["told"],) for name in _SCENARIO_FEATURE_ARRAYS}
            shapes["told.initial"] = ()
        chosen_numbers, centre, gain, *scenario_arrays = check_shapes(own_arrays, shapes).values()
        if not sum(sizes.values()):
            raise ValueError("expected a network with inputs, found one without")
        observation_features = ObservationFeatures(
            reading.points, reading.raw, chosen_numbers, centre, gain
        )
        scenario_features = None
        if has_scenario_features:
            scenario_centre, spread, initial = scenario_arrays
            scenario_features = ScenarioFeatures(scenario_centre, spread, int(initial))
        return cls(reading, observation_features, scenario_features), arrays
