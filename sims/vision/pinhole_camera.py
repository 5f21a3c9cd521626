"""Pinhole camera without lens distortion, and its file.

Pixels are (u, v): u to the right, v down, (0, 0) the centre of the upper left pixel, as in OpenCV.
World coordinates are in metres, z up. Pixels are square.

With (X, Y, Z) a point in the camera's frame (right, down, depth), f the focal length in pixels and
(u0, v0) the pixel of the optical axis (the principal point):

    (1)  (X, Y, Z) = axes (point - position)
    (2)  u = u0 + f X / Z,  v = v0 + f Y / Z
    (3)  f = (height / 2) / tan(field of view / 2)

(R. Hartley, A. Zisserman, Multiple View Geometry, 2004, chapter 6). A sphere of radius r at
distance d, seen at the angle t from the optical axis, fills a cone of half angle p with

    (4)  sin p = r / d

The section of this cone with the picture plane Z = 1 is an ellipse whose long axis is on the line
to the principal point, from tan(t - p) to tan(t + p):

    (5)  centre a = (tan(t - p) + tan(t + p)) / 2,  half length (tan(t + p) - tan(t - p)) / 2

Its half width b follows from a point (a, b, 1) of the cone, whose axis is (sin t, 0, cos t):

    (6)  (a sin t + cos t)^2 = cos(p)^2 (a^2 + b^2 + 1)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sims.core.simulator import Array, InputError, make_read_only
from sims.core.toml_validation import (
    check_finite,
    check_known_names,
    check_number_list,
    check_table,
    make_error,
    read_toml,
)

_REFINEMENT_COUNT = 4
"""Number of iterations in which the offset between outline and projected centre is subtracted."""


@dataclass(frozen=True)
class PinholeCamera:
    """Camera at the horizontal distance `distance` from its target, directed at the target.

    Attributes:
        azimuth: Direction from the target to the camera about the vertical, from x towards y, rad.
        distance: Distance from the vertical through the target, m.
        height: Height above the ground, m.
        target: Point in the middle of the picture (x, y, z), m.
        field_of_view: Angle from the lower to the upper edge of the picture, degrees.
        size: Width and height of the picture, pixels.
    """

    azimuth: float
    distance: float
    height: float
    target: tuple[float, float, float] = (0.0, 0.0, 2.0)
    field_of_view: float = 40.0
    size: tuple[int, int] = (100, 100)

    def __post_init__(self) -> None:
        """Check that the camera can show a picture.

        Raises:
            InputError: a number is not finite or out of range.
        """
        numbers = [
            self.azimuth,
            self.distance,
            self.height,
            self.field_of_view,
            *self.target,
        ]
        if not np.isfinite(numbers).all():
            raise InputError(f"camera: expected finite numbers, found {numbers}")
        # From straight above, the upright direction of the picture would be undefined.
        if self.distance <= 0:
            raise InputError(f"camera: distance: expected more than 0 m, found {self.distance:g}")
        angle = self.field_of_view
        if not 0 < angle < 180:
            raise InputError(f"camera: field_of_view: expected 0 to 180 degrees, found {angle:g}")
        if len(self.size) != 2 or min(self.size) < 2:
            raise InputError(f"camera: size: expected two numbers of pixels, found {self.size}")

    @classmethod
    def draw_published(cls, rng: np.random.Generator, pixels: int = 100) -> PinholeCamera:
        """Draw a camera as for the published visual tuner.

        Azimuth U[0, 2 pi] rad, distance U[5, 10] m, height U[5, 8] m, aimed at (0, 0, 2) m, field
        of view 40 degrees (Allevato et al., TuneNet, arXiv 1907.11200, released code).

        Args:
            rng: Random number generator.
            pixels: Width and height of the picture; 100 in the publication.
        """
        low = 0.0, 5.0, 5.0
        high = 2 * math.pi, 10.0, 8.0
        azimuth, distance, height = rng.uniform(low, high).tolist()
        return cls(azimuth, distance, height, size=(pixels, pixels))

    @cached_property
    def position(self) -> Array:
        """Position of the camera (3,), m."""
        x, y, _ = self.target
        x += self.distance * math.cos(self.azimuth)
        y += self.distance * math.sin(self.azimuth)
        return make_read_only([x, y, self.height])

    @cached_property
    def focal(self) -> float:
        """Focal length in pixels."""
        half_angle = math.radians(self.field_of_view) / 2
        return 0.5 * self.size[1] / math.tan(half_angle)  # (3)

    @cached_property
    def principal_point(self) -> Array:
        """Principal point: the pixel (2,) of the optical axis."""
        # Pixel coordinates refer to pixel centres, so the middle of 100 pixels is 49.5.
        width, height = self.size
        return make_read_only([(width - 1) / 2, (height - 1) / 2])

    @cached_property
    def axes(self) -> Array:
        """Axes of the camera as unit vectors of the world (3, 3), in rows: right, down, forward."""
        # The vertical of the world is upright in the picture.
        forward = np.asarray(self.target) - self.position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        return make_read_only([right, down, forward])

    def to_camera_frame(self, points: ArrayLike) -> Array:
        """Transform world points (..., 3) to the camera's frame (..., 3), m: right, down, depth."""
        offsets = np.asarray(points, dtype=np.float64) - self.position
        result: Array = offsets @ self.axes.T  # (1)
        return result

    def project(self, points: ArrayLike) -> Array:
        """Project world points (..., 3) in m to pixels (..., 2).

        With the point (X, Y, Z) in the camera's frame (right, down, depth), the focal length f and
        the principal point (u0, v0) in pixels, u = u0 + f X / Z and v = v0 + f Y / Z (2). Pixels
        may be outside the picture; they are NaN for points behind the camera.
        """
        camera_points = self.to_camera_frame(points)
        depth = camera_points[..., 2:]
        # Points behind the camera would appear mirrored about the principal point.
        depth = np.where(depth > 0, depth, np.nan)
        result: Array = self.principal_point + self.focal * camera_points[..., :2] / depth  # (2)
        return result

    def project_sphere(self, points: ArrayLike, radius: float) -> tuple[Array, Array]:
        """Return the ellipse that is the outline of a sphere in the picture.

        A sphere of radius r at distance d, at the angle t from the optical axis, fills a cone of
        half angle p with sin p = r / d (4). Its picture is an ellipse, whose longer axis points to
        the middle of the picture. At unit focal length,

        * its centre is at the distance a = (tan(t - p) + tan(t + p)) / 2 from the middle (5), which
          is slightly further than the projection of the sphere's own centre
        * its half length is (tan(t + p) - tan(t - p)) / 2 (5)
        * its half width b follows from (a sin t + cos t)^2 = cos(p)^2 (a^2 + b^2 + 1) (6)

        Args:
            points: Centres of the sphere (..., 3), m.
            radius: Radius of the sphere, m.

        Returns:
            Centre (..., 2) and semi-axes (..., 2) of the ellipse in pixels, the longer axis first;
            NaN where the sphere is not wholly in front of the camera.
        """
        camera_points = self.to_camera_frame(points)
        sideways = camera_points[..., :2]  # right and down, m
        depth = camera_points[..., 2]
        distances = np.linalg.norm(camera_points, axis=-1)
        lateral_distance = np.hypot(sideways[..., 0], sideways[..., 1])
        with np.errstate(invalid="ignore", divide="ignore"):
            half_angle = np.arcsin(radius / distances)  # p of (4)
            tilt = np.arctan2(lateral_distance, depth)  # t
            # The section is no ellipse if the cone reaches the plane of the camera.
            tilt = np.where(tilt + half_angle < math.pi / 2, tilt, np.nan)
            near_end = np.tan(tilt - half_angle)
            far_end = np.tan(tilt + half_angle)
            centre_distance = (near_end + far_end) / 2  # a of (5)
            axis_component = centre_distance * np.sin(tilt) + np.cos(tilt)
            ratio = axis_component / np.cos(half_angle)
            squared_semi_axis = ratio**2 - centre_distance**2 - 1  # b^2 of (6)
            # In the middle of the picture the direction is arbitrary.
            divisor = np.where(lateral_distance > 0, lateral_distance, 1.0)
            direction = sideways / divisor[..., None]
        centre = self.principal_point + self.focal * centre_distance[..., None] * direction
        semi_major_axis = (far_end - near_end) / 2  # (5)
        semi_minor_axis = np.sqrt(squared_semi_axis)
        return centre, self.focal * np.stack([semi_major_axis, semi_minor_axis], axis=-1)

    def estimate_heights(self, centres: ArrayLike, x: float, y: float, radius: float) -> Array:
        """Estimate the heights of a ball on a vertical line from the centres of its outlines.

        In the camera frame (right X, down Y, depth Z), a point on that vertical line is
        base + z up. The projection says that its first two coordinates are k times its depth, with
        the pixel coordinates k = (u - u0, v - v0) / f, where f is the focal length and (u0, v0) the
        principal point. So

            (7)  (base_XY - k base_Z) + z (up_XY - k up_Z) = 0

        These two equations are solved for z by least squares. The outline of a ball is not centred
        at the projection of its centre. This small offset depends on the height; so it is computed
        from the height found and subtracted from the pixels, in `_REFINEMENT_COUNT` iterations.

        Args:
            centres: Centres of the outlines (..., 2), pixels.
            x: First horizontal coordinate of the vertical line, m.
            y: Second horizontal coordinate of the vertical line, m.
            radius: Radius of the ball, m.

        Returns:
            Heights (...) of the ball's centre, m.
        """
        pixels = np.asarray(centres, dtype=np.float64)
        base = self.to_camera_frame((x, y, 0.0))
        up = self.axes[:, 2]
        offset: Array = np.zeros_like(pixels)
        z: Array = np.full(pixels.shape[:-1], np.nan)
        for _ in range(_REFINEMENT_COUNT):
            k = (pixels - offset - self.principal_point) / self.focal
            # Equations (7): constant + z slope = 0, for X and Y.
            constant = base[:2] - k * base[2]
            slope = up[:2] - k * up[2]
            z = -(constant * slope).sum(axis=-1) / (slope * slope).sum(axis=-1)
            ones = np.ones_like(z)
            points = np.stack([x * ones, y * ones, z], axis=-1)
            outline_centres, _ = self.project_sphere(points, radius)
            offset = outline_centres - self.project(points)
        return z


_CAMERA_ENTRY_SIZES = {
    "azimuth": 1,
    "distance": 1,
    "height": 1,
    "field_of_view": 1,
    "target": 3,
    "size": 2,
}
"""Entries of [camera] and how many numbers each has."""

_BALL_ENTRY_SIZES = {"radius": 1, "x": 1, "y": 1}
"""Entries of [ball] and how many numbers each has."""


@dataclass(frozen=True)
class FilmDescription:
    """Camera, and a ball of `radius` [m] on the vertical through x, y [m]."""

    camera: PinholeCamera
    radius: float
    x: float = 0.0
    y: float = 0.0


def get_camera_file_path(video: Path) -> Path:
    """Return the path of the camera description of a film."""
    return video.with_suffix(".camera.toml")


def format_camera_file(filmed: FilmDescription) -> str:
    """Format the text of `NAME.camera.toml`."""
    import tomli_w

    camera = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(filmed.camera).items()}
    return tomli_w.dumps(
        {"camera": camera, "ball": {"radius": filmed.radius, "x": filmed.x, "y": filmed.y}}
    )


def read_camera_file(path: Path) -> FilmDescription:
    """Read `NAME.camera.toml`.

    Raises:
        InputError: The file is malformed; the message is one line.
    """
    meta = read_toml(path)
    # All entries are required: a partly default camera would give wrong lengths silently.
    camera = _read_section(path, "camera", meta, _CAMERA_ENTRY_SIZES)
    ball = _read_section(path, "ball", meta, _BALL_ENTRY_SIZES)
    if ball["radius"] <= 0:
        raise make_error(path, "ball.radius", "more than 0 m", ball["radius"])
    # Sizes are integers, but may be written as floats in TOML.
    camera["size"] = tuple(int(n) for n in camera["size"])
    try:
        return FilmDescription(PinholeCamera(**camera), **ball)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _read_section(
    path: Path, section: str, meta: Mapping[str, Any], counts: Mapping[str, int]
) -> dict[str, Any]:
    """Read all entries of a section, each a number or a tuple of the required length.

    Args:
        path: path of the camera file, for messages.
        section: name of the section.
        meta: content of the file.
        counts: number of values of each entry; 1 stands for a number, which is not in a list.

    Returns:
        A number or a tuple of numbers for each entry.

    Raises:
        InputError: an entry is missing, unknown, or has another number of values.
    """
    table = check_table(path, section, meta.get(section))
    check_known_names(f"entry in [{section}] of {path}", table, counts)
    values: dict[str, Any] = {}
    for name, count in counts.items():
        key, value = f"{section}.{name}", table.get(name)
        if count == 1:
            values[name] = check_finite(path, key, value)
        else:
            numbers = check_number_list(path, key, value, count)
            values[name] = tuple(check_finite(path, key, number) for number in numbers)
    return values
