"""A first-order lag, exact over steps of any length.

The lagged signal y of s obeys (1) T dy/dt = s - y. Over a step of length h from y0:

* (2) s constant: y(h) = s + (y0 - s) exp(-h / T)
* (3) s constant, y's mean over the step: s + (y0 - s) m, with m = (1 - exp(-h / T)) T / h
* (4) s linear, from s0 to s1: y(h) = exp(-h / T) y0 + s1 - exp(-h / T) s0 - m (s1 - s0)

Each is the solution of (1) with that s.
"""

from __future__ import annotations

import numpy as np

from sims.base import Array

_SMALLEST = 1e-12
"""Seconds; a lag this short is none on any step."""


def response(steps: Array, lag: Array) -> tuple[Array, Array]:
    """What is left of an old value at the end of each step, exp(-h / T), and in its mean, m of (3).

    Args:
        steps: (L, S) lengths h, seconds.
        lag: (L, 1) time constants T, seconds.

    Returns:
        Both (L, S).
    """
    ratio = steps / np.maximum(lag, _SMALLEST)
    # a step of no length, where a lane waits, keeps the old value: the limit of m is 1
    divisor = np.where(ratio > 0, ratio, 1.0)
    # expm1, since 1 - exp cancels where steps are short beside the lag
    mean = np.where(ratio > 0, -np.expm1(-ratio) / divisor, 1.0)
    return np.exp(-ratio), mean


def recur(decay: Array, gained: Array, start: Array) -> Array:
    """y[k] = decay[k] y[k - 1] + gained[k], (L, S), from y[-1] = start (L, 1)."""
    # rows lie together in memory, and what was gained becomes the result
    result = np.ascontiguousarray(gained.T)
    kept = np.ascontiguousarray(decay.T)
    state: Array = start[:, 0]
    # step by step: a closed form would divide by products of decays, which underflow
    for row, share in zip(result, kept, strict=True):
        row += share * state
        state = row
    return result.T


def before(values: Array, start: Array) -> Array:
    """(L, S) the value before each step."""
    return np.concatenate([start, values[:, :-1]], axis=1)
