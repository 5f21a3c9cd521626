"""Inertia tensors of bodies from principal moments, and of point masses."""

from __future__ import annotations

import numpy as np

from sims.core.rotations import compute_rotation_matrices
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
    """Compute inertia tensors (L, 3, 3) in the axes of the bodies.

    Shapes: L batch elements.

    Args:
        quaternions: (L, 4) orientations of the principal axes, MuJoCo's w first.
        moments: (L, 3) principal moments.
    """
    axes = compute_rotation_matrices(quaternions)
    result: Array = np.einsum("lij,lj,lkj->lik", axes, moments, axes)
    return result
