"""Inputs of the networks of TuneNet and its regressor from an observation.

Pure numpy, so that tuning needs no torch. An observation (T, C) becomes a row of numbers in three
steps: each run is resampled to a fixed number of points (RESAMPLE in Algorithm 1, arXiv
1907.11200); rates of change and sorted copies are added; each number is centred, and weighed by how
faithfully it followed the parameters in training.

With x a number, d its parameters' differences from their mean within a scenario, and strictness s:

    (1)  x - mean = d slopes + left over, by least squares in each scenario
    (2)  faith of a parameter = e / (e + s * left over), e = |slope| * spread of the parameter
    (3)  weight = (largest faith, each parameter's scaled to the same maximum)^2, per deviation
    (4)  weight of circumstances = (b / (b + s * w))^2, per deviation, with b and w the standard
         deviations between and within scenarios
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from methods.learning.training_data import TrainingData
from methods.tuner import Array

_ROUNDING_SHARE = 1e-9
"""Threshold of rounding errors, as a share of the largest deviation."""
_MIN_DEVIATION_SHARE = 1e-3
"""Minimum deviation, as a share of the largest one; smaller ones are not scaled up further."""
_MIN_DIVISOR = 1e-300
"""Minimum divisor, so that zero divided by zero is finite."""


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
