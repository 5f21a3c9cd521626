"""Confidence interval of a proportion."""

from __future__ import annotations

from typing import Literal


def compute_proportion_interval(
    hits: int, trials: int, method: Literal["wilson", "exact"] = "wilson"
) -> tuple[float, float]:
    """Compute the 95 % interval of a proportion.

    Args:
        hits: number of successes.
        trials: number of trials.
        method: ``wilson`` for the score interval (E. B. Wilson, J. Am. Stat. Assoc. 22, 209, 1927,
            doi:10.2307/2276774), ``exact`` for that of Clopper and Pearson.

    Returns:
        Lower and upper bound; NaN without trials.
    """
    from scipy.stats import binomtest

    if trials < 1:
        return float("nan"), float("nan")
    interval = binomtest(hits, trials).proportion_ci(0.95, method=method)
    return float(interval.low), float(interval.high)
