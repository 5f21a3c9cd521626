"""Sensor noise that remembers: first-order autoregression, how it is taken out, how surrogates of
it are made.

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

BURN_IN = 200
"""Samples that a surrogate is driven by before it counts, to forget that it began with nothing."""
RIDGE = 1e-9
"""Share of the variance added to the Yule-Walker matrix, which a pure tone makes singular."""
STATIONARY = 0.999
"""Largest root of an autoregression that is taken, in magnitude: from 1 on it does not die away."""
GAINED = 1e-9
"""An order must lower Akaike's criterion by more than this, else rounding would choose it."""
FEWEST = 10
"""Innovations from which surrogates are drawn at least; of fewer the samples themselves are."""
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
    from scipy.special import chdtrc

    least = 1.0
    for c, phi in enumerate(found.phi.tolist()):
        channel = slice(c, c + 1)
        here = seen[:, :, channel]
        white = whitened(residual[:, :, channel], here, _unit(phi))
        count = max(int(here.sum()), 2)
        statistic = count * (count + 2.0) * _correlated(white[:, :, 0], count)  # (5)
        least = min(least, float(chdtrc(LAGS - 1, statistic)))
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


def surrogates(
    residual: Array,
    seen: Mask,
    count: int,
    rng: np.random.Generator,
    largest: int = 6,
) -> Array:
    """Residuals (count, R, T, C) of the same spectrum that mean nothing: a sieve bootstrap.

    Each channel is fitted by an autoregression whose order Akaike's criterion picks, and driven
    again by its own resampled innovations (P. Buhlmann, Bernoulli 3(2), 123, 1997,
    doi:10.2307/3318584):

        e_t = Σ_k a_k e_{t-k} + u_t                                                              (6)

    Args:
        residual: (R, T, C) what a model leaves, zero where nothing was seen.
        seen: (R, T, C) which samples there are; the surrogates are zero elsewhere.
        count: how many.
        rng: draws the innovations.
        largest: order that an autoregression has at most.
    """
    runs, length, channels = residual.shape
    result = np.zeros((count, runs, length, channels))
    for c in range(channels):
        here = seen[:, :, c]
        weights, innovations = _autoregression(residual[:, :, c], here, largest)
        drawn = rng.choice(innovations, size=(length + BURN_IN, count, runs))
        # time comes first in what is driven, and last here
        driven = np.moveaxis(_driven(weights, drawn)[BURN_IN:], 0, 2)
        result[:, :, :, c] = np.where(here, driven, 0.0)
    return result


def _driven(weights: Array, innovations: Array) -> Array:
    """The autoregression (6) of innovations (T, ...), in their place."""
    order = weights.size
    if not order:
        return innovations
    flat = innovations.reshape(len(innovations), -1)
    # the oldest first, as samples stand
    backwards = weights[::-1]
    # a sample reads those before it, which are finished by then
    for t in range(1, len(flat)):
        before = flat[max(t - order, 0) : t]
        flat[t] += backwards[order - len(before) :] @ before
    return innovations


def _autoregression(values: Array, seen: Mask, largest: int) -> tuple[Array, Array]:
    """Weights (p,) of an autoregression of values (R, T), and its centred innovations."""
    filled = np.where(seen, values, 0.0)
    covariances = _autocovariances(filled, seen, min(largest, seen.shape[1] - 1))
    weights = _most_plausible(covariances, int(seen.sum()))
    innovations = _innovations(filled, seen, weights)
    if innovations.size < FEWEST:
        samples = filled[seen] if seen.any() else np.zeros(1)
        return np.zeros(0), samples
    # a mean of theirs would add up to an offset of the surrogates
    return weights, innovations - innovations.mean()


def _autocovariances(filled: Array, seen: Mask, largest: int) -> Array:
    """(largest + 1,) covariances of values (R, T) with those so many samples later, lag 0 first."""
    length = seen.shape[1]
    covariances = []
    for lag in range(largest + 1):
        former, latter = slice(0, length - lag), slice(lag, length)
        # what is missing adds nothing to the sum, so it must not count either
        pairs = seen[:, latter] & seen[:, former]
        products = filled[:, latter] * filled[:, former]
        covariances.append(float(products.sum()) / max(int(pairs.sum()), 1))
    return np.array(covariances)


def _most_plausible(covariances: Array, count: int) -> Array:
    """Weights (p,) of the order p that H. Akaike's criterion (1974) picks, n log var u + 2 p."""
    best = np.inf
    weights = np.zeros(0)
    for order in range(len(covariances)):
        solved, variance = _yule_walker(covariances, order)
        criterion = count * np.log(max(variance, TINY)) + 2.0 * order
        if criterion < best - GAINED:
            best = criterion
            weights = solved
    return weights


def _innovations(filled: Array, seen: Mask, weights: Array) -> Array:
    """(n,) the u of (6), where all samples are there that it needs."""
    order, length = weights.size, seen.shape[1]
    predicted = np.zeros(1)
    # a sample and all that it is predicted from
    complete = seen[:, order:]
    for k, weight in enumerate(weights, start=1):
        earlier = slice(order - k, length - k)
        predicted = predicted + weight * filled[:, earlier]
        complete = complete & seen[:, earlier]
    innovations: Array = (filled[:, order:] - predicted)[complete]
    return innovations


def _yule_walker(covariances: Array, order: int) -> tuple[Array, float]:
    """Weights (p,) of an autoregression from covariances γ, and the variance of its innovations.

    The equations of Yule and Walker (Box & Jenkins, chapter 3):

        Σ_l γ_|k-l| a_l = γ_k,   var u = γ_0 - Σ_k a_k γ_k                                       (7)

    The variance is infinite where (6) would not die away, so that nothing prefers it.
    """
    power = covariances[0]
    # white, or nothing at all
    if order == 0 or power <= 0:
        return np.zeros(0), float(power)
    numbers = np.arange(order)
    lags = np.abs(numbers[:, None] - numbers)
    later = covariances[1 : order + 1]
    # (7), the matrix first
    matrix = covariances[lags] + RIDGE * power * np.eye(order)
    weights = np.linalg.solve(matrix, later)
    variance = float(power - weights @ later)
    # what (6) makes of one innovation is a sum of powers of these
    roots = np.roots(np.concatenate([[1.0], -weights]))
    if variance <= 0 or np.abs(roots).max(initial=0.0) > STATIONARY:
        return np.zeros(0), np.inf
    return weights, variance
