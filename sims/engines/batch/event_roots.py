"""Time of an event within a step, by quadratic interpolation.

For a quantity with value p and rate r at the beginning of a step of length h, and value q at its
end, the parabola through these values is

    p(s) = p + r s - b s^2,    b = (p + h r - q) / h^2                     (1)

Its root is computed in the form without cancellation (W. H. Press et al., Numerical Recipes, 3rd
edition, 2007, section 5.6):

    s = (r + w) / (2 b) = 2 p / (w - r),    w = sqrt(r^2 + 4 b p)          (2)
"""

from __future__ import annotations

import numpy as np

from sims.core.simulator import Array


def find_event_time(value: Array, rate: Array, later: Array, h: Array) -> Array:
    """Return the seconds (n,) to the last root of the interpolating parabola.

    The error is of third order in h; it is corrected when the root is reached.

    Args:
        value: (n,) value >= 0 at the beginning.
        rate: (n,) rate at the beginning.
        later: (n,) value < 0 after h seconds.
        h: (n,) step size in seconds.
    """
    bend = (value + h * rate - later) / (h * h)  # (1)
    turn = np.sqrt(rate * rate + 4.0 * bend * value)
    # (2): the form that adds numbers of equal sign is used.
    falling = 2.0 * value / (turn - rate)
    rising = (turn + rate) / (2.0 * bend)
    seconds = np.where(rate < 0, falling, rising)
    # Without a root, which only rounding can cause, the event is at the end of the step.
    result: Array = np.where(np.isfinite(seconds), seconds, h)
    return result
