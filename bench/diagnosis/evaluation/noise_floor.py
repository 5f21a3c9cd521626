"""Noise floor of a recording, and white noise for recordings without sensor noise.

Two exact simulations of one system differ by their integration errors, 10^-9 to 10^-4 of the range
of a channel. Without noise, every test would find this difference significant, and a search would
explain the integrator. White noise of 10^-4 of the range (`INTEGRATION_ERROR_SHARE`) covers the
difference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bench.core.random_streams import make_rng
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.core.noise_estimation import estimate_differences_sigma, estimate_noise
from sims.core.simulator import Array
from sims.recording.recording import Recording, Run

INTEGRATION_ERROR_SHARE = 1e-4
"""Minimum noise floor as a share of the range of a channel.

Smaller differences are errors of the integrator.
"""
RANGE_QUANTILES = (0.02, 0.98)
"""Quantiles between which the range of a channel is measured, so that outliers do not widen it."""
DEFAULT_FLOOR_SHARE = 1e-3
"""Noise floor as a share of the typical size of a channel, if the samples give no estimate."""
MIN_SIGMA = 1e-12
"""Minimum noise floor in SI units, because residuals are divided by it."""
MEDIAN_SIGMA_ERROR_FACTOR = 1.2
"""Relative standard error of a noise estimate, times √n for n samples.

The estimate is the median of n independent magnitudes. For the standard deviation, which is
efficient, the factor is 0.71; the median has an efficiency of 37 %.
"""
MIN_SAMPLES = 4
"""Minimum number of samples assumed for the uncertainty of an estimate."""


@dataclass(frozen=True)
class NoiseFloor:
    """Noise floor of each channel.

    Attributes:
        sigma: (C,) standard deviation.
        is_stated: (C,) whether it is specified by the recording, and not estimated.
        quantisation_step: (C,) quantisation step; 0 if the channel is not quantised.
        uncertainty: (C,) relative standard error of the sigma.
    """

    sigma: Array
    is_stated: NDArray[np.bool_]
    quantisation_step: Array
    uncertainty: Array
    """Relative standard error (C,) of an estimated sigma; 0 if it is specified."""


def compute_noise_floor(evaluator: RunEvaluator, recording: Recording) -> NoiseFloor:
    """Return the standard deviation of the noise of each channel, stated or estimated.

    All errors are compared with it. Held-out runs are included, because they also show the sensor
    noise.

    Args:
        evaluator: evaluator, whose simulator defines the channels.
        recording: recording with all its runs; its `noise` has the standard deviations by channel
            that its description states.

    Returns:
        Standard deviation of each channel in its unit, quantisation step, and uncertainty of the
        estimate.
    """
    sigmas, is_stated, steps, uncertainties = [], [], [], []
    for channel in evaluator.simulator.channels:
        signals = [(run.times, run.channels[channel.name]) for run in recording.runs]
        values = np.concatenate([samples[np.isfinite(samples)] for _, samples in signals])
        # Estimate also if the noise is specified, because the step shows whether the channel is
        # quantised.
        estimate = estimate_noise(signals)
        is_specified = recording.noise.get(channel.name, 0.0) > 0
        sigma = recording.noise[channel.name] if is_specified else estimate.sigma

        # No estimate: there are too few samples, or a channel never changes and does not show its
        # noise.
        if not np.isfinite(sigma) or (not is_specified and is_constant(values)):
            sigma = DEFAULT_FLOOR_SHARE * channel.scale
        # No simulation is accurate enough for a noise floor of zero.
        min_sigma = max(INTEGRATION_ERROR_SHARE * compute_value_range(values), MIN_SIGMA)
        sigmas.append(max(sigma, min_sigma))
        is_stated.append(is_specified)
        steps.append(estimate.step)
        uncertainties.append(
            0.0
            if is_specified
            else MEDIAN_SIGMA_ERROR_FACTOR / max(values.size, MIN_SAMPLES) ** 0.5
        )
    return NoiseFloor(
        sigma=np.array(sigmas),
        is_stated=np.array(is_stated),
        quantisation_step=np.array(steps),
        uncertainty=np.array(uncertainties),
    )


def is_constant(values: Array) -> bool:
    """Return whether samples (n,) exist and are all equal."""
    return bool(values.size) and not np.ptp(values)


def compute_value_range(values: Array) -> float:
    """Return the range of values (n,) without outliers; 0 if there are no values."""
    return float(np.ptp(np.quantile(values, RANGE_QUANTILES))) if values.size else 0.0


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
        recording: recorded runs, with their channels, inputs and constants.
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
    """Return the standard deviation of noise to add to a channel; 0 if it needs none.

    A channel that is noisy, quantised or constant needs none. A noise-free one (from a simulation)
    would make every tiny integration error significant, so noise of the size of these errors is
    added.

    Args:
        recording: recorded runs, with their channels, inputs and constants.
        name: name of the channel.
    """
    signals = [(run.times, run.channels[name]) for run in recording.runs if name in run.channels]
    values = np.concatenate([samples[np.isfinite(samples)] for _, samples in signals])
    added_sigma = INTEGRATION_ERROR_SHARE * compute_value_range(values)
    # A constant channel.
    if added_sigma < MIN_SIGMA:
        return 0.0
    # A quantised channel has the noise of its steps, also while the robot rests.
    if estimate_noise(signals).step > added_sigma:
        return 0.0
    # A channel with far less noise than `added_sigma` is noise-free. The estimate is not finite if
    # all runs are too short for the differences; then nothing is added.
    sigma = estimate_differences_sigma(signals, DIFFERENCE_ORDER)
    return added_sigma if sigma < MAX_NOISE_FREE_SHARE * added_sigma else 0.0


def _add_noise(run: Run, sizes: dict[str, float]) -> Run:
    """Add white noise with given standard deviations to the channels of a run.

    The noise depends only on the names of run and channel, so it is the same every time.

    Args:
        run: the run.
        sizes: standard deviation by channel; other channels stay as they are.
    """
    channels = dict(run.channels)
    for name, sigma in sizes.items():
        if name in channels:
            # Each channel has a random stream of its own.
            rng = make_rng("least noise", run.log, run.name, name)
            channels[name] = channels[name] + sigma * rng.normal(size=channels[name].shape)
    return replace(run, channels=channels)
