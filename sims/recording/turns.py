"""Whole turns of angles that are recorded within one turn."""

from __future__ import annotations

import math

import numpy as np

from sims.base import Array


def unwrapped(positions: Array, command: Array | None = None) -> Array:
    """Restore the whole turns of a wrapped position; NaN stays.

    Args:
        positions: (T,) in rad.
        command: (T,) of the joint's position servo in rad, which tells the turn.
    """
    result = positions.copy()
    finite = np.isfinite(positions)
    result[finite] = np.unwrap(positions[finite])
    if command is not None and finite.any():
        difference = float(np.mean((command - result)[finite]))
        result += 2.0 * math.pi * round(difference / (2.0 * math.pi))
    return result
