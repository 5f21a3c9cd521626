"""Robust circle fit to points of an edge, some of which belong to other objects.

With d a point's distance from the centre (u, v), R the radius and n = (x - u, y - v) / d:

    (1)  rest = d - R
    (2)  Gauss-Newton: rest = n . (du, dv) + dR, by weighted least squares
    (3)  Tukey's weights: (1 - (rest / width)^2)^2, zero beyond the width

and for the initial circle Kasa's linear fit, with doubled centre (2 u, 2 v):

    (4)  x^2 + y^2 = 2 u x + 2 v y + (R^2 - u^2 - v^2)

For a known radius, dR in (2) is zero, and the weights are those of Geman and McClure,

    (5)  1 / (1 + (rest / width)^2)^2
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sims.core.medians import compute_median
from sims.core.noise_estimation import SIGMA_PER_MEDIAN
from sims.core.simulator import Array

Circle = tuple[float, float, float]
"""Centre and radius (u, v, radius), pixels."""
CircleFit = tuple[Circle, Array]
"""Circle, and each point's distance to it, > 0 outside."""

_MAX_ITERATIONS = 8
"""Maximum number of Gauss-Newton steps for centre and radius."""
_MAX_CENTRE_ITERATIONS = 12
"""Maximum number of Gauss-Newton steps for the centre alone."""
_CONVERGED_STEP_PIXELS = 1e-3
"""Length of a step, in pixels, below which the iteration ends."""
_ARC_STRIDE = 3
"""Number of points between the beginnings of consecutive arcs."""
_TUKEY_WIDTH = 4.7
"""Width of Tukey's weights in standard deviations, for 95 % efficiency with normal errors."""
_GEMAN_MCCLURE_WIDTH = 0.5
"""Width of the weights (5) in pixels, with which a centre is fitted for a known radius."""
_MIN_EDGE_NOISE = 0.15
"""Lower limit of the estimated edge noise in pixels, so that good points are not rejected."""
_MIN_DETERMINANT = 1e-6
"""Determinant below which the points do not determine a circle or its centre."""
_MIN_RADIUS = 0.5
"""Minimum radius, pixels."""
_MAX_RADIUS = 1e4
"""Maximum radius in pixels; with a larger one, the points are on a straight line."""
_INLIER_PIXELS = 0.7
"""Distance in pixels up to which a point is on a small circle."""
_INLIER_SHARE = 0.1
"""Distance up to which a point is on a large circle, as a share of its radius."""


def fit_circle(points: Array, start: tuple[float, float, float | None] | None) -> CircleFit | None:
    """Fit a circle to most of the points by Gauss-Newton with Tukey's weights.

    (1) With the distance d of a point from the centre (u, v), the residual is d - R.
    (2) Each iteration solves residual = n . (du, dv) + dR by weighted least squares, with the
        direction n from the centre to the point.
    (3) The weights are Tukey's, (1 - (residual / width)^2)^2 and zero beyond the width.

    Args:
        points: Points (n, 2), pixels.
        start: Initial centre and radius; without radius, the median distance from the centre is
            used. None if there is no initial circle.

    Returns:
        The circle, and the distance of each point from it (n,), positive outside; None if no
        circle is found.
    """
    if start is None:
        return None
    u, v, radius = start
    x = points[:, 0]
    y = points[:, 1]
    # Rows: the two components of n, ones for dR, and the residual of (2).
    count = len(points)
    design: Array = np.ones((4, count))
    for _ in range(_MAX_ITERATIONS):
        away_u = x - u
        away_v = y - v
        distances = np.hypot(away_u, away_v)
        if radius is None:
            radius = compute_median(distances)
        residuals = distances - radius  # (1)
        width = _TUKEY_WIDTH * max(
            SIGMA_PER_MEDIAN * compute_median(np.abs(residuals)), _MIN_EDGE_NOISE
        )
        weights = np.maximum(1 - (residuals / width) ** 2, 0.0) ** 2  # (3)
        np.maximum(distances, 1e-9, out=distances)  # the direction n divides by them
        design[0] = away_u / distances
        design[1] = away_v / distances
        design[3] = residuals
        step = _solve_gauss_newton_step((design * weights) @ design.T)
        if step is None:
            return None
        du, dv, dr = step
        u += du
        v += dv
        radius += dr
        if abs(du) + abs(dv) + abs(dr) < _CONVERGED_STEP_PIXELS:
            break
    if radius is None or not _MIN_RADIUS < radius < _MAX_RADIUS:
        return None
    return (u, v, radius), np.hypot(x - u, y - v) - radius


def _solve_gauss_newton_step(normal: Array) -> tuple[float, float, float] | None:
    """Solve the normal equations of a Gauss-Newton step for (du, dv, dR).

    The equations are those of weighted least squares for residual = n_u du + n_v dv + dR (2), with
    the unit vector (n_u, n_v) from the centre to each point. They are solved explicitly, because a
    call of NumPy's solver would take longer than all the rest.

    Args:
        normal: (4, 4) weighted sums of products of the rows n_u, n_v, 1 and residual.

    Returns:
        The step in pixels; None if the equations are singular.
    """
    (uu, uv, u1, ur), (_, vv, v1, vr), (_, _, total, r1), _ = normal.tolist()
    if total <= 0:
        return None
    # Eliminate dR by the Schur complement; two equations in du and dv remain, with the matrix
    # (a b; b c) and the right-hand side (p, q). They are solved by Cramer's rule.
    a = uu - u1 * u1 / total
    b = uv - u1 * v1 / total
    c = vv - v1 * v1 / total
    determinant = a * c - b * b
    if total * determinant < _MIN_DETERMINANT:
        return None
    p = ur - u1 * r1 / total
    q = vr - v1 * r1 / total
    du = (c * p - b * q) / determinant
    dv = (a * q - b * p) / determinant
    dr = (r1 - u1 * du - v1 * dv) / total
    return du, dv, dr


def find_inliers(fitted: CircleFit) -> NDArray[np.bool_]:
    """Return which points are on the circle, (n,)."""
    (_, _, radius), residuals = fitted
    tolerance = max(_INLIER_PIXELS, _INLIER_SHARE * radius)
    result: NDArray[np.bool_] = np.abs(residuals) < tolerance
    return result


def select_better_fit(first: CircleFit | None, second: CircleFit | None) -> CircleFit | None:
    """Return the circle that has more of the points on it; of equal ones, the first.

    Args:
        first: First circle, or None.
        second: Second circle, or None.

    Returns:
        The better circle; None if both are None.
    """
    if first is None or second is None:
        return first or second
    return second if find_inliers(second).sum() > find_inliers(first).sum() else first


def fit_arc(points: Array) -> Circle | None:
    """Fit circles to arcs of consecutive points, and return the one with most points on it.

    A shadow or another ball disturbs one side of an edge. So circles are fitted to arcs of half of
    the points that begin at every third point all around. Kasa's linear least squares solve
    x^2 + y^2 = 2 u x + 2 v y + (R^2 - u^2 - v^2) (4) for 2 u, 2 v and the constant (I. Kasa, IEEE
    Trans. Instrum. Meas. 25, 8, 1976, doi:10.1109/TIM.1976.6312298).

    Args:
        points: Points (n, 2), in their order along the edge, pixels.

    Returns:
        The circle; None if an arc does not determine one.
    """
    count = len(points)
    # (arcs, points of an arc) indices; the edge is closed.
    arc_starts = np.arange(0, count, _ARC_STRIDE)
    arc_offsets = np.arange(count // 2 + 1)
    point_indices = (arc_starts[:, None] + arc_offsets) % count
    # Relative to the mean, because the squares in (4) lose digits far from the origin.
    mean = points.mean(axis=0)
    arcs = points[point_indices] - mean
    # (arcs, points of an arc, 3): x, y and 1.
    design_matrix = np.concatenate([arcs, np.ones((*point_indices.shape, 1))], axis=2)
    transposed = design_matrix.transpose(0, 2, 1)
    normal = transposed @ design_matrix
    if (np.abs(np.linalg.det(normal)) < _MIN_DETERMINANT).any():
        return None
    squares = (arcs**2).sum(axis=2)[..., None]
    solution = np.linalg.solve(normal, transposed @ squares)  # (4)
    doubled_u, doubled_v, constant = solution[..., 0].T
    u = doubled_u / 2
    v = doubled_v / 2
    radius = np.sqrt(np.maximum(constant + u**2 + v**2, 0.0))
    # (arcs, n) distance of every point from every circle.
    x, y = (points - mean).T
    distances = np.hypot(x - u[:, None], y - v[:, None])
    deviations = distances - radius[:, None]
    # Half the tolerance of `find_inliers`: points graze the circle of a wrong arc.
    tolerance = np.maximum(0.35, 0.05 * radius)
    is_on_circle = np.abs(deviations) < tolerance[:, None]
    best = int(is_on_circle.sum(axis=1).argmax())
    return (
        float(u[best] + mean[0]),
        float(v[best] + mean[1]),
        float(radius[best]),
    )


def fit_centre(
    points: Array, start: tuple[float, float], radius: float
) -> tuple[float, float] | None:
    """Fit the centre of a circle with a known radius to most of the points by Gauss-Newton.

    With their distance d from the centre and the unit vector n towards them, each step solves
    d - radius = n . (du, dv) (2) by weighted least squares. The weights are those of Geman and
    McClure, 1 / (1 + (residual / width)^2)^2 (5), with the residual d - radius (1).

    Args:
        points: Points (n, 2), pixels.
        start: Initial centre (u, v), pixels.
        radius: Known radius, pixels.

    Returns:
        The centre (u, v); None if the points do not determine it.
    """
    u, v = start
    for _ in range(_MAX_CENTRE_ITERATIONS):
        away_u = points[:, 0] - u
        away_v = points[:, 1] - v
        distances = np.maximum(np.hypot(away_u, away_v), 1e-9)
        residual = distances - radius  # (1)
        # Points off the circle hardly count.
        weights = 1 / (1 + (residual / _GEMAN_MCCLURE_WIDTH) ** 2) ** 2  # (5)
        rows = np.stack([away_u / distances, away_v / distances, residual])
        normal = (rows * weights) @ rows.T
        # Normal equations (a b; b c) (du, dv) = (p, q), solved by Cramer's rule.
        (a, b, p), (_, c, q), _ = normal.tolist()
        determinant = a * c - b * b
        if determinant < _MIN_DETERMINANT:
            return None
        du = (c * p - b * q) / determinant
        dv = (a * q - b * p) / determinant
        u += du
        v += dv
        if abs(du) + abs(dv) < _CONVERGED_STEP_PIXELS:
            break
    return u, v
