"""Fine mesh of a sphere for the renderer, whose own is a polyhedron of 4 % smaller radius."""

from __future__ import annotations

import functools

import numpy as np
from scipy.spatial import ConvexHull

from sims.core.simulator import Array, make_read_only

_SUBDIVISIONS = 3
"""Number of subdivisions of the icosahedron's faces; the silhouette is then round to 0.3 %."""


@functools.cache
def make_sphere_mesh() -> tuple[Array, tuple[int, ...]]:
    """Return a triangle mesh of the unit sphere.

    Each face of an icosahedron is divided into four, repeatedly: the midpoints of the edges are
    moved onto the sphere. The faces are those of the convex hull.

    Returns:
        Points (642, 3), and the corners of the triangles as a flat list of indices, three per
        triangle, anticlockwise as seen from outside.
    """
    golden = (1 + 5**0.5) / 2
    # Corners of three golden rectangles at right angles.
    corners = np.array([(-1, golden, 0), (1, golden, 0), (-1, -golden, 0), (1, -golden, 0)])
    points = np.concatenate([np.roll(corners, shift, axis=1) for shift in range(3)])
    points /= np.hypot(1, golden)
    for _ in range(_SUBDIVISIONS):
        faces = ConvexHull(points).simplices
        edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)), axis=0)
        middles = points[edges].sum(axis=1)
        middles /= np.linalg.norm(middles, axis=1, keepdims=True)
        points = np.concatenate([points, middles])
    faces = ConvexHull(points).simplices
    a, b, c = points[faces.T]
    is_inward = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    faces[is_inward] = faces[is_inward, ::-1]
    return make_read_only(points), tuple(faces.ravel().tolist())
