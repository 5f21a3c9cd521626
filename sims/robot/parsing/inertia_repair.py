"""Physically valid principal moments of inertia."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sims.core.simulator import Array

MIN_MOMENT = 1e-9
"""Moment of inertia, in kg m^2, that replaces moments that are not positive.

It is the moment of 1 g at a distance of 1 mm.
"""
NEGLIGIBLE_MOMENT = 1e-14
"""Largest moment of inertia, in kg m^2, that counts as zero; MuJoCo's own limit is 1e-15."""
ROUNDING_SHARE = 1e-9
"""Margin for rounding in the triangle inequality, as a share of the largest moment."""


def compute_triangle_violation(moments: Array) -> float:
    """Return by how much the moments violate the triangle inequality, in kg m^2.

    The violation is the largest moment minus the sum of the two others; it is negative or zero for
    a physically valid body.
    """
    return float(2 * np.max(moments) - np.sum(moments))


def find_nearest_valid_moments(moments: Array) -> Array:
    """Return the nearest physically valid moments, in kg m^2: positive, with A + B >= C."""
    raised_moments: Array = np.maximum(
        moments, np.where(moments < NEGLIGIBLE_MOMENT, MIN_MOMENT, 0.0)
    )
    correction = (
        compute_triangle_violation(raised_moments) + ROUNDING_SHARE * np.max(raised_moments)
    ) / 3
    if correction <= ROUNDING_SHARE * np.max(raised_moments) / 3:
        return raised_moments
    return np.where(
        raised_moments == np.max(raised_moments),
        raised_moments - correction,
        raised_moments + correction,
    )


def compute_principal_moments(entries: Sequence[float]) -> tuple[Array, Array]:
    """Compute the principal moments and axes of an inertia tensor.

    Args:
        entries: xx, yy, zz, xy, xz, yz of the tensor, in kg m^2.

    Returns:
        Principal moments (3,) in kg m^2, and axes (3, 3) as columns.
    """
    xx, yy, zz, xy, xz, yz = entries
    moments, axes = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    return moments, axes


def compose_inertia_tensor(moments: Array, axes: Array) -> list[float]:
    """Compose an inertia tensor from principal moments and axes.

    Args:
        moments: (3,) principal moments in kg m^2.
        axes: (3, 3) principal axes as columns.

    Returns:
        Entries xx, yy, zz, xy, xz, yz of the tensor, in kg m^2.
    """
    tensor = axes @ np.diag(moments) @ axes.T
    return [float(tensor[index]) for index in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]


def format_moments(before: Array, after: Array) -> str:
    """Format the moments before and after a repair, in kg m^2, as text of a note."""
    rows = (", ".join(f"{moment:.4g}" for moment in sorted(row)) for row in (before, after))
    return " -> ".join(rows)
