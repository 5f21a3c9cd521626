"""Rotations: quaternions (w, x, y, z), rotation matrices, rotation vectors, and Euler angles."""

from __future__ import annotations

import numpy as np

from sims.core.simulator import Array

MIN_QUATERNION_NORM = 1e-6
"""Minimum length of a valid quaternion, and of a rotation vector that is not treated as zero."""


def multiply_quaternions(first: Array, second: Array) -> Array:
    """Compute the Hamilton products (n, 4) of `first` and `second`, quaternions (w, x, y, z)."""
    a, u = first[:, :1], first[:, 1:]
    b, v = second[:, :1], second[:, 1:]
    real_part = a * b - np.sum(u * v, axis=1, keepdims=True)
    return np.concatenate([real_part, a * v + b * u + np.cross(u, v)], axis=1)


def compute_rotation_matrices(quaternions: Array) -> Array:
    """Return the rotation matrices (L, 3, 3) of quaternions (L, 4), MuJoCo's w first.

    Importing scipy.spatial for it would take 0.1 s of every explanation of a robot.

    Shapes: L batch elements.
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

    Shapes: L batch elements.
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


def compute_rotation_vectors(quaternions: Array) -> Array:
    """Compute rotation vectors (n, 3) of unit quaternions, with angles of at most pi.

    A quaternion (cos(a / 2), u sin(a / 2)) has the rotation vector a u. q and -q are the same
    rotation; the sign with a nonnegative real part gives the smaller angle.

    Args:
        quaternions: (n, 4) unit quaternions (w, x, y, z).
    """
    sign = np.where(quaternions[:, :1] < 0, -1.0, 1.0)
    real_part, vector = sign * quaternions[:, :1], sign * quaternions[:, 1:]
    length = np.linalg.norm(vector, axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(length, real_part)
    is_small = length < MIN_QUATERNION_NORM
    scale = np.where(is_small, 2.0, angle / np.where(is_small, 1.0, length))
    return vector * scale


def compute_yaw_pitch_roll(quaternions: Array, reference: Array) -> Array:
    """Compute yaw, pitch and roll (T, 3) in rad of orientations, relative to a reference.

    With the orientation R and the reference R_0, R R_0^-1 = R_z(yaw) R_y(pitch) R_x(roll).

    Args:
        quaternions: (T, 4) orientations (w, x, y, z); NaN where a sample is missing.
        reference: (4,) orientation in the model file, a unit quaternion.
    """
    inverse_reference = reference * np.array([1.0, -1.0, -1.0, -1.0])
    w, x, y, z = multiply_quaternions(quaternions, inverse_reference[None]).T
    with np.errstate(invalid="ignore"):
        angles = [
            np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
            np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0)),
            np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        ]
    result: Array = np.stack(angles, axis=1)
    return result
