"""Noise that means nothing but has the spectrum of what a model leaves: a sieve bootstrap.

Each channel is fitted by an autoregression whose order Akaike's criterion picks, and driven again
by its own resampled innovations (P. Buhlmann, Bernoulli 3(2), 123, 1997, doi:10.2307/3318584):

    e_t = Σ_k a_k e_{t-k} + u_t                                                                  (1)

Of a short run a fit takes the slow part of the noise with it, so that what is left seems to
remember less than the noise does, and scores that slow changes reach by chance would be thought
rare. What the same fit leaves of a first set of surrogates says by how much, and a second set is
driven without that bias (bootstrap after bootstrap; L. Kilian, Rev. Econ. Stat. 80(2), 218, 1998,
doi:10.1162/003465398557465), with a* the weights that the first set's leavings seem to have:

    a ← a + s (a - a*),   s the largest share of 1 whose noise dies away                         (2)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from bench.gap.model.noise import TINY, Mask
from sims.base import Array

BURN_IN = 200
"""Samples that a surrogate is driven by before it counts, to forget that it began with nothing."""
RIDGE = 1e-9
"""Share of the variance added to the Yule-Walker matrix, which a pure tone makes singular."""
STATIONARY = 0.999
"""Largest root of an autoregression that is taken, in magnitude: from 1 on it does not die away."""
GAINED = 1e-9
"""An order must lower Akaike's criterion by more than this, else rounding would choose it."""
SHARES = tuple(share / 20.0 for share in range(20, 0, -1))
"""Shares of a bias that are taken out, the largest first that leaves noise which dies away."""
PILOTS = (20, 100)
"""Surrogates of the first set, at least and at most."""
PILOTED = 20_000
"""So many samples of theirs say what the bias is: it is less than their error where it is small."""
NUMBERS = 500_000
"""Numbers that are driven at once: more would not stay in the cache."""
WIDTH = 1_000
"""But so many side by side at least, or each step would cost more than its numbers."""
FEWEST = 10
"""Innovations from which surrogates are drawn at least; of fewer the samples themselves are."""


def surrogates(
    residual: Array,
    seen: Mask,
    count: int,
    rng: np.random.Generator,
    largest: int = 6,
    left: Callable[[Array], Array] | None = None,
) -> Array:
    """Residuals (count, R, T, C) of the same spectrum that mean nothing.

    Args:
        residual: (R, T, C) what a model leaves, zero where nothing was seen.
        seen: (R, T, C) which samples there are; the surrogates are zero elsewhere.
        count: how many.
        rng: draws the innovations.
        largest: order that an autoregression has at most.
        left: what a fit leaves of noises (count, R, T, C); without it nothing is corrected.
    """
    channels = residual.shape[2]
    weights = [_autoregression(residual[..., c], seen[..., c], largest) for c in range(channels)]
    # White noise has nothing to remember less of.
    if left is not None and any(w.size for w in weights):
        pilots = int(np.clip(PILOTED // max(int(seen.sum()), 1), *PILOTS))
        leavings = left(_drawn(residual, seen, weights, pilots, rng))
        for c in range(channels):
            weights[c] = _unbiased(weights[c], leavings[..., c], seen[..., c])
    return _drawn(residual, seen, weights, count, rng)


def _drawn(
    residual: Array, seen: Mask, weights: Sequence[Array], count: int, rng: np.random.Generator
) -> Array:
    """(count, R, T, C) autoregressions (1) with weights (p,) of each channel, driven by resampled
    innovations of a residual.
    """
    runs, length, channels = residual.shape
    result = np.zeros((count, runs, length, channels))
    for c, own in enumerate(weights):
        here = seen[:, :, c]
        filled = np.where(here, residual[:, :, c], 0.0)
        innovations = _centred(filled, here, own)
        step = max(NUMBERS // ((length + BURN_IN) * runs), WIDTH // runs, 1)
        for first in range(0, count, step):
            some = result[first : first + step, :, :, c]
            drawn = rng.choice(innovations, size=(length + BURN_IN, len(some), runs))
            # time comes first in what is driven, and last here
            driven = np.moveaxis(_driven(own, drawn)[BURN_IN:], 0, 2)
            some[...] = np.where(here, driven, 0.0)
    return result


def _unbiased(weights: Array, leavings: Array, seen: Mask) -> Array:
    """Weights (p,) by (2), of what a fit leaves (count, R, T) of noises that these have made."""
    order = weights.size
    count, *shape = leavings.shape
    covariances = _autocovariances(leavings.reshape(-1, shape[1]), np.tile(seen, (count, 1)), order)
    found, _ = _yule_walker(covariances, order)
    # no such autoregression: nothing is known of the bias
    if found.size != order:
        return weights
    for share in SHARES:
        corrected = weights + share * (weights - found)
        if _root(corrected) <= STATIONARY:
            return corrected
    return weights


def _driven(weights: Array, innovations: Array) -> Array:
    """The autoregression (1) of innovations (T, ...), in their place."""
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


def _autoregression(values: Array, seen: Mask, largest: int) -> Array:
    """Weights (p,) of an autoregression of values (R, T); none where too few could drive it."""
    filled = np.where(seen, values, 0.0)
    covariances = _autocovariances(filled, seen, min(largest, seen.shape[1] - 1))
    weights = _most_plausible(covariances, int(seen.sum()))
    return weights if _innovations(filled, seen, weights).size >= FEWEST else np.zeros(0)


def _centred(filled: Array, seen: Mask, weights: Array) -> Array:
    """(n,) innovations by weights (p,) less their mean; the samples themselves if too few."""
    innovations = _innovations(filled, seen, weights)
    if innovations.size < FEWEST:
        return filled[seen] if seen.any() else np.zeros(1)
    # a mean of theirs would add up to an offset of the surrogates
    centred: Array = innovations - innovations.mean()
    return centred


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
    """(n,) the u of (1), where all samples are there that it needs."""
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

        Σ_l γ_|k-l| a_l = γ_k,   var u = γ_0 - Σ_k a_k γ_k                                       (3)

    The variance is infinite where (1) would not die away, so that nothing prefers it.
    """
    power = covariances[0]
    # white, or nothing at all
    if order == 0 or power <= 0:
        return np.zeros(0), float(power)
    numbers = np.arange(order)
    lags = np.abs(numbers[:, None] - numbers)
    later = covariances[1 : order + 1]
    # (3), the matrix first
    matrix = covariances[lags] + RIDGE * power * np.eye(order)
    weights = np.linalg.solve(matrix, later)
    variance = float(power - weights @ later)
    if variance <= 0 or _root(weights) > STATIONARY:
        return np.zeros(0), np.inf
    return weights, variance


def _root(weights: Array) -> float:
    """The largest root, in magnitude: what (1) makes of one innovation is a sum of their powers."""
    roots = np.roots(np.concatenate([[1.0], -weights]))
    return float(np.abs(roots).max(initial=0.0))
