"""Tail and quantiles of the chi-squared distribution with a whole number of degrees of freedom."""

from __future__ import annotations

from functools import lru_cache
from math import erfc, exp, fsum, inf, lgamma, log, sqrt


def chi_squared_tail(freedom: int, statistic: float) -> float:
    """Return the probability that a chi-squared variable exceeds a statistic, its p-value.

    Q(x | k) = Σ_{i=0}^{k/2-1} e^{-h} h^i / i! for even k, and                              (1)
    Q(x | k) = erfc(√h) + Σ_{i=1}^{(k-1)/2} e^{-h} h^{i-1/2} / Γ(i + 1/2) for odd k,        (2)

    with h = x / 2 (M. Abramowitz, I. A. Stegun, Handbook of Mathematical Functions, 1964,
    equations 26.4.4 and 26.4.5). All terms are positive, so nothing cancels: the relative error is
    below 1e-12 for up to some thousand degrees of freedom. `scipy.special.chdtrc` gives the same,
    but importing it takes as long as a quarter of a small diagnosis.

    Args:
        freedom: degrees of freedom k, at least 1.
        statistic: x.

    Raises:
        ValueError: `freedom` is below 1.
    """
    if freedom < 1:
        raise ValueError(f"expected at least 1 degree of freedom, found {freedom}")
    if statistic != statistic:  # NaN
        return statistic
    if statistic <= 0.0:
        return 1.0
    if statistic == inf:
        return 0.0
    h = statistic / 2.0
    # The exponents of h are i for even k, and i - 1/2 for odd k.
    half_remainder = (freedom % 2) / 2.0
    # Terms of (1) or (2), as exponentials of sums of logarithms, since e^{-h} alone is 0 where h is
    # above 745.
    terms = [
        exp((i - half_remainder) * log(h) - lgamma(i - half_remainder + 1.0) - h)
        # From 0 to k/2 - 1 for even k, and from 1 to (k-1)/2 for odd k.
        for i in range(1 if half_remainder else 0, (freedom + 1) // 2)
    ]
    return min(1.0, fsum([erfc(sqrt(h)) if half_remainder else 0.0, *terms]))


@lru_cache(maxsize=1024)
def chi_squared_quantile(freedom: int, tail: float) -> float:
    """Return the statistic that a chi-squared variable exceeds with a given probability.

    It is the inverse of `chi_squared_tail`, by bisection to the last digits of a float.

    Args:
        freedom: degrees of freedom, at least 1.
        tail: probability, above 0 and at most 1.

    Raises:
        ValueError: `freedom` is below 1, or `tail` is not a probability above 0.
    """
    if not 0.0 < tail <= 1.0:
        raise ValueError(f"expected a probability above 0 and at most 1, found {tail}")
    low, high = 0.0, float(max(freedom, 1))
    # The tail falls with the statistic: double the upper bound until the quantile is below it.
    while chi_squared_tail(freedom, high) > tail:
        low, high = high, 2.0 * high
    # The loop ends when no float is left between both bounds.
    while low < (middle := (low + high) / 2.0) < high:
        if chi_squared_tail(freedom, middle) > tail:
            low = middle
        else:
            high = middle
    return high
