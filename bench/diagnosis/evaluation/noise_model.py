"""AR(1) sensor noise: likelihood, whitening, portmanteau test and standard error of sigma.

The noise e of a channel has variance σ² and correlation φ between neighbouring samples (G. E. P.
Box, G. M. Jenkins, Time Series Analysis, chapter 3). The innovations u are independent:

    e_t = φ e_{t-1} + u_t,   var u = (1 - φ²) σ²                                                 (1)

Whitening (S. J. Prais, C. B. Winsten 1954; W. H. Greene, Econometric Analysis, chapter 20)
transforms it into independent numbers of variance one, so that ordinary least squares becomes
generalised least squares. A sample without a predecessor, at the start of a run or after a missing
sample, starts a new sequence:

    w_t = (e_t - φ e_{t-1}) / (σ √(1 - φ²)),   w_t = e_t / σ without a predecessor               (2)

For n samples, of which m have a predecessor, twice the log-likelihood is, up to a constant,

    2 log L = - n log σ² - m log(1 - φ²) - Σ w_t²                                                (3)

Its maximum over σ² is at the mean square v of (2) for σ = 1:

    2 log L = - n log v - m log(1 - φ²) - n                                                      (4)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.benchmark.statistics.chi_squared import chi_squared_tail
from sims.core.simulator import Array

Mask = NDArray[np.bool_]

PHI_GRID = (0.0, 0.3, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98)
"""Correlations over which a likelihood is maximised."""
PHI_OFFSETS = (-0.1, -0.05, -0.02, 0.0, 0.01, 0.02, 0.05, 0.1)
"""Offsets from the sample correlation of a residual that are tried."""
MIN_PHI = -0.5
"""Minimum correlation that is tried; negative for errors with alternating sign."""
MAX_PHI = 0.995
"""Maximum correlation that is tried; at 1 the noise is not stationary, and (2) divides by zero."""
MIN_EFFECTIVE_SAMPLE_SHARE = 0.1
"""Minimum share of the samples that remain as degrees of freedom after a fit."""
MAX_STANDARD_ERROR_PHI = 0.99
"""Maximum correlation from which the standard error of a standard deviation is computed."""
PORTMANTEAU_LAGS = 20
"""Number of autocorrelations in the portmanteau test."""

MIN_VARIANCE = 1e-300
"""Minimum variance, because zero has no logarithm and no reciprocal."""


@dataclass(frozen=True)
class NoiseModel:
    """Noise of each channel.

    Attributes:
        sigma: (C,) standard deviation, in the unit of the channel.
        phi: (C,) AR(1) correlation.
    """

    sigma: Array
    phi: Array

    @classmethod
    def make_white(cls, sigma: Array) -> NoiseModel:
        """Make noise without autocorrelation of the given standard deviations (C,)."""
        return cls(sigma, np.zeros(len(sigma)))


def _make_unit_noise(phi: float) -> NoiseModel:
    """Return the noise of one channel with the given correlation and variance one."""
    return NoiseModel(np.ones(1), np.array([phi]))


def _has_predecessor(observed_mask: Mask) -> Mask:
    """Return whether each sample but the first has a direct predecessor (R, T - 1, C)."""
    has_predecessor: Mask = observed_mask[:, 1:] & observed_mask[:, :-1]
    return has_predecessor


def whiten(values: Array, observed_mask: Mask, noise: NoiseModel) -> Array:
    """Transform AR(1) noise to independent numbers of variance one (whitening).

    Least squares of whitened residuals is generalised least squares. With the residual e_t, w_t =
    (e_t - phi e_{t-1}) / (sigma sqrt(1 - phi^2)); a sample without a predecessor has w_t = e_t /
    sigma.

    Shapes: R runs, T samples, C channels.

    Args:
        values: (R, T, C, ...) noise, or derivatives of noisy signals, because whitening is linear.
        observed_mask: (R, T, C) mask of available samples; the others become zero.
        noise: standard deviation sigma and correlation phi of each channel.

    Returns:
        Values of the same shape; whitened noise is independent with variance one.
    """
    # Derivatives have further axes after that of the channels; noise and masks get them here.
    extra = (1,) * (values.ndim - 3)
    phi = noise.phi.reshape(-1, *extra)
    sigma = noise.sigma.reshape(-1, *extra)
    # A Jacobian is large, and multiplication is faster than division.
    whitened: Array = values * (1.0 / sigma)

    # A second pass over all samples, which white noise does not need.
    if phi.any():
        pairs = _has_predecessor(observed_mask)
        has_predecessor = pairs.reshape(*pairs.shape, *extra)
        # Values of missing samples are arbitrary, even NaN, and must not affect the next sample.
        previous_samples = np.where(has_predecessor, whitened[:, :-1], 0.0)
        samples = whitened[:, 1:]
        innovations = (samples - phi * previous_samples) / np.sqrt(1.0 - phi * phi)
        whitened[:, 1:] = np.where(has_predecessor, innovations, samples)

    # Missing samples become zero, so that they add nothing to a sum of squares.
    if not observed_mask.all():
        whitened = np.where(observed_mask.reshape(*observed_mask.shape, *extra), whitened, 0.0)
    return whitened


def compute_log_determinant(observed_mask: Mask, phi: Array | float) -> float:
    """Return the log-determinant term of the Gaussian log-likelihood of AR(1) noise.

    It is -1/2 log det Σ, where Σ is the correlation matrix of the noise of a channel, summed over
    the channels. For AR(1) noise it equals -m/2 log(1 - φ²), where m is the number of recorded
    samples whose preceding sample is also recorded. The standard deviations of the channels enter
    the log-likelihood separately.

    Shapes: R runs, T samples, C channels.

    Args:
        observed_mask: (R, T, C) whether a sample is recorded.
        phi: (C,) AR(1) correlation of each channel, or one for all.
    """
    predecessor_counts = _has_predecessor(observed_mask).sum(axis=(0, 1))
    logarithms = np.log1p(-np.square(phi))
    return float(-0.5 * (predecessor_counts * logarithms).sum())


@dataclass(frozen=True)
class Likelihood:
    """Twice the log-likelihood of a residual, maximised over phi and sigma of each channel.

    Attributes:
        value: twice the log-likelihood, eq. (4) of the module docstring, summed over the channels,
            without its last term, which is the same for all models.
        sigma: (C,) standard deviation of the noise of each channel; NaN for a channel without
            samples.
        phi: (C,) AR(1) correlation of each channel.
    """

    value: float
    sigma: Array
    phi: Array


def maximise_likelihood(
    residual: Array, observed_mask: Mask, fitted_freedom: float = 0.0
) -> Likelihood:
    """Maximise the likelihood of a residual over the noise of each channel.

    Models are compared by it, since their true noise is not known.

    Shapes: R runs, T samples, C channels.

    Args:
        residual: (R, T, C) residual of a model.
        observed_mask: (R, T, C) mask of available samples.
        fitted_freedom: degrees of freedom used by the fit, subtracted from the samples when sigma
            is estimated.

    Returns:
        Twice the log-likelihood, summed over the channels, and the noise of each channel.
    """
    log_likelihood = 0.0
    sigmas: list[float] = []
    phis: list[float] = []
    # The degrees of freedom of the fit are distributed over the channels by their samples, so that
    # the same share of the samples remains in each.
    samples = max(int(observed_mask.sum()), 1)
    degrees_of_freedom_ratio = max(1.0 - fitted_freedom / samples, MIN_EFFECTIVE_SAMPLE_SHARE)
    for channel_index in range(residual.shape[2]):
        channel = slice(channel_index, channel_index + 1)
        channel_mask = observed_mask[:, :, channel]
        # A channel without samples has no likelihood and no noise.
        if not channel_mask.any():
            sigmas.append(np.nan)
            phis.append(0.0)
            continue
        value, phi, variance = _maximise_channel_likelihood(
            residual[:, :, channel], channel_mask, degrees_of_freedom_ratio
        )
        log_likelihood += value
        sigmas.append(variance**0.5)
        phis.append(phi)
    return Likelihood(log_likelihood, np.array(sigmas), np.array(phis))


def _maximise_channel_likelihood(
    residual: Array,
    observed_mask: Mask,
    freedom_share: float,
) -> tuple[float, float, float]:
    """Return the maximum of eq. (4) for one channel, with its correlation and variance.

    With n samples, m of them with a predecessor, and the mean square v of the values whitened with
    sigma = 1 and the AR(1) correlation phi, 2 log L = -n log v - m log(1 - phi^2) - n, eq. (4) of
    the module docstring. The last term is left out, because it is the same for all models. The
    likelihood counts all samples, because Schwarz's criterion has a separate penalty for fitted
    parameters. The variance is estimated with the remaining degrees of freedom.

    Shapes: R runs, T samples.

    Args:
        residual: (R, T, 1) residual.
        observed_mask: (R, T, 1) mask of available samples.
        freedom_share: remaining degrees of freedom, as a fraction of the samples.

    Returns:
        Twice the log-likelihood, the correlation phi and the variance.
    """
    sample_count = int(observed_mask.sum())
    best = (-np.inf, 0.0, 0.0)
    for phi in _list_nearby_phis(residual, observed_mask):
        whitened = whiten(residual, observed_mask, _make_unit_noise(phi))
        sum_of_squares = float((whitened * whitened).sum())
        variance = max(sum_of_squares / sample_count, MIN_VARIANCE)
        # -m log(1 - phi^2) of eq. (4).
        determinant = 2.0 * compute_log_determinant(observed_mask, phi)
        value = -sample_count * np.log(variance) + determinant
        # Tuples are compared by the likelihood first.
        best = max(best, (value, phi, variance / freedom_share))
    return best


def _list_nearby_phis(residual: Array, observed_mask: Mask) -> Array:
    """Return the AR(1) correlations φ at which the likelihood of a channel is computed.

    They are near the sample correlation of the residual, where the maximum is. Zero (white noise)
    is always included.

    Shapes: R runs, T samples.

    Args:
        residual: (R, T, 1) residual of the channel.
        observed_mask: (R, T, 1) whether a sample is recorded.

    Returns:
        Distinct correlations (n,), increasing.
    """
    has_predecessor = _has_predecessor(observed_mask)
    previous_samples = residual[:, :-1][has_predecessor]
    next_samples = residual[:, 1:][has_predecessor]
    sum_of_squares = float(previous_samples @ previous_samples)
    # The correlation of zeros is not defined.
    sample_phi = (
        float(previous_samples @ next_samples) / sum_of_squares if sum_of_squares > 0 else 0.0
    )
    candidate_phis = sample_phi + np.array(PHI_OFFSETS)
    clipped_phis = np.clip(candidate_phis, MIN_PHI, MAX_PHI)
    correlations: Array = np.unique(np.append(clipped_phis, 0.0))
    return correlations


def compute_sigma_standard_error(phi: float, sample_count: int) -> float:
    """Return the relative standard error of an estimated standard deviation of AR(1) noise.

    The standard deviation sigma is that of a residual of n samples with correlation phi (formula of
    M. S. Bartlett, 1946, at lag 0):

        sd(sigma) / sigma = sqrt((1 + phi^2) / (1 - phi^2) / (2 n))                              (5)

    Args:
        phi: correlation of neighbouring samples; its magnitude counts at most as
            `MAX_STANDARD_ERROR_PHI`.
        sample_count: number n of samples; it counts at least as 2.
    """
    # At a correlation of one, the formula diverges, and no channel would exceed its noise.
    phi = min(abs(phi), MAX_STANDARD_ERROR_PHI)
    # A channel may have no samples, and must not be divided by zero.
    relative_variance = (1.0 + phi * phi) / (1.0 - phi * phi) / (2.0 * max(sample_count, 2))
    return float(np.sqrt(relative_variance))  # (5)


def compute_portmanteau_p_value(
    residual: Array, observed_mask: Mask, likelihood: Likelihood
) -> float:
    """Return the p-value of the hypothesis that a residual is AR(1) noise (Ljung-Box test).

    A small value means that the residual has structure. If the autocorrelations r_k of the whitened
    residual at h lags are those of n independent numbers, Q has a chi-squared distribution with h -
    1 degrees of freedom; φ has used one (G. M. Ljung, G. E. P. Box, Biometrika 65(2), 297, 1978,
    doi:10.1093/biomet/65.2.297).

        Q = n (n + 2) Σ r_k² / (n - k)                                                           (6)

    With several channels, the smallest p-value is multiplied by their number (Bonferroni).

    Shapes: R runs, T samples, C channels.

    Args:
        residual: (R, T, C) residual of a model.
        observed_mask: (R, T, C) mask of available samples.
        likelihood: likelihood of the residual, which contains the fitted correlations.
    """
    min_p_value = 1.0
    for channel_index, phi in enumerate(likelihood.phi.tolist()):
        channel = slice(channel_index, channel_index + 1)
        channel_mask = observed_mask[:, :, channel]
        white = whiten(residual[:, :, channel], channel_mask, _make_unit_noise(phi))
        sample_count = max(int(channel_mask.sum()), 2)
        statistic = (
            sample_count
            * (sample_count + 2.0)
            * _compute_ljung_box_sum(white[:, :, 0], sample_count)
        )  # (6)
        min_p_value = min(min_p_value, chi_squared_tail(PORTMANTEAU_LAGS - 1, statistic))
    return min(1.0, min_p_value * len(likelihood.phi))


def _compute_ljung_box_sum(whitened: Array, count: int) -> float:
    """Return the sum Σ r_k² / (n - k) of the Ljung-Box test of `compute_portmanteau_p_value`.

    r_k is the autocorrelation of the whitened values at lag k, and n the number of samples. With R
    runs, n - k becomes n - R k, because no pair of samples spans two runs.

    Shapes: R runs, T samples.

    Args:
        whitened: (R, T) whitened values of a channel, zero where no sample exists.
        count: n, the number of samples.
    """
    runs, length = whitened.shape
    sum_of_squares = max(float((whitened * whitened).sum()), MIN_VARIANCE)
    total = 0.0
    for lag in range(1, min(PORTMANTEAU_LAGS, length - 1) + 1):
        products = whitened[:, lag:] * whitened[:, :-lag]
        correlation = float(products.sum()) / sum_of_squares
        total += correlation**2 / max(count - lag * runs, 1)
    return total
