"""Simulated tuning histories as training data of networks that read a whole history.

Source: X. Zhang, S. Liu et al., Dynamics as Prompts, IEEE RA-L 2025, arXiv 2410.20357, Algorithm 1.
From a source to a target, the next point lies between the nearest points tried on either side:

    (1)  l = max tried below the target, u = min tried above it, in each parameter
    (2)  next = l + r (u - l), r from Beta(a, a)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from methods.tuner import Array, TrainingSimulator

_BETA_PARAMETER = 2.0
"""Parameter a of (2), which the paper does not state; 1 would be a uniform distribution."""


def draw_binary_search(simulator: TrainingSimulator, rng: np.random.Generator, count: int) -> Array:
    """Draw a target and a random binary search for it, in the training range.

    Args:
        simulator: training simulator.
        rng: random generator.
        count: number of points, including the target.

    Returns:
        (count, dim) points; the first one is the target.
    """
    target, start = simulator.sample(rng, 2)
    lower, upper = (corner.copy() for corner in simulator.training)
    points = [target, start]
    while len(points) < count:
        last = points[-1]
        is_below = last < target
        lower = np.where(is_below, last, lower)  # (1)
        upper = np.where(is_below, upper, last)
        share = rng.beta(_BETA_PARAMETER, _BETA_PARAMETER, size=last.size)
        points.append(lower + share * (upper - lower))  # (2)
    return np.array(points[:count])


class HistoryIndices(NamedTuple):
    """Indices of the simulations of a scenario that form histories.

    Attributes:
        targets: (n,) indices of the targets.
        tried: (n, window) indices of the tried simulations, in their order.
    """

    targets: NDArray[np.intp]
    tried: NDArray[np.intp]


def make_shuffled_histories(rng: np.random.Generator, count: int, window: int) -> HistoryIndices:
    """Make one history for each simulation as target, with other simulations in random order.

    Args:
        rng: random generator.
        count: number of simulations.
        window: length of a history.
    """
    histories = np.empty((count, window), dtype=np.intp)
    for target in range(count):
        other_simulations = rng.permutation(np.delete(np.arange(count), target))
        histories[target] = other_simulations[:window]
    return HistoryIndices(np.arange(count), histories)


def make_ordered_histories(count: int, window: int) -> HistoryIndices:
    """Make histories of `window` successive simulations for the first one as target, as published.

    Args:
        count: number of simulations.
        window: length of a history.
    """
    first_indices = np.arange(1, count - window + 1)
    return HistoryIndices(
        np.zeros(len(first_indices), dtype=np.intp), first_indices[:, None] + np.arange(window)
    )
