"""Fine mesh of a sphere for the renderer, whose own is a polyhedron of 4 % smaller radius."""

from __future__ import annotations

import functools
from itertools import combinations

import numpy as np

from sims.core.simulator import Array, make_read_only

_FACES = 3
"""Number of subdivisions of the icosahedron's faces; the silhouette is then round to 0.3 %."""


@functools.cache
def make_sphere_mesh(divisions: int = _FACES) -> tuple[Array, tuple[int, ...]]:
    """Return a triangle mesh of the unit sphere.

    Each face of an icosahedron is divided into four, repeatedly; three divisions give 642 points.

    Args:
        divisions: Number of subdivisions.

    Returns:
        Points (n, 3), and the corners of the triangles as a flat list of indices, three per
        triangle.
    """
    golden = (1 + 5**0.5) / 2
    # Corners of three golden rectangles at right angles.
    corners = [
        (-1, golden, 0),
        (1, golden, 0),
        (-1, -golden, 0),
        (1, -golden, 0),
    ]
    rotated = [(c, a, b) for a, b, c in corners]
    rotated_twice = [(c, a, b) for a, b, c in rotated]
    size = np.hypot(1, golden)
    points = [np.array(p) / size for p in (*corners, *rotated, *rotated_twice)]
    faces = [_orient_outward(points, face) for face in _find_triangles(points)]
    for _ in range(divisions):
        faces = _subdivide_faces(points, faces)
    return make_read_only(points), tuple(i for face in faces for i in face)


def _find_triangles(points: list[Array]) -> list[tuple[int, int, int]]:
    """Return the index triples of corners that are one side length apart, each triple once."""
    side = min(float(np.linalg.norm(points[0] - p)) for p in points[1:])

    def near(i: int, j: int) -> bool:
        return float(np.linalg.norm(points[i] - points[j])) < 1.1 * side

    triples = []
    for i, j, k in combinations(range(len(points)), 3):
        if near(i, j) and near(j, k) and near(i, k):
            triples.append((i, j, k))
    return triples


def _orient_outward(points: list[Array], face: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return the face with its corners anticlockwise as seen from outside."""
    i, j, k = face
    a = points[i]
    normal = np.cross(points[j] - a, points[k] - a)
    return face if np.dot(normal, a) > 0 else (i, k, j)


def _subdivide_faces(
    points: list[Array], faces: list[tuple[int, int, int]]
) -> list[tuple[int, int, int]]:
    """Divide each face into four; the new points are appended to `points`."""
    numbers: dict[tuple[int, int], int] = {}

    def middle(i: int, j: int) -> int:
        """Return the index of an edge's midpoint on the unit sphere; add it if missing."""
        # Two faces share an edge and its midpoint.
        edge = min(i, j), max(i, j)
        if edge not in numbers:
            midpoint = points[i] + points[j]
            numbers[edge] = len(points)
            points.append(midpoint / np.linalg.norm(midpoint))
        return numbers[edge]

    result = []
    for i, j, k in faces:
        ij = middle(i, j)
        jk = middle(j, k)
        ki = middle(k, i)
        # Three faces at the corners and one in the middle, all with the same orientation.
        result += [
            (i, ij, ki),
            (j, jk, ij),
            (k, ki, jk),
            (ij, jk, ki),
        ]
    return result
