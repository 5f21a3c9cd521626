"""A first-order lag, exact over steps of any length."""

from __future__ import annotations

import numpy as np

from sims.base import Array

_SMALLEST = 1e-12  # seconds; a lag this short is none on any step


def response(steps: Array, lag: Array) -> tuple[Array, Array]:
    """What is left of an old value at the end of each step, and in its mean: exp(-h / T) and (1 -
    exp(-h / T)) T / h.

    Args:
        steps: (L, S) lengths h, seconds.
        lag: (L, 1) time constants T, seconds.
    """
    ratio = steps / np.maximum(lag, _SMALLEST)
    mean = np.where(ratio > 0, -np.expm1(-ratio) / np.where(ratio > 0, ratio, 1.0), 1.0)
    return np.exp(-ratio), mean


def recur(decay: Array, gained: Array, start: Array) -> Array:
    """y[k] = decay[k] y[k - 1] + gained[k], (L, S), from y[-1] = start (L, 1)."""
    result, state = np.empty_like(gained), start[:, 0]
    for k in range(gained.shape[1]):
        state = decay[:, k] * state + gained[:, k]
        result[:, k] = state
    return result


def before(values: Array, start: Array) -> Array:
    """(L, S) the value before each step."""
    return np.concatenate([start, values[:, :-1]], axis=1)
