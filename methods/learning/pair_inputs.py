"""What the networks of TuneNet and its regressor see of an observation.

Pure numpy, so that tuning needs no torch. An observation (T, C) becomes a row of numbers in three
steps: each run is resampled to a fixed number of points (RESAMPLE in Algorithm 1, arXiv
1907.11200); rates of change and sorted copies are added; each number is centred, and weighed by how
faithfully it followed the parameters in training.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from methods.base import Array
from methods.learning.rehearsal import Rehearsal


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
        if length == points and not np.isnan(series).any():
            out[:, run] = series
            continue
        here, at = np.arange(length), np.linspace(0, length - 1, points)
        for i in range(n):
            for c in range(channels):
                there = ~np.isnan(series[i, c])
                out[i, run, c] = (
                    np.interp(at, here[there], series[i, c, there]) if there.any() else np.nan
                )
    return out.reshape(n, len(lengths) * channels, points)


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
    parts = (series, rates, np.sort(series, axis=-1), np.sort(rates, axis=-1))
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
        thirds = np.abs(np.diff(run, n=3, axis=1))
        parts = np.array_split(thirds, min(8, max(1, thirds.shape[1] // 16)), axis=1)
        for i, c in np.ndindex(out.shape):
            seen = [part[i, ~np.isnan(part[i, :, c]), c] for part in parts]
            calmest = min((float(np.median(part)) for part in seen if part.size), default=0.0)
            out[i, c] = max(out[i, c], calmest / (0.6745 * 20.0**0.5))
    return out


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
                f"the network reads number {chosen.max()} of an observation, this one gives {rows.shape[1]}; "
                "train on observations of the same runs and channels"
            )
        scaled = (rows[:, chosen] - self.centre) * self.gain
        return np.nan_to_num(scaled)  # a series that is not there at all says nothing: its mean


def _rows(observations: Array, lengths: tuple[int, ...], points: int, plain: bool) -> Array:
    series = resample(observations, lengths, points)
    return series.reshape(len(series), -1) if plain else described(series)


def raw_inputs(observations: Array, lengths: tuple[int, ...], points: int) -> Inputs:
    """The published inputs: resampled series in SI units, neither centred nor scaled."""
    size = _rows(observations[:1], lengths, points, plain=True).shape[1]
    return Inputs(points, True, np.arange(size, dtype=np.float64), np.zeros(size), np.ones(size))


def weighed_inputs(data: Rehearsal, points: int, most: int, strictness: float) -> Inputs:
    """Choose and scale inputs by how faithfully they follow the parameters.

    Within each scenario every candidate number is fitted as a linear function of the parameters.
    What the fit leaves over (jumps, curvature, noise) makes a number a poor guide, above all
    outside the training range, where it jumps and bends on. The weight is (e / (e + strictness *
    left over))^2 per unit of standard deviation within a scenario, where e is what one parameter
    explains; the largest over the parameters counts, each parameter's weights being scaled to the
    same maximum, so that one that is seen easily does not hide the others. A number that no
    parameter touches but that differs between scenarios tells the circumstances; it weighs (b / (b
    + strictness * w))^2, with b and w its standard deviations between and within scenarios.

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
    deviation, between = rows.std(axis=0), grouped.mean(axis=1).std(axis=0)
    floor = 1e-9 * max(float(deviation.max()), 1e-300)
    faith = explained / (explained + strictness * left + floor)
    best = faith.max(axis=1, keepdims=True)
    following = np.max((faith / np.where(best > 0, best, 1.0)) ** 2, axis=0)
    context = (between / (between + strictness * spread + floor)) ** 2
    kept = np.sort(np.argsort(-np.maximum(following, context), kind="stable")[:most])
    gain = np.maximum(_per(following[kept], spread[kept]), _per(context[kept], deviation[kept]))
    size = np.sqrt(np.mean((gain * deviation[kept]) ** 2)) if most else 1.0
    return Inputs(
        points,
        False,
        kept.astype(np.float64),
        rows[:, kept].mean(axis=0),
        gain / size if size > 0 else gain,
    )


def _per(weight: Array, deviation: Array) -> Array:
    """Weight per unit of deviation, bounded where there is hardly any."""
    scaled: Array = weight / (deviation + 1e-3 * deviation.max(initial=0.0) + 1e-300)
    return scaled


def _followed(parameters: Array, rows: Array) -> tuple[Array, Array, Array]:
    """Root mean squares within scenarios of each number (D,), what each parameter explains (dim,
    D), the rest (D,).
    """
    scenarios, each, dim = parameters.shape
    offsets = parameters - parameters.mean(axis=1, keepdims=True)
    free = max(each - 1 - dim, 1) / each  # the fit itself takes this share of the rest away
    total, rest = np.zeros(rows.shape[2]), np.zeros(rows.shape[2])
    explained = np.zeros((dim, rows.shape[2]))
    for delta, values in zip(offsets, rows, strict=True):
        centred = values - values.mean(axis=0)
        slopes = np.linalg.lstsq(delta, centred, rcond=None)[0]
        total += np.mean(centred**2, axis=0)
        rest += np.mean((centred - delta @ slopes) ** 2, axis=0) / free
        explained += np.mean(delta**2, axis=0)[:, None] * slopes**2
    return np.sqrt(total / scenarios), np.sqrt(explained / scenarios), np.sqrt(rest / scenarios)
