"""Agreement of tuner rankings under two conditions: mean ranks and Kendall's tau.

Sources: M. G. Kendall, Biometrika 30, 81, 1938, doi:10.1093/biomet/30.1-2.81 (tau-b of scipy); the
percentile bootstrap of B. Efron, R. Tibshirani, An Introduction to the Bootstrap, 1993, ch. 13; the
permutation test for paired conditions of P. Good, Permutation, Parametric, and Bootstrap Tests of
Hypotheses, 2005, ch. 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.core.random_streams import make_rng
from sims.core.simulator import Array

BOOTSTRAP_RESAMPLES = 500
"""Number of bootstrap resamples of the targets for an interval."""
PERMUTATION_COUNT = 9999
"""Number of random permutations of the conditions for a p-value."""
HALF_SPLIT_COUNT = 200
"""Number of random splits of the targets into halves, for the agreement of one condition."""


@dataclass(frozen=True)
class RankAgreement:
    """Agreement of two rankings.

    Attributes:
        tau: Kendall's tau-b between the mean ranks; 1 is the same order, -1 the reverse.
        low: lower bound of its 95 % bootstrap interval over targets, extended to contain
            `compute_kendall_tau`.
        high: upper bound of this interval.
        halves: mean tau between halves of the targets in the first condition; the value that is
            reached by two rankings which differ in their targets only.
        p_value: p-value of the permutation test that exchanges the conditions of each target at
            random; the null hypothesis is that no tuner's mean rank changes.
    """

    tau: float
    low: float
    high: float
    halves: float
    p_value: float


def compute_mean_ranks(errors: Array) -> Array:
    """Compute each tuner's mean rank (tuners,) over targets from errors (targets, tuners).

    Rank 1 is best. A tuner whose error is NaN or infinite has the last rank on that target.
    """
    mean_ranks: Array = _rank_within_targets(errors).mean(axis=0)
    return mean_ranks


def _rank_within_targets(errors: Array) -> Array:
    """Compute ranks (targets, tuners) within each target; equal errors share one."""
    from scipy.stats import rankdata

    # Rounded logarithms give errors that differ by the last bit the same rank.
    logs = np.log(np.maximum(np.where(np.isfinite(errors), errors, np.inf), 1e-12))
    ranks: Array = rankdata(np.round(logs, 9), axis=1)
    return ranks


def compute_kendall_tau(first: Array, second: Array) -> float:
    """Compute Kendall's tau-b of two lists of numbers; NaN if one of them is constant.

    With C and D the numbers of pairs in the same and in opposite order, T1 and T2 the numbers of
    pairs that are tied in the first or in the second list only,

        tau = (C - D) / sqrt((C + D + T1) (C + D + T2))                        (1)

    Args:
        first: (n,) numbers.
        second: (n,) numbers in the same order.
    """
    from scipy.stats import kendalltau

    return float(kendalltau(np.round(first, 9), np.round(second, 9)).statistic)


def compute_rank_agreement(first: Array, second: Array, *names: str) -> RankAgreement:
    """Compare the rankings of the same tuners on the same targets under two conditions.

    Args:
        first: (targets, tuners) errors in the first condition.
        second: (targets, tuners) errors in the second condition.
        names: names of the comparison, which determine the random stream.
    """
    rng = make_rng("agreement", *names)
    ranks = np.stack(
        [_rank_within_targets(first), _rank_within_targets(second)]
    )  # (2, targets, tuners)
    count = ranks.shape[1]
    observed = compute_kendall_tau(*ranks.mean(axis=1))
    resamples = rng.integers(count, size=(BOOTSTRAP_RESAMPLES, count))
    resampled_taus = [compute_kendall_tau(*ranks[:, rows].mean(axis=1)) for rows in resamples]
    low, high = np.nanquantile(resampled_taus, [0.025, 0.975]) if count > 1 else (np.nan, np.nan)
    # Targets that are drawn twice make ranks noisier, and noise moves tau towards 0.
    low, high = min(low, observed), max(high, observed)
    p = _compute_permutation_p_value(ranks[1] - ranks[0], rng)
    return RankAgreement(
        observed, float(low), float(high), _compute_mean_split_half_tau(ranks[0], rng), p
    )


def _compute_permutation_p_value(changes: Array, rng: np.random.Generator) -> float:
    """Compute the permutation p-value for changes of rank (targets, tuners).

    The null hypothesis is that no tuner's mean rank changes. The statistic is the sum over tuners
    of the squared mean change. Exchanging the conditions of a target changes the signs of its rank
    changes. Tau itself is not a suitable statistic: mean ranks that are all reversed stay reversed,
    only less so, under any exchange.
    """
    signs = rng.choice([-1.0, 1.0], size=(PERMUTATION_COUNT, len(changes)))
    sums = ((signs @ changes) ** 2).sum(axis=1)
    observed = (changes.sum(axis=0) ** 2).sum()
    # The observed statistic is one of the permutations, so p is at least 1 / (n + 1).
    return float((1 + (sums >= observed * (1 - 1e-12)).sum()) / (1 + PERMUTATION_COUNT))


def _compute_mean_split_half_tau(ranks: Array, rng: np.random.Generator) -> float:
    """Compute the mean Kendall tau between the rankings on two random halves of the targets.

    It says how well a ranking of tuners repeats on other targets: 1 is the same order, 0 a random
    one. `ranks` (targets, tuners) are the ranks on each target. NaN with fewer than two targets.
    """
    half_count = len(ranks) // 2
    if not half_count:
        return float("nan")
    taus = []
    for _ in range(HALF_SPLIT_COUNT):
        order = rng.permutation(len(ranks))
        taus.append(
            compute_kendall_tau(
                ranks[order[:half_count]].mean(axis=0), ranks[order[half_count:]].mean(axis=0)
            )
        )
    return float(np.nanmean(taus))
