"""Sensor noise that remembers: first-order autoregression, how it is taken out, how surrogates of
it are made.

Noise e of a channel has variance sigma^2 and correlation phi between neighbouring samples: e_t =
phi e_(t-1) + u_t. Whitening (Prais & Winsten 1954; W. H. Greene, Econometric Analysis, chapter 20)
turns it into independent numbers of variance one, so that ordinary least squares becomes
generalised least squares. Across a missing sample it starts anew.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sims.base import Array

Mask = NDArray[np.bool_]

GRID = (0.0, 0.3, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98)
"""Correlations among which a likelihood is maximised."""


LAGS = 20
"""Correlations that the portmanteau test adds up."""


@dataclass(frozen=True)
class Noise:
    """Noise of each channel: sigma (C,) in its unit, phi (C,)."""

    sigma: Array
    phi: Array

    def coloured(self, phi: Array | float) -> Noise:
        """The same with other correlations."""
        return Noise(
            self.sigma, np.broadcast_to(np.asarray(phi, dtype=np.float64), self.sigma.shape).copy()
        )


def whitened(values: Array, seen: Mask, noise: Noise) -> Array:
    """Values (R, T, C, ...) as independent numbers of variance one; zero where nothing was seen,
    (R, T, C).
    """
    extra = (1,) * (values.ndim - 3)
    phi, sigma = (part.reshape(-1, *extra) for part in (noise.phi, noise.sigma))
    fresh = np.sqrt(1.0 - phi * phi)
    result: Array = values * (np.ones_like(phi) / sigma)
    if phi.any():
        follows = (seen[:, 1:] & seen[:, :-1]).reshape(
            seen.shape[0], seen.shape[1] - 1, seen.shape[2], *extra
        )
        before = result[:, :-1]
        result[:, 1:] = np.where(
            follows, (result[:, 1:] - phi * np.where(follows, before, 0.0)) / fresh, result[:, 1:]
        )
    mask = seen.reshape(*seen.shape, *extra)
    if not seen.all():
        result = np.where(mask, result, 0.0)
    return result


def log_determinant(seen: Mask, phi: Array | float) -> float:
    """Half the log determinant of whitening at unit variance: -0.5 log(1 - phi^2) for each sample
    that follows one.
    """
    follows = (seen[:, 1:] & seen[:, :-1]).sum(axis=(0, 1))
    return float(-0.5 * (follows * np.log1p(-np.square(phi))).sum())


@dataclass(frozen=True)
class Likelihood:
    """Twice the log likelihood of a residual, maximal over each channel's phi and sigma, and where."""

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
    total, sigmas, phis = 0.0, [], []
    share = lost / max(int(seen.sum()), 1)
    for c in range(residual.shape[2]):
        here = seen[:, :, c : c + 1]
        count = int(here.sum())
        if count == 0:
            sigmas.append(np.nan)
            phis.append(0.0)
            continue
        best = (-np.inf, 0.0, 0.0)
        for phi in _fine(residual[:, :, c : c + 1], here):
            w = whitened(residual[:, :, c : c + 1], here, Noise(np.ones(1), np.array([phi])))
            variance = max(float((w * w).sum()) / count, 1e-300)
            value = -count * np.log(variance) + 2.0 * log_determinant(here, phi)
            best = max(best, (value, phi, variance / max(1.0 - share, 0.1)))
        total += best[0]
        sigmas.append(best[2] ** 0.5)
        phis.append(best[1])
    return Likelihood(total, np.array(sigmas), np.array(phis))


def _fine(residual: Array, seen: Mask) -> Array:
    """Correlations worth a try: around the sample's own."""
    follows = seen[:, 1:] & seen[:, :-1]
    first, second = residual[:, :-1][follows], residual[:, 1:][follows]
    power = float(first @ first)
    rough = float(first @ second) / power if power > 0 else 0.0
    around = np.clip(
        rough + np.array([-0.1, -0.05, -0.02, 0.0, 0.01, 0.02, 0.05, 0.1]), -0.5, 0.995
    )
    found: Array = np.unique(np.append(around, 0.0))
    return found


def forgets(residual: Array, seen: Mask, found: Likelihood) -> float:
    """Probability that a residual (R, T, C) is nothing but first-order noise with the correlation
    found.

    The portmanteau test of what whitening leaves (G. M. Ljung, G. E. P. Box, Biometrika 65(2), 297,
    1978, doi:10.1093/biomet/65.2.297); of several channels the least probable counts, times their
    number.
    """
    from scipy.special import chdtrc

    least = 1.0
    for c, phi in enumerate(found.phi.tolist()):
        here = seen[:, :, c : c + 1]
        w = whitened(residual[:, :, c : c + 1], here, Noise(np.ones(1), np.array([phi])))[:, :, 0]
        power, count, total = max(float((w * w).sum()), 1e-300), max(int(here.sum()), 2), 0.0
        for lag in range(1, min(LAGS, w.shape[1] - 1) + 1):
            total += (float((w[:, lag:] * w[:, :-lag]).sum()) / power) ** 2 / max(
                count - lag * len(w), 1
            )
        least = min(least, float(chdtrc(LAGS - 1, count * (count + 2.0) * total)))
    return min(1.0, least * len(found.phi))


def surrogates(
    residual: Array, seen: Mask, count: int, rng: np.random.Generator, largest: int = 6
) -> Array:
    """Residuals (count, R, T, C) of the same spectrum that mean nothing: a sieve bootstrap.

    Each channel is fitted by an autoregression whose order Akaike's criterion picks, and driven
    again by its own resampled innovations (P. Buhlmann, Bernoulli 3(2), 123, 1997,
    doi:10.2307/3318584).
    """
    runs, length, channels = residual.shape
    result = np.zeros((count, runs, length, channels))
    burn = 200
    for c in range(channels):
        here = seen[:, :, c]
        weights, innovations = _autoregression(residual[:, :, c], here, largest)
        made = _driven(weights, rng.choice(innovations, size=(length + burn, count, runs)))[burn:]
        result[:, :, :, c] = np.where(here, np.moveaxis(made, 0, 2), 0.0)
    return result


def _driven(weights: Array, drive: Array) -> Array:
    """An autoregression (T, ...) of the innovations (T, ...)."""
    for t in range(1, len(drive)):
        for k, weight in enumerate(weights[:t], start=1):
            drive[t] += weight * drive[t - k]
    return drive


def _autoregression(values: Array, seen: Mask, largest: int) -> tuple[Array, Array]:
    """Weights (p,) of an autoregression of values (R, T) and its centred innovations."""
    filled = np.where(seen, values, 0.0)
    count = int(seen.sum())
    largest, covariances = min(largest, seen.shape[1] - 1), []
    for lag in range(largest + 1):
        both = seen[:, lag:] & seen[:, : seen.shape[1] - lag]
        pairs = max(int(both.sum()), 1)
        covariances.append(
            float((filled[:, lag:] * filled[:, : seen.shape[1] - lag]).sum()) / pairs
        )
    best, weights = np.inf, np.zeros(0)
    for order in range(largest + 1):
        solved, variance = _yule_walker(np.array(covariances), order)
        score = count * np.log(max(variance, 1e-300)) + 2.0 * order
        if score < best - 1e-9:
            best, weights = score, solved
    order = weights.size
    whole = np.all([seen[:, k : seen.shape[1] - order + k] for k in range(order + 1)], axis=0)
    innovations = filled[:, order:] - sum(
        (weights[k] * filled[:, order - 1 - k : seen.shape[1] - 1 - k] for k in range(order)),
        np.zeros(1),
    )
    kept = innovations[whole]
    if kept.size < 10:
        return np.zeros(0), filled[seen] if seen.any() else np.zeros(1)
    return weights, kept - kept.mean()


def _yule_walker(covariances: Array, order: int) -> tuple[Array, float]:
    if order == 0 or covariances[0] <= 0:
        return np.zeros(0), float(covariances[0])
    lags = np.abs(np.arange(order)[:, None] - np.arange(order))
    solved = np.linalg.solve(
        covariances[lags] + 1e-9 * covariances[0] * np.eye(order), covariances[1 : order + 1]
    )
    reflected = float(covariances[0] - solved @ covariances[1 : order + 1])
    if (
        reflected <= 0
        or np.abs(np.roots(np.concatenate([[1.0], -solved]))).max(initial=0.0) > 0.999
    ):
        return np.zeros(0), np.inf
    return solved, reflected
