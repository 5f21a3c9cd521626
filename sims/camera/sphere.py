"""A finely divided sphere for the renderer, whose own is a polyhedron of 4 % less radius."""

from __future__ import annotations

import functools

import numpy as np

from sims.base import Array, frozen

_FACES = 3


@functools.cache
def sphere(divisions: int = _FACES) -> tuple[Array, tuple[int, ...]]:
    """Points (n, 3) of a unit sphere, and its triangles as indices, three after three.

    Each face of an icosahedron is divided into four, again and again; with three divisions 642
    points.
    """
    golden = (1 + 5**0.5) / 2
    corners = [(-1, golden, 0), (1, golden, 0), (-1, -golden, 0), (1, -golden, 0)]
    turned = [(c, a, b) for a, b, c in corners]
    points = [
        np.array(p) / np.hypot(1, golden)
        for p in (*corners, *turned, *((c, a, b) for a, b, c in turned))
    ]
    side = min(float(np.linalg.norm(points[0] - p)) for p in points[1:])
    near = [[float(np.linalg.norm(p - q)) < 1.1 * side for q in points] for p in points]
    faces = [
        _outward(points, (i, j, k))
        for i in range(12)
        for j in range(i + 1, 12)
        for k in range(j + 1, 12)
        if near[i][j] and near[j][k] and near[i][k]
    ]
    for _ in range(divisions):
        faces = _divided(points, faces)
    return frozen(points), tuple(i for face in faces for i in face)


def _outward(points: list[Array], face: tuple[int, int, int]) -> tuple[int, int, int]:
    a, b, c = (points[i] for i in face)
    return face if np.dot(np.cross(b - a, c - a), a) > 0 else (face[0], face[2], face[1])


def _divided(points: list[Array], faces: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
    """Four faces for each; the new points are added to `points`."""
    made: dict[tuple[int, int], int] = {}

    def middle(i: int, j: int) -> int:
        key = min(i, j), max(i, j)
        if key not in made:
            between = points[i] + points[j]
            made[key] = len(points)
            points.append(between / np.linalg.norm(between))
        return made[key]

    result = []
    for i, j, k in faces:
        ij, jk, ki = middle(i, j), middle(j, k), middle(k, i)
        result += [(i, ij, ki), (j, jk, ij), (k, ki, jk), (ij, jk, ki)]
    return result
