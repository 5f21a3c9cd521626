"""Simulated tuning histories: what a network that sees a whole history is trained on.

Source: X. Zhang, S. Liu et al., Dynamics as Prompts, IEEE RA-L 2025, arXiv 2410.20357, Algorithm 1.
From a source to a target, the next point lies between the nearest points tried on either side:

    (1)  l = max tried below the target, u = min tried above it, in each parameter
    (2)  next = l + r (u - l), r from Beta(a, a)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from methods.base import Array, Practice

_CENTRED = 2.0
"""a of (2), which the paper leaves open; 1 would be uniform."""


def binary_search(simulator: Practice, rng: np.random.Generator, count: int) -> Array:
    """Points (count, dim) of the training range: a target, and a binary search for it by chance."""
    target, source = simulator.sample(rng, 2)
    lower, upper = (corner.copy() for corner in simulator.training)
    points = [target, source]
    while len(points) < count:
        last = points[-1]
        below = last < target
        lower = np.where(below, last, lower)  # (1)
        upper = np.where(below, upper, last)
        share = rng.beta(_CENTRED, _CENTRED, size=last.size)
        points.append(lower + share * (upper - lower))  # (2)
    return np.array(points[:count])


class Histories(NamedTuple):
    """Which simulations of a scenario make a history, by number.

    Attributes:
        targets: (n,) whose parameters are sought.
        tried: (n, window) simulations in the order in which they are looked at.
    """

    targets: NDArray[np.intp]
    tried: NDArray[np.intp]


def shuffled(rng: np.random.Generator, count: int, window: int) -> Histories:
    """Each of `count` simulations as the target once, and others in any order."""
    tried = np.empty((count, window), dtype=np.intp)
    for target in range(count):
        others = rng.permutation(np.delete(np.arange(count), target))
        tried[target] = others[:window]
    return Histories(np.arange(count), tried)


def in_order(count: int, window: int) -> Histories:
    """Every run of `window` simulations of the search for the first one, as published."""
    starts = np.arange(1, count - window + 1)
    return Histories(np.zeros(len(starts), dtype=np.intp), starts[:, None] + np.arange(window))
