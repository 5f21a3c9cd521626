"""Sensor noise that remembers: first-order autoregression, and how it is taken out.

Noise e of a channel has variance σ² and correlation φ between neighbouring samples (G. E. P. Box,
G. M. Jenkins, Time Series Analysis, chapter 3), u being independent of one sample to the next:

    e_t = φ e_{t-1} + u_t,   var u = (1 - φ²) σ²                                                 (1)

Whitening (S. J. Prais, C. B. Winsten 1954; W. H. Greene, Econometric Analysis, chapter 20) turns it
into independent numbers of variance one, so that ordinary least squares becomes generalised least
squares. A sample that follows none, at the beginning of a run or behind a missing one, starts anew:

    w_t = (e_t - φ e_{t-1}) / (σ √(1 - φ²)),   w_t = e_t / σ where no sample is before           (2)

Of n samples, m of which follow one, twice the log likelihood is, but for a constant,

    2 log L = - n log σ² - m log(1 - φ²) - Σ w_t²                                                (3)

and where σ² is the mean square v of what (2) leaves with σ = 1, it is highest:

    2 log L = - n log v - m log(1 - φ²) - n                                                      (4)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.analysis.chi_squared import chi_squared_tail
from sims.base import Array

Mask = NDArray[np.bool_]

GRID = (0.0, 0.3, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98)
"""Correlations among which a likelihood is maximised."""
AROUND = (-0.1, -0.05, -0.02, 0.0, 0.01, 0.02, 0.05, 0.1)
"""Correlations that are tried about the one that a residual itself shows."""
LEAST_PHI = -0.5
"""The lowest correlation that is tried: of errors that turn their sign from sample to sample."""
LARGEST_PHI = 0.995
"""The highest one: at 1 noise wanders without limit, and (2) divides by zero."""
LEAST_SHARE = 0.1
"""Share of the samples that a fit leaves at least, however many numbers it has fitted."""
LAGS = 20
"""Correlations that the portmanteau test adds up."""

TINY = 1e-300
"""Stands for a variance of zero, whose logarithm and reciprocal there are not."""


@dataclass(frozen=True)
class Noise:
    """Noise of each channel: sigma (C,) in its unit, phi (C,)."""

    sigma: Array
    phi: Array

    def coloured(self, phi: Array | float) -> Noise:
        """The same with other correlations."""
        correlations = np.asarray(phi, dtype=np.float64)
        spread = np.broadcast_to(correlations, self.sigma.shape)
        return Noise(self.sigma, spread.copy())


def _unit(phi: float) -> Noise:
    """Noise of one channel with a correlation and a variance of one."""
    return Noise(np.ones(1), np.array([phi]))


def _follows(seen: Mask) -> Mask:
    """(R, T - 1, C) whether a sample, the first left out, has one right before it."""
    follows: Mask = seen[:, 1:] & seen[:, :-1]
    return follows


def whitened(values: Array, seen: Mask, noise: Noise) -> Array:
    """Values as independent numbers of variance one, by (2).

    Args:
        values: (R, T, C, ...) noise, or derivatives of what bears it: (2) is linear.
        seen: (R, T, C) which samples there are; the others come out as zero.
        noise: of each channel.
    """
    extra = (1,) * (values.ndim - 3)
    # a derivative has axes behind that of the channels
    phi = noise.phi.reshape(-1, *extra)
    sigma = noise.sigma.reshape(-1, *extra)
    # a Jacobian is large, and multiplying is quicker than dividing
    result: Array = values * (1.0 / sigma)

    # (2), a second pass over all samples that white noise does not need
    if phi.any():
        pairs = _follows(seen)
        follows = pairs.reshape(*pairs.shape, *extra)
        # values where nothing was seen may be anything, even NaN: they must not reach the next
        before = np.where(follows, result[:, :-1], 0.0)
        latter = result[:, 1:]
        innovations = (latter - phi * before) / np.sqrt(1.0 - phi * phi)
        result[:, 1:] = np.where(follows, innovations, latter)

    if not seen.all():
        result = np.where(seen.reshape(*seen.shape, *extra), result, 0.0)
    return result


def log_determinant(seen: Mask, phi: Array | float) -> float:
    """Half the log determinant of whitening at unit variance, -m/2 log(1 - φ²) of (3)."""
    follows = _follows(seen).sum(axis=(0, 1))
    logarithms = np.log1p(-np.square(phi))
    return float(-0.5 * (follows * logarithms).sum())


@dataclass(frozen=True)
class Likelihood:
    """Twice the log likelihood of a residual, maximal over each channel's phi and sigma, and where.

    Attributes:
        value: (4) summed over the channels, without its last term, which is the same for all.
        sigma: (C,) 1 sigma of each channel's noise; NaN of a channel without samples.
        phi: (C,) its correlation.
    """

    value: float
    sigma: Array
    phi: Array


def likelihood(residual: Array, seen: Mask, lost: float = 0.0) -> Likelihood:
    """Of a residual (R, T, C), each channel's noise its own.

    Args:
        residual: what a model leaves.
        seen: which samples there are.
        lost: degrees of freedom that the fit has used, taken off the samples where sigma is
            estimated.
    """
    total = 0.0
    sigmas: list[float] = []
    phis: list[float] = []
    # every channel bears its part of what the fit has used
    samples = max(int(seen.sum()), 1)
    share = max(1.0 - lost / samples, LEAST_SHARE)
    for c in range(residual.shape[2]):
        channel = slice(c, c + 1)
        here = seen[:, :, channel]
        # nothing was seen of it: it has no likelihood, and no noise
        if not here.any():
            sigmas.append(np.nan)
            phis.append(0.0)
            continue
        value, phi, variance = _likeliest(residual[:, :, channel], here, share)
        total += value
        sigmas.append(variance**0.5)
        phis.append(phi)
    return Likelihood(total, np.array(sigmas), np.array(phis))


def _likeliest(
    residual: Array,
    seen: Mask,
    share: float,
) -> tuple[float, float, float]:
    """Of one channel (R, T, 1): the highest value of (4), with its correlation and variance.

    The variance is over the share of the samples that the fit has left; the value counts them all,
    as Schwarz's criterion has its own price for what is fitted.
    """
    count = int(seen.sum())
    best = (-np.inf, 0.0, 0.0)
    for phi in _near(residual, seen):
        w = whitened(residual, seen, _unit(phi))
        power = float((w * w).sum())
        variance = max(power / count, TINY)
        # (4), whose determinant is that of whitening
        determinant = 2.0 * log_determinant(seen, phi)
        value = -count * np.log(variance) + determinant
        hypothesis = (value, phi, variance / share)
        best = max(best, hypothesis)
    return best


def _near(residual: Array, seen: Mask) -> Array:
    """Correlations worth a try: around the sample's own."""
    follows = _follows(seen)
    former = residual[:, :-1][follows]
    latter = residual[:, 1:][follows]
    power = float(former @ former)
    # of zeros there is no correlation
    own = float(former @ latter) / power if power > 0 else 0.0
    tried = own + np.array(AROUND)
    around = np.clip(tried, LEAST_PHI, LARGEST_PHI)
    # white noise is always a hypothesis
    correlations: Array = np.unique(np.append(around, 0.0))
    return correlations


def forgets(residual: Array, seen: Mask, found: Likelihood) -> float:
    """Probability that a residual is nothing but first-order noise with the correlation found.

    The portmanteau test of what whitening leaves: where its correlations r_k at h lags are those of
    independent numbers, Q is a chi squared of h - 1 degrees of freedom, φ having taken one
    (G. M. Ljung, G. E. P. Box, Biometrika 65(2), 297, 1978, doi:10.1093/biomet/65.2.297).

        Q = n (n + 2) Σ r_k² / (n - k)                                                           (5)

    Of several channels the least probable counts, times their number (Bonferroni).

    Args:
        residual: (R, T, C) what a model leaves.
        seen: (R, T, C) which samples there are.
        found: its likelihood.
    """
    least = 1.0
    for c, phi in enumerate(found.phi.tolist()):
        channel = slice(c, c + 1)
        here = seen[:, :, channel]
        white = whitened(residual[:, :, channel], here, _unit(phi))
        count = max(int(here.sum()), 2)
        statistic = count * (count + 2.0) * _correlated(white[:, :, 0], count)  # (5)
        least = min(least, chi_squared_tail(LAGS - 1, statistic))
    return min(1.0, least * len(found.phi))


def _correlated(w: Array, count: int) -> float:
    """The sum in (5) of whitened values (R, T) with so many samples."""
    runs, length = w.shape
    power = max(float((w * w).sum()), TINY)
    total = 0.0
    for lag in range(1, min(LAGS, length - 1) + 1):
        products = w[:, lag:] * w[:, :-lag]
        correlation = float(products.sum()) / power
        # each run has a beginning of its own: so many pairs are lost in every one
        total += correlation**2 / max(count - lag * runs, 1)
    return total
