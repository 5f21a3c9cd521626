"""Gaps in what another sensor shows, bridged by what the proposed model does there.

A camera that stands still shows a motion x along a line as

    (1)  y = (a + b x) / (1 + c x)

(Hartley and Zisserman, Multiple View Geometry, 2004, chapter 2). Multiplied by the denominator it
is linear in the three numbers:

    (2)  y = a + b x - c x y
"""

from __future__ import annotations

import numpy as np

from methods.base import Array

_ROUNDS = 15
"""Rounds of reweighed least squares."""
_LEAST = 8
"""Samples that must be seen before anything is bridged."""
_OUTLYING = 2.0
"""Median distances from the map beyond which Cauchy's weights take a sample for foreign."""
_FINEST = 1e-6
"""Standard deviations of the channel; agreement that is closer still is as good as exact."""
_BEFORE = 0.1
"""Least denominator of (1); below it the map's pole is near, where the motion meets the camera."""


def bridged(seen: Array, shown: Array) -> Array:
    """Fill the gaps of a sensor's channel from a simulation, through the map from one to the other.

    The three numbers of the map (1) are fitted to the samples that are there, as (2) and with
    Cauchy's weights: a model that is not yet right agrees with the sensor only at times.

    Args:
        seen: (T,) the channel, NaN where it shows nothing.
        shown: (T,) what the simulation shows at the same instants, with another sensor.

    Returns:
        (T,) the channel; with its gaps where too little is seen or no such map exists.
    """
    there = np.isfinite(seen)
    if there.all() or there.sum() < _LEAST:
        return seen
    # a simulation that stands still says nothing of where the sensor would see it
    if not np.ptp(shown[there]) > 0:
        return seen
    # metres and pixels differ by orders of magnitude; scaled, all columns of (2) weigh alike
    x = _scaled(shown, shown[there])
    y = _scaled(seen, seen[there])
    table = np.stack([np.ones_like(x), x, -x * y], axis=1)[there]
    a, b, c = _fitted(table, y[there])
    below = 1 + c * x
    # a sign that changes within the run would put a part of it on the other side of the camera
    if not (below > _BEFORE).all():
        return seen
    mapped = (a + b * x) / below  # (1)
    unscaled = mapped * float(seen[there].std()) + float(seen[there].mean())
    result: Array = np.where(there, seen, unscaled)
    return result


def _fitted(table: Array, values: Array) -> Array:
    """The numbers (3,) of (2), by least squares with Cauchy's weights."""
    weights: Array = np.ones(len(table))
    numbers: Array = np.zeros(3)
    for _ in range(_ROUNDS):
        solution = np.linalg.lstsq(table * weights[:, None], values * weights, rcond=None)[0]
        numbers = solution.astype(np.float64)
        rest: Array = values - table @ numbers
        width = max(_OUTLYING * float(np.median(np.abs(rest))), _FINEST)
        # the root of Cauchy's weight, since it multiplies both sides of (2)
        weights = 1 / np.sqrt(1 + (rest / width) ** 2)
    return numbers


def _scaled(values: Array, some: Array) -> Array:
    """Values in standard deviations from the mean, both of `some` of them."""
    spread = float(some.std())
    divisor = spread if spread > 0 else 1.0
    result: Array = (values - float(some.mean())) / divisor
    return result
