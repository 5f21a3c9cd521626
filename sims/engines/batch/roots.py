"""Where within a step something happens."""

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
    bend = (value + h * rate - later) / (h * h)
    turn = np.sqrt(rate * rate + 4.0 * bend * value)
    seconds = np.where(rate < 0, 2.0 * value / (turn - rate), (turn + rate) / (2.0 * bend))
    result: Array = np.where(np.isfinite(seconds), seconds, h)
    return result
