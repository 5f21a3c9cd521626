"""The noise floor: the error that a perfect model would have, from the sensor's own noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.gap.model.world import World
from bench.recordings.noise import estimated
from sims.base import Array
from sims.recording.recording import Recording

PRECISION = 1e-4
"""Share of a channel's range below which a difference is not the world's but the integrator's."""
INNER = (0.02, 0.98)
"""The range of a channel is that between these quantiles, so that an outlier does not widen it."""
TYPICAL = 1e-3
"""Share of a channel's typical size that stands for a floor which no sample tells of."""
LEAST = 1e-12
"""The lowest floor, SI units: residuals are divided by it."""
MEDIAN = 1.2
"""1 sigma of a sigma that a median of n independent magnitudes gives, as a share of it and times
√n. It is 0.71 for the standard deviation, which is efficient; the median has 37 % of that.
"""
FEW = 4
"""Samples from which an estimate is taken to come at least."""


@dataclass(frozen=True)
class Floor:
    """Noise of each channel, (C,) arrays: 1 sigma, whether it is stated, the step if quantised (0
    if it is not).
    """

    sigma: Array
    stated: NDArray[np.bool_]
    step: Array
    uncertainty: Array
    """1 sigma of an estimated sigma, as a share of it; 0 where it is stated."""


def noise_floor(world: World, recording: Recording) -> Floor:
    """Stated, or estimated from all runs: those held out tell of the sensor, too."""
    sigmas, stated, steps, doubts = [], [], [], []
    for channel in world.simulator.channels:
        signals = [(run.times, run.channels[channel.name]) for run in recording.runs]
        samples = [y[np.isfinite(y)] for _, y in signals]
        values = np.concatenate(samples)
        # even where it is stated: a step tells that the channel is quantised
        estimate = estimated(signals)
        known = recording.noise.get(channel.name, 0.0) > 0
        sigma = recording.noise[channel.name] if known else estimate.sigma

        # no simulation is as exact as an error of nothing asks for
        least = max(PRECISION * range_of(values), LEAST)
        # too few samples, or none; of a channel that never changes no sample tells of its noise
        if not np.isfinite(sigma) or (not known and is_constant(values)):
            sigma = TYPICAL * channel.scale
        sigmas.append(max(sigma, least))
        stated.append(known)
        steps.append(estimate.step)
        doubts.append(0.0 if known else MEDIAN / max(values.size, FEW) ** 0.5)
    return Floor(
        sigma=np.array(sigmas),
        stated=np.array(stated),
        step=np.array(steps),
        uncertainty=np.array(doubts),
    )


def is_constant(values: Array) -> bool:
    """Whether there are samples (n,) and all are the same."""
    return bool(values.size) and not np.ptp(values)


def range_of(values: Array) -> float:
    """The range of values (n,) but for outliers; 0 of none."""
    return float(np.ptp(np.quantile(values, INNER))) if values.size else 0.0
