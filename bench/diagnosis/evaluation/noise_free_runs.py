"""Add white noise to recordings without sensor noise, such as simulated ones.

Two exact simulations of one system differ by their integration errors, 10^-9 to 10^-4 of the range
of a channel. Without noise, every test would find this difference significant, and a search would
explain the integrator. White noise of 10^-4 of the range (`INTEGRATION_ERROR_SHARE`) covers the
difference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bench.core.random_streams import make_rng
from bench.diagnosis.evaluation.noise_floor import (
    INTEGRATION_ERROR_SHARE,
    MIN_SIGMA,
    compute_value_range,
)
from bench.logs.quality.noise_estimation import estimate_differences_sigma
from sims.core.simulator import Array
from sims.recording.recording import Recording, Run

DIFFERENCE_ORDER = 8
"""Order of the differences that remove the motion from a smooth signal.

At ten samples per period, 2 % of a sine remains; at a hundred samples, 10^-10.
"""
MAX_NOISE_FREE_SHARE = 0.02
"""Maximum remainder of a channel without noise, as a share of the noise that would be added.

The remainder due to rounding to six digits is smaller.
"""


def add_minimal_noise(recording: Recording, channels: Sequence[str]) -> tuple[Recording, list[str]]:
    """Add white noise to each channel without noise.

    Its standard deviation is the fraction `INTEGRATION_ERROR_SHARE` of the channel's range.
    Channels that never change are not modified.

    Args:
        recording: the recording.
        channels: names of the channels to check.

    Returns:
        The recording, and the names of the channels that were changed.
    """
    changed = {
        name: size for name in channels if (size := _compute_added_noise(recording, name)) > 0.0
    }
    if not changed:
        return recording, []
    runs = tuple(_add_noise(run, changed) for run in recording.runs)
    return replace(recording, runs=runs), list(changed)


def _compute_added_noise(recording: Recording, name: str) -> float:
    """Return the standard deviation of the noise to add; 0 for noisy or constant channels."""
    signals = [(run.times, run.channels[name]) for run in recording.runs if name in run.channels]
    values = np.concatenate([y[np.isfinite(y)] for _, y in signals])
    min_sigma = INTEGRATION_ERROR_SHARE * compute_value_range(values)
    if min_sigma < MIN_SIGMA:
        return 0.0
    # The estimate is not finite if all runs are too short for the differences.
    sigma = estimate_differences_sigma(signals, DIFFERENCE_ORDER)
    return min_sigma if sigma < MAX_NOISE_FREE_SHARE * min_sigma else 0.0


def _add_noise(run: Run, sizes: dict[str, float]) -> Run:
    """Add white noise with the standard deviations `sizes`, by channel, to a run.

    The noise depends only on the names of run and channel, so it is the same every time.
    """

    def noise(name: str, values: Array) -> Array:
        """Draw white noise for a channel from a random stream of its own."""
        return sizes[name] * make_rng("least noise", run.log, run.name, name).normal(
            size=values.shape
        )

    channels = {
        name: values + noise(name, values) if name in sizes else values
        for name, values in run.channels.items()
    }
    return replace(run, channels=channels)
