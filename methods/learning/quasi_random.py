"""Quasi-random points that fill a cube more evenly than random ones.

An additive recurrence with the generalised golden ratio g (M. Roberts, The unreasonable
effectiveness of quasirandom sequences, 2018), in d dimensions from the shift s:

    g^(d + 1) = g + 1                                                                            (1)
    x_nk = (s_k + n g^-k) mod 1,   n = 1, 2, ..., k = 1 ... d                                    (2)
"""

from __future__ import annotations

import numpy as np

from methods.tuner import Array

_FIXED_POINT_ITERATIONS = 60
"""Number of fixed-point iterations for (1); each one more than halves the error."""


def generate_quasi_random_points(count: int, shift: Array) -> Array:
    """Return quasi-random points of the unit cube by the additive recurrence (2).

    Point n is (s + n g^-k) mod 1 in dimension k, with the generalised golden ratio g. They fill the
    cube more evenly than random points. A random shift gives another set of points.

    Args:
        count: number of points.
        shift: (d,) shift s of (2), in the unit cube.

    Returns:
        (count, d) points.
    """
    dim = len(shift)
    ratio = 2.0
    for _ in range(_FIXED_POINT_ITERATIONS):
        ratio = (1.0 + ratio) ** (1.0 / (dim + 1))  # (1)
    steps = ratio ** -np.arange(1.0, dim + 1)
    numbers = np.arange(1, count + 1)[:, None]
    points: Array = (shift + numbers * steps) % 1.0  # (2)
    return points
