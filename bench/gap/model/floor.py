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
    """Stated, or estimated from all runs of the recording."""
    sigmas, stated, steps, doubts = [], [], [], []
    for c, name in enumerate(world.channels):
        signals = [(run.times, run.channels[name]) for run in recording.runs]
        values = np.concatenate([y[np.isfinite(y)] for _, y in signals])
        guess = estimated(signals)
        known = recording.noise.get(name, 0.0) > 0
        sigma = recording.noise[name] if known else guess.sigma
        spread = float(np.ptp(np.quantile(values, [0.02, 0.98]))) if values.size else 0.0
        least = max(PRECISION * spread, 1e-12)
        sigmas.append(
            max(sigma, least)
            if np.isfinite(sigma)
            else max(least, 1e-3 * world.simulator.channels[c].scale)
        )
        stated.append(known)
        steps.append(guess.step)
        doubts.append(
            0.0 if known else 1.2 / max(values.size, 4) ** 0.5
        )  # a median's, over independent samples
    return Floor(np.array(sigmas), np.array(stated), np.array(steps), np.array(doubts))
