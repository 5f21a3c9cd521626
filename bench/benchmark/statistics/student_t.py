"""P-value of Student's t distribution with a whole number of degrees of freedom."""

from __future__ import annotations

from math import atan, cos, pi, sin, sqrt


def student_p_value(size: float, freedom: int) -> float:
    """Return the two-sided p-value of Student's t distribution, to an absolute error of 1e-15.

    It is 1 - A with the probability A that a t variable is between -t and t. With k degrees of
    freedom and a = atan(t / √k), A is a finite series,

    A = sin a (1 + 1/2 cos² a + (1·3)/(2·4) cos⁴ a + ...), up to cos^{k-2} a, for even k, and   (1)
    A = 2/π (a + sin a (cos a + 2/3 cos³ a + ...)), up to cos^{k-2} a, for odd k                (2)

    (M. Abramowitz, I. A. Stegun, Handbook of Mathematical Functions, 1964, equations 26.7.4 and
    26.7.3). It is computed here because importing scipy.special takes 0.1 s.

    Args:
        size: absolute value of the statistic t.
        freedom: degrees of freedom k.
    """
    angle = atan(size / sqrt(freedom))
    is_odd = freedom % 2
    # First term of the series: sin a in (1), sin a cos a in (2). The loop adds one term in each
    # turn, and multiplies it by the ratio to the next one; with k = 1 there is none.
    term = sin(angle) * (cos(angle) if is_odd else 1.0)
    series_sum = 0.0
    for factor in range(1 + is_odd, freedom, 2):
        series_sum += term
        term *= cos(angle) ** 2 * factor / (factor + 1.0)
    central_probability = 2.0 / pi * (angle + series_sum) if is_odd else series_sum  # (2), (1)
    # Rounding could make the difference negative.
    return max(1.0 - central_probability, 0.0)
