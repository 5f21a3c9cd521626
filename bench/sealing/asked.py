"""What a tuner asks for, as arrays."""

from __future__ import annotations

import numpy as np

from methods.base import Array


def as_points(asked: object, dim: int, what: str) -> Array:
    """Proposals or recommendations as a fresh array (n, dim), whatever their numbers are.

    Raises:
        ValueError: they have another shape.
    """
    # A copy: the tuner may go on using its own.
    points = np.array(asked, dtype=np.float64, ndmin=2)
    if points.ndim != 2 or points.shape[1] != dim or not len(points):
        raise ValueError(
            f"the tuner gave {what} of shape {points.shape}; expected (n, {dim}) with n >= 1"
        )
    return points
