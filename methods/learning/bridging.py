"""Gaps in what another sensor shows, bridged by what the proposed model does there."""

from __future__ import annotations

import numpy as np

from methods.base import Array

_ROUNDS = 15
_LEAST = 8
"""Samples that must be seen before anything is bridged."""


def bridged(seen: Array, shown: Array) -> Array:
    """Fill the gaps of a sensor's channel from a simulation, through the map from one to the other.

    A camera that stands still shows a motion along a line as (a + b x) / (1 + c x) (Hartley and
    Zisserman, Multiple View Geometry, 2004, chapter 2). The three numbers are fitted to the samples
    that are there, each equation multiplied by its denominator and weighed by Cauchy's weights: a
    model that is not yet right agrees with the sensor only at times.

    Args:
        seen: (T,) the channel, NaN where it shows nothing.
        shown: (T,) what the simulation shows at the same instants, with another sensor.

    Returns:
        (T,) the channel; with its gaps where too little is seen or no such map exists.
    """
    there = np.isfinite(seen)
    if there.all() or there.sum() < _LEAST or not np.ptp(shown[there]) > 0:
        return seen
    x, y = _scaled(shown, shown[there]), _scaled(seen, seen[there])
    table = np.stack([np.ones_like(x), x, -x * y], axis=1)[there]
    weights: Array = np.ones(len(table))
    numbers: Array = np.zeros(3)
    for _ in range(_ROUNDS):
        found = np.linalg.lstsq(table * weights[:, None], y[there] * weights, rcond=None)[0]
        numbers = found.astype(np.float64)
        rest: Array = y[there] - table @ numbers
        weights = 1 / np.sqrt(1 + (rest / max(2.0 * float(np.median(np.abs(rest))), 1e-6)) ** 2)
    below = 1 + numbers[2] * x
    if not (below > 0.1).all():  # the other side of the camera
        return seen
    told = (numbers[0] + numbers[1] * x) / below * float(seen[there].std()) + float(
        seen[there].mean()
    )
    result: Array = np.where(there, seen, told)
    return result


def _scaled(values: Array, some: Array) -> Array:
    spread = float(some.std())
    result: Array = (values - float(some.mean())) / (spread if spread > 0 else 1.0)
    return result
