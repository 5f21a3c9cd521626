"""Inertia tensors of bodies from principal moments, and of point masses."""

from __future__ import annotations

import numpy as np

from sims.core.simulator import Array


def compute_point_inertias(arms: Array) -> Array:
    """Compute the inertia tensors of unit masses at d, J(d) = |d|^2 1 - d d'.

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

    Args:
        quaternions: (L, 4) orientations of the principal axes, MuJoCo's w first.
        moments: (L, 3) principal moments.
    """
    axes = _compute_rotation_matrices(quaternions)
    result: Array = np.einsum("lij,lj,lkj->lik", axes, moments, axes)
    return result


def _compute_rotation_matrices(quaternions: Array) -> Array:
    """Return the rotation matrices (L, 3, 3) of quaternions (L, 4), MuJoCo's w first.

    Importing scipy.spatial for it would take 0.1 s of every explanation of a robot.
    """
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    result: Array = np.moveaxis(np.array(rows), 2, 0)
    return result


def compute_quaternions(matrices: Array) -> Array:
    """Return unit quaternions (L, 4), MuJoCo's w first, of rotation matrices (L, 3, 3).

    The quaternion of a matrix R is the eigenvector to the largest eigenvalue, which is 1, of a
    symmetric matrix K that is linear in R (I. Y. Bar-Itzhack, Journal of Guidance, Control, and
    Dynamics 23, 1085, 2000, doi:10.2514/2.4654). Importing scipy.spatial for it would take 0.1 s of
    every explanation of a robot.
    """
    trace = np.trace(matrices, axis1=1, axis2=2)
    scaled = np.empty((len(matrices), 4, 4))  # 3 K
    scaled[:, 0, 0] = trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        scaled[:, 0, i + 1] = scaled[:, i + 1, 0] = matrices[:, k, j] - matrices[:, j, k]
        scaled[:, 1 + i, 1:] = matrices[:, i] + matrices[:, :, i]
        scaled[:, 1 + i, 1 + i] -= trace
    result: Array = np.linalg.eigh(scaled)[1][:, :, -1]
    return result
