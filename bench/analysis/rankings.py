"""Whether two conditions rank the same tuners alike: mean ranks over paired targets, and Kendall's
tau between them.

Sources: M. G. Kendall, Biometrika 30, 81, 1938, doi:10.1093/biomet/30.1-2.81 (tau-b of scipy); the
percentile bootstrap of B. Efron, R. Tibshirani, An Introduction to the Bootstrap, 1993, ch. 13; the
exchange of paired conditions of P. Good, Permutation, Parametric, and Bootstrap Tests of
Hypotheses, 2005, ch. 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.problem.seeds import rng_for
from sims.base import Array

RESAMPLES = 500
"""Of the targets, for an interval."""
EXCHANGES = 9999
"""Of conditions at random, for a p-value."""
SPLITS = 200
"""Of the targets in halves, for the agreement that one condition has with itself."""


@dataclass(frozen=True)
class Agreement:
    """How alike two conditions rank.

    Attributes:
        tau: Kendall's tau-b between the mean ranks; 1 is the same order, -1 the reverse.
        low: of its 95 % bootstrap interval over targets, made to hold `tau`.
        high: of it.
        halves: mean tau between halves of the targets in the first condition: what tau two rankings
            reach that differ by their targets alone.
        p_value: that mean ranks come to differ as much where the conditions are exchanged at
            random, target by target.
    """

    tau: float
    low: float
    high: float
    halves: float
    p_value: float


def mean_ranks(errors: Array) -> Array:
    """(tuners,) mean over targets of each tuner's rank, 1 best, of errors (targets, tuners).

    A target without an error, for which a tuner has NaN or infinity, ranks that tuner last.
    """
    means: Array = _ranks(errors).mean(axis=0)
    return means


def _ranks(errors: Array) -> Array:
    """(targets, tuners) ranks within each target; equal errors share one."""
    from scipy.stats import rankdata

    # Rounded as logarithms, so that errors that differ by the last bit share a rank.
    logs = np.log(np.maximum(np.where(np.isfinite(errors), errors, np.inf), 1e-12))
    ranks: Array = rankdata(np.round(logs, 9), axis=1)
    return ranks


def tau(first: Array, second: Array) -> float:
    """Kendall's tau-b of two lists of numbers; NaN where one of them is constant.

    With C and D the pairs in the same and in opposite order, T1 and T2 those that the first or the
    second ties,

        tau = (C - D) / sqrt((C + D + T1) (C + D + T2))                        (1)
    """
    from scipy.stats import kendalltau

    return float(kendalltau(np.round(first, 9), np.round(second, 9)).statistic)


def agreement(first: Array, second: Array, *names: str) -> Agreement:
    """How alike two conditions rank tuners on the same targets.

    Args:
        first: errors (targets, tuners) in one condition.
        second: the same targets and tuners in the other.
        names: of what is compared, for the random stream.
    """
    rng = rng_for("agreement", *names)
    ranks = np.stack([_ranks(first), _ranks(second)])  # (2, targets, tuners)
    count = ranks.shape[1]
    observed = tau(*ranks.mean(axis=1))
    drawn = rng.integers(count, size=(RESAMPLES, count))
    boot = [tau(*ranks[:, rows].mean(axis=1)) for rows in drawn]
    low, high = np.nanquantile(boot, [0.025, 0.975]) if count > 1 else (np.nan, np.nan)
    # Targets drawn twice make ranks noisier, and tau of noisier ranks is nearer to none.
    low, high = min(low, observed), max(high, observed)
    p = _exchanged(ranks[1] - ranks[0], rng)
    return Agreement(observed, float(low), float(high), _halves(ranks[0], rng), p)


def _exchanged(changes: Array, rng: np.random.Generator) -> float:
    """p-value of changes of rank (targets, tuners), that no tuner's mean rank changes.

    The statistic is the sum over tuners of the squared mean change; to exchange a target's
    conditions turns the signs of its changes. Tau itself would not do: mean ranks that were all
    turned round stay so, smaller, whatever is exchanged.
    """
    signs = rng.choice([-1.0, 1.0], size=(EXCHANGES, len(changes)))
    sums = ((signs @ changes) ** 2).sum(axis=1)
    observed = (changes.sum(axis=0) ** 2).sum()
    # What was observed is one of the exchanges: so p is never below 1 / (n + 1).
    return float((1 + (sums >= observed * (1 - 1e-12)).sum()) / (1 + EXCHANGES))


def _halves(ranks: Array, rng: np.random.Generator) -> float:
    """Mean tau between random halves of the targets, of ranks (targets, tuners)."""
    half = len(ranks) // 2
    if not half:
        return float("nan")
    taus = []
    for _ in range(SPLITS):
        order = rng.permutation(len(ranks))
        taus.append(tau(ranks[order[:half]].mean(axis=0), ranks[order[half:]].mean(axis=0)))
    return float(np.nanmean(taus))
