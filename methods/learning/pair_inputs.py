"""What the networks of TuneNet and its regressor see of an observation.

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

from methods.base import Array
from methods.learning.rehearsal import Rehearsal

_PARTS = 8
"""Parts of a run in which its roughness is looked at."""
_LEAST_PART = 16
"""Third differences in such a part, at least."""
_NORMAL = 0.6745
"""Median of the size of a normal variable, in its standard deviations."""
_THIRD: float = 20.0**0.5
"""Third differences of white noise vary so many times as much: 1 + 9 + 9 + 1 is 20."""
_EXACT = 1e-9
"""Of the largest deviation: what is left over below it is rounding."""
_LEAST_DEVIATION = 1e-3
"""Of the largest deviation: a number that varies less is not scaled up further."""
_ZERO = 1e-300
"""Keeps a quotient of nothing and nothing finite."""


def resample(observations: Array, lengths: tuple[int, ...], points: int) -> Array:
    """Bring every run to the same number of points, by linear interpolation; missing samples are
    bridged.

    Args:
        observations: (n, T, C), the runs following one another along T; NaN where a sample is
            missing.
        lengths: samples of each run; they add up to T.
        points: number of points of each run afterwards, spread evenly over its samples.

    Returns:
        (n, runs * C, points); NaN throughout a series of which no sample is there.

    Raises:
        ValueError: the lengths do not add up to T.
    """
    n, samples, channels = observations.shape
    if sum(lengths) != samples:
        raise ValueError(
            f"runs of {lengths} samples add up to {sum(lengths)}, the observation has {samples}"
        )
    out = np.empty((n, len(lengths), channels, points))
    first = 0
    for run, length in enumerate(lengths):
        series = observations[:, first : first + length].transpose(0, 2, 1)
        first += length
        # interpolation at the samples themselves would give them back; most runs need none
        if length == points and not np.isnan(series).any():
            out[:, run] = series
            continue
        samples = np.arange(length)
        at = np.linspace(0, length - 1, points)
        for i in range(n):
            for c in range(channels):
                out[i, run, c] = _interpolated(at, samples, series[i, c])
    return out.reshape(n, len(lengths) * channels, points)


def _interpolated(at: Array, samples: NDArray[np.intp], values: Array) -> Array:
    """Values (points,) between those samples that are there; NaN where none is."""
    there = ~np.isnan(values)
    if not there.any():
        return np.full(len(at), np.nan)
    between: Array = np.interp(at, samples[there], values[there])
    return between


def described(series: Array) -> Array:
    """Describe each series by values and rates of change, both in the order of time and sorted by
    size.

    Sorted, a series says how large and how fast, whatever the moment: a statement that shifts in
    time leave alone.

    Args:
        series: (n, series, points).

    Returns:
        (n, series * (4 * points - 2)).
    """
    rates = np.diff(series, axis=-1)
    parts = (
        series,
        rates,
        np.sort(series, axis=-1),
        np.sort(rates, axis=-1),
    )
    return np.concatenate(parts, axis=-1).reshape(len(series), -1)


def roughness(observations: Array, lengths: tuple[int, ...]) -> Array:
    """Standard deviation of white noise that would explain the median third difference of a run's
    calmest part.

    Smooth motion has hardly any. A run is looked at in up to eight parts, of sixteen differences at
    least, so that impacts and rattling elsewhere do not count.

    Args:
        observations: (n, T, C); NaN where a sample is missing.
        lengths: samples of each run.

    Returns:
        (n, C), SI units; of each channel the roughest run, 0 where no run has four samples in a
        row.
    """
    out = np.zeros((observations.shape[0], observations.shape[2]))
    for run in np.split(observations, np.cumsum(lengths)[:-1], axis=1):
        # a parabola has no third differences, so smooth motion leaves next to nothing
        thirds = np.abs(np.diff(run, n=3, axis=1))
        count = min(_PARTS, max(1, thirds.shape[1] // _LEAST_PART))
        parts = np.array_split(thirds, count, axis=1)
        for i, c in np.ndindex(out.shape):
            calmest = _calmest([part[i, :, c] for part in parts])
            noise = calmest / (_NORMAL * _THIRD)
            out[i, c] = max(float(out[i, c]), noise)
    return out


def _calmest(parts: list[Array]) -> float:
    """The smallest of the parts' medians, without NaN; 0 where nothing is there."""
    medians = []
    for part in parts:
        there = part[~np.isnan(part)]
        if there.size:
            medians.append(float(np.median(there)))
    return min(medians, default=0.0)


@dataclass(frozen=True)
class Inputs:
    """The map from observations to a network's input rows.

    Attributes:
        points: points to which each run is resampled.
        plain: the resampled series as they are, without rates and sorting.
        chosen: (D,) which numbers are used.
        centre: (D,) what is subtracted from them.
        gain: (D,) what they are then multiplied by.
    """

    points: int
    plain: bool
    chosen: Array
    centre: Array
    gain: Array

    def __call__(self, observations: Array, lengths: tuple[int, ...]) -> Array:
        """Input rows (n, D) of observations (n, T, C).

        Args:
            observations: SI units; NaN where a sample is missing.
            lengths: samples of each run.

        Raises:
            ValueError: the observation yields fewer numbers than the network was trained on.
        """
        if not self.chosen.size:
            return np.empty((len(observations), 0))
        rows = _rows(observations, lengths, self.points, self.plain)
        chosen = self.chosen.astype(np.intp)
        if chosen.max() >= rows.shape[1]:
            raise ValueError(
                f"the network reads number {chosen.max()} of an observation, "
                f"this one gives {rows.shape[1]}; "
                "train on observations of the same runs and channels"
            )
        centred = rows[:, chosen] - self.centre
        scaled = centred * self.gain
        # a series that is not there at all says nothing: its mean
        return np.nan_to_num(scaled)


def _rows(observations: Array, lengths: tuple[int, ...], points: int, plain: bool) -> Array:
    """All numbers (n, D) that observations (n, T, C) offer."""
    series = resample(observations, lengths, points)
    return series.reshape(len(series), -1) if plain else described(series)


def raw_inputs(observations: Array, lengths: tuple[int, ...], points: int) -> Inputs:
    """The published inputs: resampled series in SI units, neither centred nor scaled."""
    size = _rows(observations[:1], lengths, points, plain=True).shape[1]
    every = np.arange(size, dtype=np.float64)
    return Inputs(points, True, every, np.zeros(size), np.ones(size))


def weighed_inputs(data: Rehearsal, points: int, most: int, strictness: float) -> Inputs:
    """Choose and scale inputs by how faithfully they follow the parameters.

    Within each scenario every candidate number is fitted as a linear function of the parameters
    (1). What the fit leaves over (jumps, curvature, noise) makes a number a poor guide, above all
    outside the training range, where it jumps and bends on: that is weighed by (2) and (3). Each
    parameter's weights are scaled to the same maximum, so that one that is seen easily does not
    hide the others. A number that no parameter touches but that differs between scenarios tells the
    circumstances; it weighs (4).

    Args:
        data: the training simulations.
        points: points to which each run is resampled.
        most: number of inputs to keep, those of the largest weight; 0 for none.
        strictness: how heavily what is left over counts.

    Returns:
        The inputs; their mean square over the training data is 1.
    """
    rows = _rows(data.flat, data.lengths, points, plain=False)
    grouped = rows.reshape(*data.parameters.shape[:2], -1)
    spread, explained, left = _followed(data.parameters, grouped)
    deviation = rows.std(axis=0)
    between = grouped.mean(axis=1).std(axis=0)
    floor = _EXACT * max(float(deviation.max()), _ZERO)
    faith = explained / (explained + strictness * left + floor)  # (2)
    best = faith.max(axis=1, keepdims=True)
    share = faith / np.where(best > 0, best, 1.0)
    following = np.max(share**2, axis=0)  # (3)
    context = (between / (between + strictness * spread + floor)) ** 2  # (4)
    # a stable order, so that equal weights choose the same numbers everywhere
    order = np.argsort(-np.maximum(following, context), kind="stable")
    chosen = np.sort(order[:most])
    by_parameters = _per(following[chosen], spread[chosen])
    by_context = _per(context[chosen], deviation[chosen])
    gain = np.maximum(by_parameters, by_context)
    # the network's initial weights and rate are made for inputs of mean square 1
    size = np.sqrt(np.mean((gain * deviation[chosen]) ** 2)) if most else 1.0
    return Inputs(
        points,
        False,
        chosen.astype(np.float64),
        rows[:, chosen].mean(axis=0),
        gain / size if size > 0 else gain,
    )


def _per(weight: Array, deviation: Array) -> Array:
    """Weight per unit of deviation, bounded where there is hardly any."""
    least = _LEAST_DEVIATION * deviation.max(initial=0.0)
    scaled: Array = weight / (deviation + least + _ZERO)
    return scaled


def _followed(parameters: Array, rows: Array) -> tuple[Array, Array, Array]:
    """Root mean squares within scenarios of each number (D,), what each parameter explains (dim,
    D), the rest (D,).
    """
    scenarios, each, dim = parameters.shape
    count = rows.shape[2]
    offsets = parameters - parameters.mean(axis=1, keepdims=True)
    # a fit of 1 + dim numbers leaves this share of what a fit of none would leave of noise
    free = max(each - 1 - dim, 1) / each
    total = np.zeros(count)
    rest = np.zeros(count)
    explained = np.zeros((dim, count))
    for delta, values in zip(offsets, rows, strict=True):
        centred = values - values.mean(axis=0)
        slopes = np.linalg.lstsq(delta, centred, rcond=None)[0]  # (1)
        left_over = centred - delta @ slopes
        total += np.mean(centred**2, axis=0)
        rest += np.mean(left_over**2, axis=0) / free
        explained += np.mean(delta**2, axis=0)[:, None] * slopes**2
    return (
        np.sqrt(total / scenarios),
        np.sqrt(explained / scenarios),
        np.sqrt(rest / scenarios),
    )
