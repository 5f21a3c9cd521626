"""A circle through points of an edge of which a part is something else's.

With d a point's distance from the middle (u, v), R the radius and n = (x - u, y - v) / d:

    (1)  rest = d - R
    (2)  Gauss-Newton: rest = n . (du, dv) + dR, by weighed least squares
    (3)  Tukey's weights: (1 - (rest / width)^2)^2, zero beyond the width

and for a start Kasa's linear fit, with doubled middle (2 u, 2 v):

    (4)  x^2 + y^2 = 2 u x + 2 v y + (R^2 - u^2 - v^2)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sims.base import Array

Circle = tuple[float, float, float]
"""Middle and radius (u, v, radius), pixels."""
Fitted = tuple[Circle, Array]
"""A circle, and each point's distance to it, > 0 outside."""

_TURNS = 8
"""Steps of Gauss-Newton at most."""
_EXACT = 1e-3
"""Pixels; a step as short as this is the last."""
_EVERY = 3
"""Points from the beginning of one arc to that of the next."""
_TUKEY = 4.7
"""Width of Tukey's weights in standard deviations, for 95 % efficiency on normal errors."""
_NORMAL = 1.4826
"""Standard deviations of a normal distribution in its median distance from zero."""
_FINEST = 0.15
"""Pixels; edges are not found better than that, so that good ones are not thinned out."""
_SINGULAR = 1e-6
"""Determinants below this belong to points that do not fix a circle."""
_LEAST_RADIUS = 0.5
"""Pixels."""
_MOST_RADIUS = 1e4
"""Pixels; beyond it the points lie on a straight line."""


def fit(points: Array, start: tuple[float, float, float | None] | None) -> Fitted | None:
    """The circle nearest to most of the points, by Gauss-Newton with Tukey's weights; None where
    there is none.

    The normal equations of (2) are solved by hand: numpy's own solver spends its time on the call.

    Args:
        points: (n, 2).
        start: where to begin; the median distance where it has no radius.
    """
    if start is None:
        return None
    u, v, radius = start
    x = points[:, 0]
    y = points[:, 1]
    # columns of (2): the two of n, one for dR, which stays 1, and the rest
    count = len(points)
    rows: Array = np.ones((4, count))
    for _ in range(_TURNS):
        away_u = x - u
        away_v = y - v
        far = np.hypot(away_u, away_v)
        if radius is None:
            radius = _middle(far)
        rest = far - radius  # (1)
        width = _TUKEY * max(_NORMAL * _middle(np.abs(rest)), _FINEST)
        weights = np.maximum(1 - (rest / width) ** 2, 0.0) ** 2  # (3)
        np.maximum(far, 1e-9, out=far)
        rows[0] = away_u / far
        rows[1] = away_v / far
        rows[3] = rest
        step = _step((rows * weights) @ rows.T)
        if step is None:
            return None
        du, dv, dr = step
        u += du
        v += dv
        radius += dr
        if abs(du) + abs(dv) + abs(dr) < _EXACT:
            break
    if radius is None or not _LEAST_RADIUS < radius < _MOST_RADIUS:
        return None
    return (u, v, radius), np.hypot(x - u, y - v) - radius


def _step(normal: Array) -> tuple[float, float, float] | None:
    """(du, dv, dR) of (2) from its weighed products (4, 4); None where they fix none."""
    (xx, xy, mx, p), (_, yy, my, q), (_, _, total, r), _ = normal.tolist()
    if total <= 0:
        return None
    # dR is eliminated first (Schur's complement); two equations in du and dv are left
    a = xx - mx * mx / total
    b = xy - mx * my / total
    c = yy - my * my / total
    area = a * c - b * b
    if total * area < _SINGULAR:
        return None
    p = p - mx * r / total
    q = q - my * r / total
    du = (c * p - b * q) / area
    dv = (a * q - b * p) / area
    dr = (r - mx * du - my * dv) / total
    return du, dv, dr


def agreeing(fitted: Fitted) -> NDArray[np.bool_]:
    """Which of the points lie on it."""
    (_, _, radius), rest = fitted
    tolerance = max(0.7, 0.1 * radius)
    result: NDArray[np.bool_] = np.abs(rest) < tolerance
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
    begins = np.arange(0, count, _EVERY)
    along = np.arange(count // 2 + 1)
    numbers = (begins[:, None] + along) % count
    # from their mean, since the squares in (4) lose digits far from the origin
    middle = points.mean(axis=0)
    arcs = points[numbers] - middle
    table = np.concatenate([arcs, np.ones((*numbers.shape, 1))], axis=2)
    turned = table.transpose(0, 2, 1)
    normal = turned @ table
    if (np.abs(np.linalg.det(normal)) < _SINGULAR).any():
        return None
    squares = (arcs**2).sum(axis=2)[..., None]
    solution = np.linalg.solve(normal, turned @ squares)  # (4)
    doubled_u, doubled_v, rest = solution[..., 0].T
    u = doubled_u / 2
    v = doubled_v / 2
    radius = np.sqrt(np.maximum(rest + u**2 + v**2, 0.0))
    x, y = (points - middle).T
    far = np.hypot(x - u[:, None], y - v[:, None])
    away = far - radius[:, None]
    # twice as strict as `agreeing`: points graze the circle of a wrong arc
    tolerance = np.maximum(0.35, 0.05 * radius)
    agree = np.abs(away) < tolerance[:, None]
    best = int(agree.sum(axis=1).argmax())
    return (
        float(u[best] + middle[0]),
        float(v[best] + middle[1]),
        float(radius[best]),
    )


def _middle(values: Array) -> float:
    """The median; numpy's own takes ten times as long for a few numbers."""
    k = len(values) // 2
    sorted_there = np.partition(values, (k - 1, k))
    if len(values) % 2:
        return float(sorted_there[k])
    return float(0.5 * (sorted_there[k - 1] + sorted_there[k]))
