"""A circle through points of an edge of which a part is something else's."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sims.base import Array

Circle = tuple[float, float, float]
"""Middle and radius (u, v, radius), pixels."""
Fitted = tuple[Circle, Array]
"""A circle, and each point's distance to it, > 0 outside."""

_TURNS = 8
_EXACT = 1e-3
_EVERY = 3


def fit(points: Array, start: tuple[float, float, float | None] | None) -> Fitted | None:
    """The circle nearest to most of the points, by Gauss-Newton with Tukey's weights; None where
    there is none.

    The normal equations are solved by hand: numpy's own solver spends its time on the call.

    Args:
        points: (n, 2).
        start: where to begin; the median distance where it has no radius.
    """
    if start is None:
        return None
    u, v, radius = start
    x, y = points[:, 0], points[:, 1]
    rows: Array = np.ones((4, len(points)))
    for _ in range(_TURNS):
        away_u, away_v = x - u, y - v
        far = np.hypot(away_u, away_v)
        if radius is None:
            radius = _middle(far)
        rest = far - radius
        width = 4.7 * max(1.4826 * _middle(np.abs(rest)), 0.15)
        weights = np.maximum(1 - (rest / width) ** 2, 0.0) ** 2
        np.maximum(far, 1e-9, out=far)
        rows[0], rows[1], rows[3] = away_u / far, away_v / far, rest
        (xx, xy, mx, p), (_, yy, my, q), (_, _, total, r), _ = ((rows * weights) @ rows.T).tolist()
        if total <= 0:
            return None
        a, b, c = xx - mx * mx / total, xy - mx * my / total, yy - my * my / total
        if total * (area := a * c - b * b) < 1e-6:
            return None
        p, q = p - mx * r / total, q - my * r / total
        du, dv = (c * p - b * q) / area, (a * q - b * p) / area
        dr = (r - mx * du - my * dv) / total
        u, v, radius = u + du, v + dv, radius + dr
        if abs(du) + abs(dv) + abs(dr) < _EXACT:
            break
    if radius is None or not 0.5 < radius < 1e4:
        return None
    return (u, v, radius), np.hypot(x - u, y - v) - radius


def agreeing(fitted: Fitted) -> NDArray[np.bool_]:
    """Which of the points lie on it."""
    (_, _, radius), rest = fitted
    result: NDArray[np.bool_] = np.abs(rest) < max(0.7, 0.1 * radius)
    return result


def better(one: Fitted | None, other: Fitted | None) -> Fitted | None:
    """The circle on which more of the points lie."""
    if one is None or other is None:
        return one or other
    return other if agreeing(other).sum() > agreeing(one).sum() else one


def through_an_arc(points: Array) -> Circle | None:
    """The circle through half of the points, one after another, on which most of all of them lie.

    What spoils an edge, a shadow or another ball, spoils it on one side. Circles are fitted to arcs
    that begin all around, by linear least squares (I. Kasa, IEEE Trans. Instrum. Meas. 25, 8, 1976,
    doi:10.1109/TIM.1976.6312298).

    Args:
        points: (n, 2), in their order around it.
    """
    count = len(points)
    numbers = (np.arange(0, count, _EVERY)[:, None] + np.arange(count // 2 + 1)) % count
    middle = points.mean(axis=0)
    arcs = points[numbers] - middle
    table = np.concatenate([arcs, np.ones((*numbers.shape, 1))], axis=2)
    turned = table.transpose(0, 2, 1)
    normal = turned @ table
    if (np.abs(np.linalg.det(normal)) < 1e-6).any():
        return None
    doubled_u, doubled_v, rest = np.linalg.solve(normal, turned @ (arcs**2).sum(axis=2)[..., None])[
        ..., 0
    ].T
    u, v = doubled_u / 2, doubled_v / 2
    radius = np.sqrt(np.maximum(rest + u**2 + v**2, 0.0))
    x, y = (points - middle).T
    away = np.hypot(x - u[:, None], y - v[:, None]) - radius[:, None]
    best = int((np.abs(away) < np.maximum(0.35, 0.05 * radius)[:, None]).sum(axis=1).argmax())
    return float(u[best] + middle[0]), float(v[best] + middle[1]), float(radius[best])


def _middle(values: Array) -> float:
    """The median; numpy's own takes ten times as long for a few numbers."""
    k = len(values) // 2
    sorted_there = np.partition(values, (k - 1, k))
    return (
        float(sorted_there[k])
        if len(values) % 2
        else float(0.5 * (sorted_there[k - 1] + sorted_there[k]))
    )
