"""Points that fill a cube more evenly than random ones.

An additive recurrence with the generalised golden ratio g (M. Roberts, The unreasonable
effectiveness of quasirandom sequences, 2018), in d dimensions from the shift s:

    g^(d + 1) = g + 1                                                                            (1)
    x_nk = (s_k + n g^-k) mod 1,   n = 1, 2, ..., k = 1 ... d                                    (2)
"""

from __future__ import annotations

import numpy as np

from methods.base import Array

_PASSES = 60
"""Passes after which the fixed point of (1) is exact: each more than halves the error."""


def spread(count: int, shift: Array) -> Array:
    """(count, d) points of the unit cube.

    Args:
        count: how many.
        shift: (d,) the s of (2).
    """
    dim = len(shift)
    ratio = 2.0
    for _ in range(_PASSES):
        ratio = (1.0 + ratio) ** (1.0 / (dim + 1))  # (1)
    steps = ratio ** -np.arange(1.0, dim + 1)
    numbers = np.arange(1, count + 1)[:, None]
    points: Array = (shift + numbers * steps) % 1.0  # (2)
    return points
