"""Geometry of incline and hoop, and where the path of a ball crosses a height."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sims.core.simulator import Array, InputError


@dataclass(frozen=True)
class ShotGeometry:
    """Geometry of a shot.

    Heights count from the point of the incline below the release, where x = 0.

    Attributes:
        angle: Angle of the incline, which descends towards x, rad.
        hoop_x: Centre of the hoop, a horizontal ring, m.
        hoop_z: Height of the hoop, m.
        hoop_radius: Radius of the hoop, m.
    """

    angle: float
    hoop_x: float
    hoop_z: float
    hoop_radius: float

    def __post_init__(self) -> None:
        """Check that the incline descends, and that the hoop is in front of it and above it.

        Raises:
            InputError: it is not so.
        """
        if not (0 < self.angle < math.pi / 2 and self.hoop_x > 0 and self.hoop_radius > 0):
            raise InputError(
                "expected an incline between 0 and a right angle and a hoop in front of it,"
                f" found {self}"
            )
        if self.hoop_z <= -self.hoop_x * math.tan(self.angle):
            raise InputError(f"expected a hoop above the incline, found {self}")

    def compute_contact_height(self, radius: float) -> float:
        """Return the height of the centre of a ball that touches the incline at x = 0, m."""
        return radius / math.cos(self.angle)


def compute_hoop_crossings(path: Array, scene: ShotGeometry) -> Array:
    """Return the points where paths cross the hoop's plane downwards.

    Only the flight after the first bounce counts: from where z first rises to where it rises again.
    Between two samples the path is a straight line. With the sample before the plane at height z1
    and the one after it at z2, the hoop's plane at height h is crossed at the share

        (z1 - h) / (z1 - z2)                                               (1)

    of the way between them.

    Args:
        path: Centres x, y, z of the ball in n paths (n, T, 3), m.
        scene: Geometry of the shot.

    Returns:
        Points x, y (n, 2), m; NaN for paths that do not cross.
    """
    path = np.asarray(path, dtype=np.float64)
    x, y, z = np.moveaxis(path, -1, 0)
    with np.errstate(invalid="ignore"):
        rises = z[:, 1:] > z[:, :-1]
        falls = z[:, 1:] < z[:, :-1]
        # Whether the path has risen, fallen after that, and risen again, up to each sample.
        has_risen = np.logical_or.accumulate(rises, axis=1)
        has_fallen = np.logical_or.accumulate(has_risen & falls, axis=1)
        has_risen_again = np.logical_or.accumulate(has_fallen & rises, axis=1)
        # Downward only: a ball that crosses upwards has not scored.
        is_above = z[:, :-1] > scene.hoop_z
        is_below = z[:, 1:] <= scene.hoop_z
        is_crossing = has_risen & ~has_risen_again & is_above & is_below
    # Sample before the first crossing of each path; for paths without one, it is 0 and unused.
    before = np.argmax(is_crossing, axis=1)
    is_crossed = is_crossing.any(axis=1)
    paths = np.arange(len(z))
    high = z[paths, before]
    low = z[paths, before + 1]
    share = (high - scene.hoop_z) / np.where(is_crossed, high - low, 1.0)  # (1)
    crossing_x = x[paths, before] + share * (x[paths, before + 1] - x[paths, before])
    crossing_y = y[paths, before] + share * (y[paths, before + 1] - y[paths, before])
    crossing_points = np.stack([crossing_x, crossing_y], axis=1)
    result: Array = np.where(is_crossed[:, None], crossing_points, np.nan)
    return result


def find_descent_index(path: Array, height: float) -> int:
    """Return the index of the sample after which a path descends through a height after a bounce.

    The path before the bounce is ignored, because the ball falls through the same heights after
    its release.

    Args:
        path: positions, (T, 3).
        height: height, m.

    Returns:
        Index of the sample; the last index if the path does not descend through the height.
    """
    heights = path[:, 2]
    # A ball that has risen has bounced.
    has_bounced = np.logical_or.accumulate(heights[1:] > heights[:-1])
    is_descent = has_bounced & (heights[:-1] > height) & (heights[1:] <= height)
    return int(np.argmax(is_descent)) if is_descent.any() else len(heights) - 1
