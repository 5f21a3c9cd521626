"""Surrogate residuals: random noise with the spectrum of a residual (sieve bootstrap).

Each channel is fitted by an autoregression, whose order is selected by Akaike's criterion, and
simulated with its own resampled innovations (P. Buhlmann, Bernoulli 3(2), 123, 1997,
doi:10.2307/3318584):

    e_t = Σ_k a_k e_{t-k} + u_t                                                                  (1)

In a short run, the fit absorbs the slow part of the noise. The residual then seems less correlated
than the noise is, and scores that slow changes reach under the null hypothesis would seem too rare.
This bias is estimated by applying the same fit to a first set of surrogates, and a second set is
generated without it (bootstrap after bootstrap; L. Kilian, Rev. Econ. Stat. 80(2), 218, 1998,
doi:10.1162/003465398557465). With a* the weights estimated from the residuals of the first set:

    a ← a + s (a - a*),   s the largest share of 1 for which the process is stationary           (2)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from bench.diagnosis.evaluation.noise_model import MIN_VARIANCE, Mask
from sims.core.simulator import Array

BURN_IN_SAMPLES = 200
"""Number of initial samples of a surrogate that are discarded, to remove its zero initial state."""
MAX_ORDER = 6
"""Maximum order of an autoregression."""
YULE_WALKER_RIDGE = 1e-9
"""Share of the variance added to the Yule-Walker matrix, which a pure tone makes singular."""
MAX_ROOT = 0.999
"""Maximum modulus of the roots of an autoregression; from 1 on the process is not stationary."""
MIN_AIC_GAIN = 1e-9
"""Minimum decrease of Akaike's criterion by a higher order; smaller ones are due to rounding."""
BIAS_CORRECTION_SHARES = tuple(share / 20.0 for share in range(20, 0, -1))
"""Shares of the bias correction to try, largest first, until the process is stationary."""
PILOT_COUNT_RANGE = (20, 100)
"""Minimum and maximum number of surrogates of the first set, which estimates the bias."""
PILOT_SAMPLE_COUNT = 20_000
"""Target number of samples of the first set.

A bias that is smaller than its error of estimation does not matter.
"""
MAX_CHUNK_SIZE = 500_000
"""Maximum number of values that are simulated at once; more would not fit in the CPU cache."""
MIN_CHUNK_WIDTH = 1_000
"""Minimum number of series that are simulated in parallel, so that the cost per step is low."""
MIN_INNOVATIONS = 10
"""Minimum number of innovations to resample; with fewer, the samples themselves are resampled."""


def draw_surrogates(
    residual: Array,
    observed_mask: Mask,
    count: int,
    rng: np.random.Generator,
    project_out: Callable[[Array], Array] | None = None,
) -> Array:
    """Draw residuals (count, R, T, C) with the spectrum of a given residual.

    They contain no effect, so their scores show which scores noise alone reaches.

    1. Fit an autoregression to each channel.
    2. A fit of a model has made the noise look less correlated. Estimate this bias from a first set
       of surrogates (pilots), and correct the autoregressions.
    3. Simulate them with innovations that are drawn at random from those of the residual.

    Shapes: R runs, T samples, C channels.

    Args:
        residual: (R, T, C) residual of a model, zero where no sample exists.
        observed_mask: (R, T, C) mask of available samples; the surrogates are zero elsewhere.
        count: number of surrogates.
        rng: random numbers for the innovations.
        project_out: callback that fits the model to pilots (count, R, T, C) as if they were data,
            and returns the residuals of these fits; without it the bias is not corrected.
    """
    channels = residual.shape[2]
    # 1. Autoregressions.
    weights = [
        _fit_autoregression(residual[..., c], observed_mask[..., c]) for c in range(channels)
    ]
    # 2. Bias. White noise has no correlation that a fit could reduce.
    if project_out is not None and any(w.size for w in weights):
        pilot_count = int(
            np.clip(PILOT_SAMPLE_COUNT // max(int(observed_mask.sum()), 1), *PILOT_COUNT_RANGE)
        )
        projected_pilots = project_out(
            _simulate_autoregression(residual, observed_mask, weights, pilot_count, rng)
        )
        for c in range(channels):
            weights[c] = _correct_bias(weights[c], projected_pilots[..., c], observed_mask[..., c])
    # 3. Simulation.
    return _simulate_autoregression(residual, observed_mask, weights, count, rng)


def _simulate_autoregression(
    residual: Array,
    observed_mask: Mask,
    weights: Sequence[Array],
    count: int,
    rng: np.random.Generator,
) -> Array:
    """Simulate autoregressions with innovations that are drawn from those of a residual.

    The process is e_t = sum_k a_k e_{t-k} + u_t, eq. (1) of the module docstring, with weights a_k
    and independent innovations u_t. Series are simulated in chunks that fit in the CPU cache.

    Shapes: R runs, T samples, C channels.

    Args:
        residual: (R, T, C) residual.
        observed_mask: (R, T, C) mask of available samples.
        weights: weights (p,) of each channel.
        count: number of surrogates.
        rng: random numbers for the innovations.

    Returns:
        Surrogates (count, R, T, C).
    """
    runs, length, channels = residual.shape
    result = np.zeros((count, runs, length, channels))
    for channel_index, channel_weights in enumerate(weights):
        channel_mask = observed_mask[:, :, channel_index]
        filled = np.where(channel_mask, residual[:, :, channel_index], 0.0)
        innovations = _compute_centred_innovations(filled, channel_mask, channel_weights)
        # Number of surrogates that are simulated at once.
        chunk_size = max(
            MAX_CHUNK_SIZE // ((length + BURN_IN_SAMPLES) * runs), MIN_CHUNK_WIDTH // runs, 1
        )
        for first in range(0, count, chunk_size):
            # A view: writing to it fills the result.
            surrogates = result[first : first + chunk_size, :, :, channel_index]
            drawn_innovations = rng.choice(
                innovations, size=(length + BURN_IN_SAMPLES, len(surrogates), runs)
            )
            # Time is the first axis of the simulation, and the last axis here.
            simulated = np.moveaxis(
                _drive_autoregression(channel_weights, drawn_innovations)[BURN_IN_SAMPLES:], 0, 2
            )
            surrogates[...] = np.where(channel_mask, simulated, 0.0)
    return result


def _correct_bias(weights: Array, projected_pilots: Array, observed_mask: Mask) -> Array:
    """Correct weights (p,) for the bias of a fit, by eq. (2) of the module docstring.

    The surrogates have the weights a. After a fit of the model to them, their residuals have the
    weights a*. The corrected weights are a + s (a - a*), where s is the largest share of 1 for
    which the process is stationary; without such a share, they stay as they are.

    Shapes: R runs, T samples.

    Args:
        weights: (p,) weights of an autoregression.
        projected_pilots: (count, R, T) residuals of a fit of the model to such surrogates.
        observed_mask: (R, T) mask of available samples.
    """
    order = weights.size
    count, _, length = projected_pilots.shape
    covariances = _estimate_autocovariances(
        projected_pilots.reshape(-1, length), np.tile(observed_mask, (count, 1)), order
    )
    estimated_weights, _ = _solve_yule_walker(covariances, order)
    # If no autoregression of this order is found, the bias is unknown.
    if estimated_weights.size != order:
        return weights
    for share in BIAS_CORRECTION_SHARES:
        corrected = weights + share * (weights - estimated_weights)
        if _compute_max_root(corrected) <= MAX_ROOT:
            return corrected
    return weights


def _drive_autoregression(weights: Array, innovations: Array) -> Array:
    """Turn innovations (T, ...) into autocorrelated noise by the autoregression (1), in place.

    The autoregression is e_t = sum_k a_k e_{t-k} + u_t (1).

    Args:
        weights: (p,) weights a_k, that of the previous sample first; without weights the noise
            stays white.
        innovations: (T, ...) independent u_t; they are replaced by e_t.
    """
    order = weights.size
    if not order:
        return innovations
    flat = innovations.reshape(len(innovations), -1)
    # The weight of the oldest sample comes first, in the order of the samples.
    reversed_weights = weights[::-1]
    # A sample depends only on earlier ones, which are complete by then. The first one has none, and
    # stays as it is.
    for t in range(1, len(flat)):
        previous = flat[max(t - order, 0) : t]
        # The first samples have fewer than `order` predecessors.
        flat[t] += reversed_weights[order - len(previous) :] @ previous
    return innovations


def _fit_autoregression(values: Array, observed_mask: Mask) -> Array:
    """Fit an autoregression by the Yule-Walker equations, with the order of Akaike's criterion.

    The model is e_t = sum_k a_k e_{t-k} + u_t (1), with weights a_k and independent u_t.

    Shapes: R runs, T samples.

    Args:
        values: (R, T) residual of one channel.
        observed_mask: (R, T) whether a sample is recorded.

    Returns:
        Weights a_k (p,); empty, for white noise, if fewer than `MIN_INNOVATIONS` innovations can be
        computed.
    """
    filled = np.where(observed_mask, values, 0.0)
    covariances = _estimate_autocovariances(
        filled, observed_mask, min(MAX_ORDER, observed_mask.shape[1] - 1)
    )
    weights = _select_order_by_aic(covariances, int(observed_mask.sum()))
    if _compute_innovations(filled, observed_mask, weights).size < MIN_INNOVATIONS:
        return np.zeros(0)
    return weights


def _compute_centred_innovations(filled: Array, observed_mask: Mask, weights: Array) -> Array:
    """Return the innovations (n,) minus their mean; the samples themselves if there are too few.

    The innovations are the u_t of the process e_t = sum_k a_k e_{t-k} + u_t. Without any sample, a
    single zero is returned.

    Shapes: R runs, T samples.

    Args:
        filled: (R, T) residual of one channel, zero where it is not recorded.
        observed_mask: (R, T) whether a sample is recorded.
        weights: (p,) weights of the autoregression.
    """
    innovations = _compute_innovations(filled, observed_mask, weights)
    if innovations.size < MIN_INNOVATIONS:
        return filled[observed_mask] if observed_mask.any() else np.zeros(1)
    # A nonzero mean would accumulate to an offset of the surrogates.
    centred: Array = innovations - innovations.mean()
    return centred


def _estimate_autocovariances(filled: Array, observed_mask: Mask, max_order: int) -> Array:
    """Estimate the autocovariances (max_order + 1,) of values (R, T) at the lags 0 to `max_order`.

    The autocovariance at a lag is the mean product of two samples that are so far apart.

    Shapes: R runs, T samples.

    Args:
        filled: values, zero where no sample exists.
        observed_mask: mask of available samples; only pairs of these count.
        max_order: largest lag.
    """
    length = observed_mask.shape[1]
    covariances = []
    for lag in range(max_order + 1):
        earlier_samples, later_samples = slice(0, length - lag), slice(lag, length)
        # Missing samples add nothing to the sum, so their pairs are not counted either.
        pairs = observed_mask[:, later_samples] & observed_mask[:, earlier_samples]
        products = filled[:, later_samples] * filled[:, earlier_samples]
        covariances.append(float(products.sum()) / max(int(pairs.sum()), 1))
    return np.array(covariances)


def _select_order_by_aic(covariances: Array, count: int) -> Array:
    """Return weights (p,) of the order p with the lowest n log var u + 2 p (H. Akaike, 1974).

    var u is the variance of the innovations of an autoregression of order p, and n the number of
    samples.

    Args:
        covariances: (q + 1,) autocovariances at lags 0 to q, the maximum order.
        count: number n of recorded samples.
    """
    best = np.inf
    weights = np.zeros(0)
    for order in range(len(covariances)):
        order_weights, variance = _solve_yule_walker(covariances, order)
        criterion = count * np.log(max(variance, MIN_VARIANCE)) + 2.0 * order
        if criterion < best - MIN_AIC_GAIN:
            best = criterion
            weights = order_weights
    return weights


def _compute_innovations(filled: Array, observed_mask: Mask, weights: Array) -> Array:
    """Return the innovations u_t (n,) of an autoregression: samples minus their prediction.

    They are u_t = e_t - sum_k a_k e_{t-k}, by eq. (1) of the module docstring. Times at which one
    of these samples is missing are left out.

    Shapes: R runs, T samples.

    Args:
        filled: (R, T) residual of one channel, zero where it is not recorded.
        observed_mask: (R, T) whether a sample is recorded.
        weights: (p,) weights of the autoregression.
    """
    order, length = weights.size, observed_mask.shape[1]
    predicted = np.zeros(1)
    # Whether a sample and all samples that predict it are recorded. The first `order` samples have
    # no complete prediction, and are left out.
    is_complete = observed_mask[:, order:]
    for k, weight in enumerate(weights, start=1):
        lagged_samples = slice(order - k, length - k)
        predicted = predicted + weight * filled[:, lagged_samples]
        is_complete = is_complete & observed_mask[:, lagged_samples]
    innovations: Array = (filled[:, order:] - predicted)[is_complete]
    return innovations


def _solve_yule_walker(covariances: Array, order: int) -> tuple[Array, float]:
    """Solve the Yule-Walker equations for weights (p,) and the variance of the innovations.

    With autocovariances γ (Box & Jenkins, chapter 3):

        Σ_l γ_|k-l| a_l = γ_k,   var u = γ_0 - Σ_k a_k γ_k                                       (3)

    The variance is infinite if the autoregression is not stationary, so that this order is not
    selected.

    Args:
        covariances: (q + 1,) autocovariances γ at lags 0 to q.
        order: order p of the autoregression, at most q.
    """
    power = covariances[0]
    # Order zero is white noise; without power there is no signal.
    if order == 0 or power <= 0:
        return np.zeros(0), float(power)
    numbers = np.arange(order)
    lags = np.abs(numbers[:, None] - numbers)
    lagged_covariances = covariances[1 : order + 1]
    # Left-hand matrix of (3), with a ridge.
    matrix = covariances[lags] + YULE_WALKER_RIDGE * power * np.eye(order)
    weights = np.linalg.solve(matrix, lagged_covariances)
    variance = float(power - weights @ lagged_covariances)
    if variance <= 0 or _compute_max_root(weights) > MAX_ROOT:
        return np.zeros(0), np.inf
    return weights, variance


def _compute_max_root(weights: Array) -> float:
    """Return the largest modulus of the roots of an autoregression with weights (p,).

    The roots solve z^p = sum_k a_k z^(p-k). The impulse response is a sum of their powers, so the
    process is stationary if all of them lie inside the unit circle.
    """
    roots = np.roots(np.concatenate([[1.0], -weights]))
    return float(np.abs(roots).max(initial=0.0))
