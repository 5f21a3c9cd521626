"""Quaternions (w, x, y, z), their yaw, pitch and roll, and angles recorded within one turn."""

from __future__ import annotations

import math

import numpy as np

from sims.core.simulator import Array


def multiply_quaternions(first: Array, second: Array) -> Array:
    """Compute the Hamilton products (n, 4) of `first` and `second`, quaternions (w, x, y, z)."""
    a, u = first[:, :1], first[:, 1:]
    b, v = second[:, :1], second[:, 1:]
    real_part = a * b - np.sum(u * v, axis=1, keepdims=True)
    return np.concatenate([real_part, a * v + b * u + np.cross(u, v)], axis=1)


def compute_yaw_pitch_roll(quaternions: Array, reference: Array) -> Array:
    """Compute yaw, pitch and roll (T, 3) in rad of orientations, relative to a reference.

    With the orientation R and the reference R_0, R R_0^-1 = R_z(yaw) R_y(pitch) R_x(roll).

    Args:
        quaternions: (T, 4) orientations (w, x, y, z) in T samples; NaN where one is missing.
        reference: (4,) orientation in the model file, a unit quaternion.
    """
    # The inverse of a unit quaternion is its conjugate.
    inverse_reference = reference * np.array([1.0, -1.0, -1.0, -1.0])
    w, x, y, z = multiply_quaternions(quaternions, inverse_reference[None]).T
    with np.errstate(invalid="ignore"):  # NaN where a sample is missing
        angles = [
            np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
            np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0)),
            np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        ]
    result: Array = np.stack(angles, axis=1)
    return result


def unwrap_angle(positions: Array, command: Array | None = None) -> Array:
    """Restore the whole turns of an angle that was recorded within one turn; NaN stays NaN.

    Shapes: T samples.

    Jumps of more than half a turn between samples are removed. The first sample may still be off by
    whole turns; with a command, the position is moved to the turn of the command.

    Args:
        positions: (T,) positions, rad.
        command: (T,) command of the joint's position servo, rad, which the position follows; None
            if there is none.

    Returns:
        (T,) positions, rad.
    """
    result = positions.copy()
    finite = np.isfinite(positions)
    result[finite] = np.unwrap(positions[finite])
    if command is not None and finite.any():
        mean_difference = float(np.mean((command - result)[finite]))
        result += 2.0 * math.pi * round(mean_difference / (2.0 * math.pi))
    return result
