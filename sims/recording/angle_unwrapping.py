"""Unwrap angles that are recorded within one turn."""

from __future__ import annotations

import math

import numpy as np

from sims.core.simulator import Array


def unwrapped(positions: Array, command: Array | None = None) -> Array:
    """Restore the whole turns of a wrapped position; NaN stays NaN.

    Args:
        positions: (T,) positions, rad.
        command: (T,) command of the joint's position servo, rad, which determines the turn; None if
            there is none.

    Returns:
        (T,) positions, rad.
    """
    result = positions.copy()
    finite = np.isfinite(positions)
    result[finite] = np.unwrap(positions[finite])
    if command is not None and finite.any():
        difference = float(np.mean((command - result)[finite]))
        result += 2.0 * math.pi * round(difference / (2.0 * math.pi))
    return result
