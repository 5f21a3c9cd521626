"""Quasi-random points, which cover a space of parameters more evenly than random ones.

An additive recurrence with the generalised golden ratio g (M. Roberts, The unreasonable
effectiveness of quasirandom sequences, 2018), in d dimensions from the shift s:

    g^(d + 1) = g + 1                                                                            (1)
    x_nk = (s_k + n g^-k) mod 1,   n = 1, 2, ..., k = 1 ... d                                    (2)

Scrambled Sobol points come from scipy.
"""

from __future__ import annotations

import warnings

import numpy as np

from methods.tuner import Array

_FIXED_POINT_ITERATIONS = 60
"""Number of fixed-point iterations for (1); each one more than halves the error."""


def generate_quasi_random_points(count: int, shift: Array) -> Array:
    """Return quasi-random points of the unit cube by the additive recurrence (2).

    Point n is (s + n g^-k) mod 1 in dimension k, with the generalised golden ratio g, the solution
    of g^(d + 1) = g + 1 (1) in d dimensions. They fill the cube more evenly than random points. A
    random shift gives another set of points.

    Args:
        count: number of points.
        shift: (d,) shift s of (2), in the unit cube.

    Returns:
        (count, d) points.
    """
    dim = len(shift)
    ratio = 2.0
    for _ in range(_FIXED_POINT_ITERATIONS):
        ratio = (1.0 + ratio) ** (1.0 / (dim + 1))  # (1), solved for the power
    steps = ratio ** -np.arange(1.0, dim + 1)
    numbers = np.arange(1, count + 1)[:, None]
    points: Array = (shift + numbers * steps) % 1.0  # (2)
    return points


def draw_sobol_points(rng: np.random.Generator, n: int, dim: int) -> Array:
    """Draw scrambled Sobol points, which are evenly spread in the unit cube.

    Args:
        rng: random generator of the scrambling.
        n: number of points; it need not be a power of two.
        dim: number of dimensions.

    Returns:
        (n, dim) points.
    """
    from scipy.stats import qmc

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # scipy warns unless n is a power of two
        points: Array = qmc.Sobol(dim, seed=rng).random(n)
    return points
