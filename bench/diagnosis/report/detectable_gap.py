"""Largest gap that the noise of a recording could hide in each channel."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

import numpy as np

from bench.diagnosis.report.report_data import ChannelInfo, DiagnosisReportData
from sims.core.simulator import Array

NOISE_ESTIMATE_ERROR_FACTOR = 1.2
"""Relative standard error of an estimated noise, times the square root of the number of samples
(see `bench.diagnosis.evaluation.noise_floor`).
"""
Z95_ONE_SIDED = 1.645
"""One-sided 95 % quantile of the normal distribution, in standard deviations."""
MAX_PHI = 0.98
"""Maximum correlation of neighbouring samples that is used; with 1 no sample would count."""
MAX_NAMED_CHANNELS = 6
"""Maximum number of channels that a sentence names."""


def list_detectable_gaps(report: DiagnosisReportData) -> list[tuple[ChannelInfo, float]]:
    """List the channels, each with the largest gap that its noise could hide, in its unit.

    A channel with too few samples is left out. With many channels, only the worst one of each kind
    (positions, velocities, ...) is listed.

    Args:
        report: Data of the report.
    """
    sizes = zip(report.channels, compute_detectable_gap(report).tolist(), strict=True)
    return _select_worst_of_each_kind(
        [(channel, size) for channel, size in sizes if isfinite(size)]
    )


def _select_worst_of_each_kind(
    sizes: Sequence[tuple[ChannelInfo, float]],
) -> list[tuple[ChannelInfo, float]]:
    """Select, from many channels, the one of each kind that hides most, in units of its noise.

    The kind of a channel is the part of its name before the point, such as ``q`` for positions.
    Up to `MAX_NAMED_CHANNELS` channels are all kept.

    Args:
        sizes: Channels with the largest gap that their noise could hide, in their units.
    """
    if len(sizes) <= MAX_NAMED_CHANNELS:
        return list(sizes)
    worst_by_kind: dict[str, tuple[ChannelInfo, float]] = {}
    for channel, size in sizes:
        kind = channel.name.partition(".")[0]
        worst_channel, worst_size = worst_by_kind.setdefault(kind, (channel, size))
        if size / channel.sigma > worst_size / worst_channel.sigma:
            worst_by_kind[kind] = channel, size
    return list(worst_by_kind.values())


def compute_detectable_gap(report: DiagnosisReportData) -> Array:
    """Compute the largest gap (C,) that the noise of a channel could hide at 95 %.

    The gap of each of C channels is an RMS in the unit of the channel. r are the n residuals in
    units of the noise, and s = mean(r^2), which is 1 without a gap:

            phi = mean(r_t r_t+1) / s                                   (1)
            n'  = n (1 - phi^2) / (1 + phi^2)                           (2)
            gap^2 = max(0, s - 1) + 1.645 hypot(s sqrt(2 / n'), d)      (3)

    Autocorrelated noise reduces the effective number of samples: (2) is the number of independent
    samples whose mean square has the same variance as that of noise with the correlation phi^k over
    k samples. An estimated noise has itself a relative error of 1.2 / sqrt(n); d is the error of
    its square, twice as much.

    The result is NaN for a channel with fewer than two samples.

    Args:
        report: Data of the report.
    """
    sizes = []
    for channel_index, channel in enumerate(report.channels):
        # Residuals of each fitted and held-out run, (T,) in units of the noise, NaN where missing.
        residual_runs: list[Array] = []
        for split in report.data_splits:
            split_residual = (split.observed - split.before)[:, :, channel_index]
            residual_runs += [*(split_residual / channel.sigma)]
        residuals = np.concatenate([run[np.isfinite(run)] for run in residual_runs])
        # A single sample has no neighbour, and its square is not a variance.
        if residuals.size < 2:
            sizes.append(np.nan)
            continue
        square = float(np.mean(residuals**2))
        # Neighbours must be of the same run; a product with a missing sample is NaN.
        products = np.concatenate([run[1:] * run[:-1] for run in residual_runs])
        phi = 0.0
        if np.isfinite(products).any() and square:
            phi = float(np.clip(np.nanmean(products) / square, 0.0, MAX_PHI))  # (1)
        effective_samples = residuals.size * (1.0 - phi**2) / (1.0 + phi**2)  # (2)
        # d in (3); the noise that a recording states has no error.
        noise_error = (
            0.0 if channel.stated else 2.0 * NOISE_ESTIMATE_ERROR_FACTOR / residuals.size**0.5
        )
        standard_error = float(np.hypot(square * (2.0 / effective_samples) ** 0.5, noise_error))
        excess = max(0.0, square - 1.0) + Z95_ONE_SIDED * standard_error  # (3)
        sizes.append(channel.sigma * excess**0.5)
    return np.array(sizes)
