"""Inertia tensors of point masses, and of bodies from principal moments and back."""

from __future__ import annotations

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
    """Compute inertia tensors (L, 3, 3) in the axes of the bodies.

    Shapes: L batch elements.

    Args:
        quaternions: (L, 4) orientations of the principal axes, unit quaternions, w first.
        moments: (L, 3) principal moments.
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

    Returns:
        The moments in ascending order, and the axes as unit quaternions (L, 4), w first.
    """
    import mujoco

    moments, axes = np.linalg.eigh(tensors)
    # A rotation has no reflection.
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    quaternions = np.empty((len(axes), 4))
    for quaternion, matrix in zip(quaternions, axes, strict=True):
        mujoco.mju_mat2Quat(quaternion, matrix.ravel())
    return moments, quaternions
