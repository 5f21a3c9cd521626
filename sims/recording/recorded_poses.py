"""Recorded poses of floating bodies, as from motion capture: quaternions become three angles.

A free joint has no coordinates that a channel shows. A body whose whole pose is recorded is
therefore simulated with six joints in place of the free joint: three slides along the axes of the
world, and the rotations yaw, pitch and roll (psi, theta, phi). With R the orientation of the body
in the world, and R_0 its orientation in the model file,

    R R_0^-1 = R_z(psi) R_y(theta) R_x(phi).                                                   (1)

Yaw and roll are not defined at a pitch of 90 degrees (J. Diebel, Representing attitude, Stanford
University, 2006, section 8).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

import numpy as np

from sims.core.angles_and_quaternions import compute_yaw_pitch_roll, unwrap_angle
from sims.core.simulator import Array, InputError

POSITION_AXES = ("x", "y", "z")
"""Axes of translation, those of the world; the channel of the first is ``q.BASE.x``."""
ANGLES = ("yaw", "pitch", "roll")
"""Rotations by eq. (1), in the order in which they follow each other."""
QUATERNION_ENTRIES = ("qw", "qx", "qy", "qz")
"""Entries of a unit quaternion, as in the channel ``q.BASE.qw``."""
MAX_PITCH = np.deg2rad(80.0)
"""Largest absolute pitch, in rad, at which yaw and roll are well defined."""
MAX_NORM_ERROR = 0.1
"""Largest difference of a quaternion's length from 1: more is no rounding."""


def find_recorded_bases(channels: Iterable[str]) -> list[str]:
    """Find the floating joints of bodies whose pose is among the channels.

    The channels of a joint BASE are its quaternion, ``q.BASE.qw``, qx, qy and qz, or its position
    ``q.BASE.x``, y and z and the angles ``q.BASE.yaw``, pitch and roll. (With a quaternion, a
    missing position is not noticed here, since a ball joint has none.)

    Args:
        channels: Names of the recorded channels.

    Returns:
        Names of the joints in alphabetical order.
    """
    names = set(channels)
    bases = []
    for name in sorted(names):
        match = re.fullmatch(r"q\.(?P<base>.+)\.(qw|yaw)", name)
        if match is None or match["base"] in bases:
            continue
        base = match["base"]
        has_quaternion = {f"q.{base}.{entry}" for entry in QUATERNION_ENTRIES} <= names
        has_angles = {f"q.{base}.{entry}" for entry in (*POSITION_AXES, *ANGLES)} <= names
        if has_quaternion or has_angles:
            bases.append(base)
    return bases


def convert_quaternions(
    channels: Mapping[str, Array], base: str, reference: Array, where: str
) -> dict[str, Array]:
    """Replace the quaternion of a floating body among the channels of a run by yaw, pitch and roll.

    Shapes: T samples.

    In the simulation the body has three hinges in place of its quaternion, whose coordinates are
    these angles. Channels without a quaternion of the body are returned unchanged.

    Args:
        channels: channels of the run by name, each (T,).
        base: name of the free or ball joint.
        reference: (4,) orientation of the body in the model file, a unit quaternion.
        where: beginning of error messages.

    Returns:
        The channels by name, with yaw, pitch and roll in rad relative to `reference`.

    Raises:
        InputError: a quaternion has another length than 1, or a pitch is close to 90 degrees.
    """
    names = [f"q.{base}.{entry}" for entry in QUATERNION_ENTRIES]
    if names[0] not in channels:
        return dict(channels)
    quaternions = np.stack([channels[name] for name in names], axis=1)
    norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
    wrong_rows = np.flatnonzero(np.abs(norms[:, 0] - 1.0) > MAX_NORM_ERROR)
    if wrong_rows.size:
        raise InputError(
            f"{where}, sample {wrong_rows[0] + 1}: {names[0]}, qx, qy, qz: expected a quaternion "
            f"of length 1, found one of length {norms[wrong_rows[0], 0]:.3g}"
        )
    angles = compute_yaw_pitch_roll(quaternions / norms, reference)
    steep_rows = np.flatnonzero(np.abs(angles[:, 1]) > MAX_PITCH)
    if steep_rows.size:
        raise InputError(
            f"{where}, sample {steep_rows[0] + 1}: {base} has a pitch of "
            f"{np.rad2deg(angles[steep_rows[0], 1]):.0f} degrees, and yaw and roll are not defined "
            "at 90; expected at most 80: leave such samples out, or state another orientation of "
            "the body in the model file"
        )
    converted = {name: values for name, values in channels.items() if name not in names}
    for angle, values in zip(ANGLES, angles.T, strict=True):
        # NaN stays NaN, and whole turns are restored.
        converted[f"q.{base}.{angle}"] = unwrap_angle(values)
    return converted
