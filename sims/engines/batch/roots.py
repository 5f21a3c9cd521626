"""Where within a step something happens.

A quantity of which the value p and the rate r are known at the beginning of a step of length h, and
the value q at its end, is taken for the parabola through them:

    p(s) = p + r s - b s^2,    b = (p + h r - q) / h^2                     (1)

Its root is written in the form that loses no digits (W. H. Press et al., Numerical Recipes, 3rd
edition, 2007, section 5.6):

    s = (r + w) / (2 b) = 2 p / (w - r),    w = sqrt(r^2 + 4 b p)          (2)
"""

from __future__ import annotations

import numpy as np

from sims.base import Array


def root(value: Array, rate: Array, later: Array, h: Array) -> Array:
    """(n,) seconds to the last root of the parabola through `value` >= 0, with `rate`, and through
    `later` < 0.

    The error is of third order in h; what it leaves is corrected when the root is reached.

    Args:
        value: (n,) at the beginning.
        rate: (n,) its rate there.
        later: (n,) the value h seconds later.
        h: (n,) seconds.
    """
    bend = (value + h * rate - later) / (h * h)  # (1)
    turn = np.sqrt(rate * rate + 4.0 * bend * value)
    # (2): of its two forms the one that adds what has the same sign.
    falling = 2.0 * value / (turn - rate)
    rising = (turn + rate) / (2.0 * bend)
    seconds = np.where(rate < 0, falling, rising)
    # A parabola without a root can only be rounding: the event is at the end of the step.
    result: Array = np.where(np.isfinite(seconds), seconds, h)
    return result
