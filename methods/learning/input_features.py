"""Features of inputs and scenarios, and of the responses to them, with gaps filled.

Each channel's acceleration is fitted by terms of the channels q and inputs u at the same time:

    (1)  q'' = k0 + k1 q + k3 q^3 + kf sense(q') + ku u + kd q'

The fit is in weak form (D. Messenger, D. Bortz, Weak SINDy, Multiscale Model. Simul. 19, 2021,
doi:10.1137/20M1343166): both sides are multiplied by a bump w that is zero at both ends, and
integrated by parts, so that no noisy signal is differentiated twice:

    (2)  integral of w q'' = integral of w'' q,   integral of w q' = -integral of w' q

    (3)  w(s) = (1 - s^2)^4, s from -1 to 1 over the bump

Initial values that no channel shows are inputs as they are. Input signals are not: appended to the
observation they were measured to be worth next to nothing, since what a sample means depends on all
inputs before it (docs/tunenet.md). The network reads how the observation responds to them
(`learning.input_features`), much the same whatever they were; and then that alone, since samples
whose meaning changes from scenario to scenario only mislead.

A camera that stands still shows a motion x along a line as

    (4)  y = (a + b x) / (1 + c x)

(Hartley and Zisserman, Multiple View Geometry, 2004, chapter 2). Multiplied by the denominator it
is linear in the three numbers:

    (5)  y = a + b x - c x y
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from methods.learning.network_training import check_shapes
from methods.learning.observation_features import (
    ObservationFeatures,
    make_raw_features,
    make_weighted_features,
    resample_runs,
)
from methods.learning.training_data import TrainingData
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
    """Compute the coefficients (n, C * R) of one run from series (n, T, C) and inputs (T, U).

    Shapes: T samples, C channels.
    """
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
    """Compute smoothed signs of the rates of change (n, T, C), a regressor for dry friction.

    Shapes: T samples, C channels.

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
        driven = _differs_between_scenarios(np.array([scene.inputs for scene in scenes]))
        # Equal scenarios give constant inputs, which carry no information.
        if not driven and not _differs_between_scenarios(initial):
            return None
        count = initial.shape[1]
        # A preliminary map for the raw numbers: one number beyond the initial values marks varying
        # inputs.
        unscaled = cls(np.empty(count + driven), np.empty(0), count)
        table = np.concatenate(
            [
                unscaled.compute(observation, lengths, scene)
                for observation, scene in zip(observations, scenes, strict=True)
            ]
        )
        # Medians are used, because a fitted coefficient can be far off if a run hardly moves.
        centre = np.median(table, axis=0)
        distances = np.abs(table - centre)
        return cls(centre, _STD_PER_MAD * np.median(distances, axis=0), count)

    @property
    def has_varying_inputs(self) -> bool:
        """True if inputs vary between scenarios, so that response coefficients are computed."""
        return self.initial < len(self.centre)

    def compute(self, observations: Array, lengths: tuple[int, ...], scene: ScenarioInfo) -> Array:
        """Compute the unscaled numbers of observations in one scenario.

        Shapes: T samples, C channels.

        Args:
            observations: (n, T, C) observations in SI units.
            lengths: number of samples of each run.
            scene: scenario information.

        Returns:
            (n, K) numbers.
        """
        shape = len(observations), len(scene.initial)
        initial = np.broadcast_to(scene.initial, shape)
        if not self.has_varying_inputs:
            return initial
        coefficients = compute_response_coefficients(observations, scene.inputs, lengths)
        return np.concatenate([initial, coefficients], axis=1)

    def __call__(self, observations: Array, lengths: tuple[int, ...], scene: ScenarioInfo) -> Array:
        """Compute network inputs, which grow logarithmically far from the training data.

        Shapes: T samples, C channels.

        Args:
            observations: (n, T, C) observations in SI units.
            lengths: number of samples of each run.
            scene: scenario information.

        Returns:
            (n, K) network inputs.

        Raises:
            ValueError: the scenario has another number of values than those of the training.
        """
        features = self.compute(observations, lengths, scene)
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


def _differs_between_scenarios(numbers: Array) -> bool:
    """Return whether any number of an array (scenarios, ...) differs between scenarios."""
    if not numbers.size:
        return False
    sizes = np.abs(numbers).max(axis=0)
    return bool(np.any(np.ptp(numbers, axis=0) > _EQUALITY_TOLERANCE * sizes))


_OBSERVATION_FEATURE_ARRAYS = ("chosen", "centre", "gain")
"""Names of the arrays of `ObservationFeatures` that are stored."""
_SCENARIO_FEATURE_ARRAYS = ("centre", "spread", "initial")
"""Names of the arrays of `ScenarioFeatures` that are stored."""
_MISSING_ARRAY = np.empty(0)
"""Replacement of a missing array."""


@dataclass(frozen=True)
class FeatureConfig:
    """Configuration of network inputs and of the noise in training.

    Attributes:
        points: number of points to which each run is resampled; L in Algorithm 1.
        inputs: maximum number of inputs that are used from an observation.
        strictness: see `methods.learning.observation_features.make_weighted_features`.
        noise: sensor noise that a second network is trained with, as standard deviation in units of
            each channel's standard deviation in training; 0 for no second network.
        raw: True for the resampled series in SI units without weights, as published; the other
            settings then have no effect.
        use_scenario_features: True to use scenario information too, if scenarios differ in it
            (`methods.learning.input_features`).
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
        """Return the channels (..., c) of observations (..., C) that are used.

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
        """Choose the inputs from training data: samples, or weighted sums that show parameters."""
        data = data._replace(observations=reading.select_channels(data.observations))
        if reading.raw:
            return cls(
                reading,
                make_raw_features(data.flattened_observations, data.lengths, reading.points),
            )
        scenario_features = None
        if reading.use_scenario_features:
            scenario_features = ScenarioFeatures.fit(data.scenes, data.observations, data.lengths)
        # If inputs vary, samples have another meaning in each scenario, so only responses are used.
        driven = scenario_features is not None and scenario_features.has_varying_inputs
        input_count = 0 if driven else reading.inputs
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

        Shapes: T samples, C channels.

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
        """Compute the input rows (scenarios, each, D) of training simulations.

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
        scenario_features = (
            ScenarioFeatures(scenario_arrays[0], scenario_arrays[1], int(scenario_arrays[2]))
            if has_scenario_features
            else None
        )
        return cls(reading, observation_features, scenario_features), arrays


_ITERATIONS = 15
"""Number of iterations of reweighted least squares."""
_MIN_SEEN_SAMPLES = 8
"""Minimum number of available samples for filling gaps."""
_CAUCHY_WIDTH = 2.0
"""Width of Cauchy's weight function, in median absolute residuals of the map."""
_MIN_CAUCHY_WIDTH = 1e-6
"""Minimum width of Cauchy's weight function, in standard deviations of the channel.

A closer agreement counts as exact.
"""
_MIN_DENOMINATOR = 0.1
"""Minimum denominator of (4).

A smaller one means that the pole of the map is near, where the motion reaches the camera.
"""


def fill_gaps(channel: Array, simulated: Array) -> Array:
    """Fill the gaps of a sensor's channel from a simulation, through a fitted map between them.

    The map is y = (a + b x) / (1 + c x), as a camera maps a line (4). Its three numbers are fitted
    to the available samples in linear form (5) and with Cauchy's weights, because an inaccurate
    model agrees with the sensor only in parts of a run.

    Args:
        channel: (T,) channel with NaN for missing samples.
        simulated: (T,) simulated values at the same times, of another sensor.

    Returns:
        (T,) channel without gaps; unchanged if there are too few samples or no such map.
    """
    is_present = np.isfinite(channel)
    if is_present.all() or is_present.sum() < _MIN_SEEN_SAMPLES:
        return channel
    # A simulation at rest does not determine the map.
    if not np.ptp(simulated[is_present]) > 0:
        return channel
    # Metres and pixels differ by orders of magnitude; scaling gives all columns of (5) equal
    # weight.
    x = _scale_like(simulated, simulated[is_present])
    y = _scale_like(channel, channel[is_present])
    design_matrix = np.stack([np.ones_like(x), x, -x * y], axis=1)[is_present]
    a, b, c = _fit_camera_line(design_matrix, y[is_present])
    denominator = 1 + c * x
    # A change of sign would put a part of the run behind the camera.
    if not (denominator > _MIN_DENOMINATOR).all():
        return channel
    scaled_values = (a + b * x) / denominator  # (4)
    unscaled = scaled_values * float(channel[is_present].std()) + float(channel[is_present].mean())
    result: Array = np.where(is_present, channel, unscaled)
    return result


def _fit_camera_line(design_matrix: Array, values: Array) -> Array:
    """Fit a, b and c of y = a + b x - c x y robustly; a camera maps heights x to pixel rows y so.

    The method is iteratively reweighted least squares with Cauchy's weights, so that a few wrong
    samples do not spoil the fit.

    Args:
        design_matrix: (n, 3) regressors 1, x and -x y of n samples.
        values: (n,) pixel rows y.

    Returns:
        (3,) numbers a, b and c, eq. (5) of the module.
    """
    weights: Array = np.ones(len(design_matrix))
    coefficients: Array = np.zeros(3)
    for _ in range(_ITERATIONS):
        solution = np.linalg.lstsq(design_matrix * weights[:, None], values * weights, rcond=None)[
            0
        ]
        coefficients = solution.astype(np.float64)
        residual: Array = values - design_matrix @ coefficients
        width = max(_CAUCHY_WIDTH * float(np.median(np.abs(residual))), _MIN_CAUCHY_WIDTH)
        # This is the root of Cauchy's weight, because it multiplies both sides of (5).
        weights = 1 / np.sqrt(1 + (residual / width) ** 2)
    return coefficients


def _scale_like(values: Array, reference: Array) -> Array:
    """Return values in standard deviations of `reference` from the mean of `reference`."""
    spread = float(reference.std())
    divisor = spread if spread > 0 else 1.0
    result: Array = (values - float(reference.mean())) / divisor
    return result
