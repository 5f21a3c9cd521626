"""Validate arrays that a tuner sends."""

from __future__ import annotations

import numpy as np

from methods.tuner import Array


def to_points(proposed: object, dim: int, label: str) -> Array:
    """Convert proposals or recommendations to a new array (n, dim) of any numbers.

    Args:
        proposed: points from the tuner.
        dim: number of parameters.
        label: name of the points, for messages.

    Raises:
        ValueError: the points have another shape.
    """
    # The array is copied, because the tuner may change its own.
    points = np.array(proposed, dtype=np.float64, ndmin=2)
    if points.ndim != 2 or points.shape[1] != dim or not len(points):
        raise ValueError(
            f"the tuner gave {label} of shape {points.shape}; expected (n, {dim}) with n >= 1"
        )
    return points
