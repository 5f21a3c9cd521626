"""Inertia tensors of point masses, principal moments of bodies, and their nearest valid values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sims.core.simulator import Array


def compute_point_inertias(arms: Array) -> Array:
    """Compute the inertia tensors of unit masses at d, J(d) = |d|^2 1 - d d'.

    Shapes: L batch elements.

    Args:
        arms: (L, 3) vectors d from the reference point, in m.

    Returns:
        (L, 3, 3) tensors in m^2.
    """
    squares = np.sum(arms**2, axis=1)[:, None, None]
    result: Array = squares * np.eye(3) - arms[:, :, None] * arms[:, None, :]
    return result


def compute_inertia_tensors(quaternions: Array, moments: Array) -> Array:
    """Compute inertia tensors R diag(I) R' (L, 3, 3) in the axes of the bodies.

    Shapes: L batch elements.

    Args:
        quaternions: (L, 4) orientations of the principal axes, unit quaternions, w first.
        moments: (L, 3) principal moments I.
    """
    import mujoco

    matrices = np.empty((len(quaternions), 9))
    for matrix, quaternion in zip(matrices, quaternions, strict=True):
        mujoco.mju_quat2Mat(matrix, quaternion)
    axes = matrices.reshape(-1, 3, 3)
    result: Array = np.einsum("lij,lj,lkj->lik", axes, moments, axes)
    return result


def compute_principal_axes(tensors: Array) -> tuple[Array, Array]:
    """Compute the principal moments (L, 3) of tensors (L, 3, 3), and the orientation of their axes.

    Shapes: L batch elements.

    Args:
        tensors: (L, 3, 3) symmetric tensors in kg m^2.

    Returns:
        The moments in ascending order, and the axes as unit quaternions (L, 4), w first.
    """
    import mujoco

    moments, axes = np.linalg.eigh(tensors)
    # The eigenvectors may be a reflection; with the first one reversed, they are a rotation.
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    quaternions = np.empty((len(axes), 4))
    for quaternion, matrix in zip(quaternions, axes, strict=True):
        mujoco.mju_mat2Quat(quaternion, matrix.ravel())
    return moments, quaternions


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
    """Return the nearest physically valid moments of inertia, in kg m^2.

    Moments below `NEGLIGIBLE_MOMENT` become `MIN_MOMENT`. Principal moments A <= B <= C of a rigid
    body also satisfy A + B >= C. If A + B is smaller, the violation C - A - B is divided equally:
    the largest moment is decreased and both others are increased by a third of it, with a margin
    for rounding.

    Args:
        moments: (3,) principal moments in kg m^2.
    """
    raised_moments: Array = np.maximum(
        moments, np.where(moments < NEGLIGIBLE_MOMENT, MIN_MOMENT, 0.0)
    )
    margin = ROUNDING_SHARE * np.max(raised_moments)
    correction = (compute_triangle_violation(raised_moments) + margin) / 3
    if correction <= margin / 3:  # The triangle inequality is satisfied.
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
