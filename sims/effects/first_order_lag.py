"""First-order lag filter, exact over steps of any length.

The lagged signal y of s obeys (1) T dy/dt = s - y. Over a step of length h from y0:

* (2) s constant: y(h) = s + (y0 - s) exp(-h / T)
* (3) s constant, y's mean over the step: s + (y0 - s) m, with m = (1 - exp(-h / T)) T / h
* (4) s linear, from s0 to s1: y(h) = exp(-h / T) y0 + s1 - exp(-h / T) s0 - m (s1 - s0)

Each is the solution of (1) with that s.
"""

from __future__ import annotations

import numpy as np

from sims.core.simulator import Array

_MIN_TIME_CONSTANT = 1e-12
"""Smallest time constant in seconds; such a lag has no effect on any step."""


def compute_lag_response(steps: Array, lag: Array) -> tuple[Array, Array]:
    """Return the remaining weight of an old value at the end of each step and in its mean.

    They are exp(-h / T) at the end, and its mean m over the step (3).

    Args:
        steps: (L, S) lengths h in seconds.
        lag: (L, 1) time constants T in seconds.

    Returns:
        Both weights (L, S).
    """
    ratio = steps / np.maximum(lag, _MIN_TIME_CONSTANT)
    # a step of zero length, where an element waits, keeps the old value: the limit of m is 1
    divisor = np.where(ratio > 0, ratio, 1.0)
    # expm1, since 1 - exp has cancellation if steps are much shorter than the lag
    mean = np.where(ratio > 0, -np.expm1(-ratio) / divisor, 1.0)
    return np.exp(-ratio), mean


def apply_recursion(decay: Array, additions: Array, start: Array) -> Array:
    """Return the recursion y[k] = decay[k] y[k - 1] + gained[k].

    Args:
        decay: (L, S) factors.
        additions: (L, S) additions.
        start: (L, 1) value y[-1].

    Returns:
        Values y (L, S).
    """
    # rows are contiguous in memory, and the additions become the result
    result = np.ascontiguousarray(additions.T)
    decay_rows = np.ascontiguousarray(decay.T)
    state: Array = start[:, 0]
    # step by step: a closed form would divide by products of decays, which underflow
    for row, factor in zip(result, decay_rows, strict=True):
        row += factor * state
        state = row
    return result.T


def shift_by_one_step(values: Array, start: Array) -> Array:
    """Return the value (L, S) before each step.

    Args:
        values: (L, S) values at the end of each step.
        start: (L, 1) value before the first step.
    """
    return np.concatenate([start, values[:, :-1]], axis=1)
