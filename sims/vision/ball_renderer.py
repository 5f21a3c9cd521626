"""Render films of a ball: its mesh, and the appearance of the scene.

The static scene is rendered once. In each frame only a window around the ball is rendered, at two
or three times the resolution and then averaged, so that edges are smooth as through a lens and a
frame costs a fraction of a whole picture. Ground pattern, shadow and camera noise are added with
NumPy: the renderer has no procedural textures, and its shadow map darkens flat ground by itself.
"""

from __future__ import annotations

import colorsys
import functools
import math
import weakref
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull

from sims.core.simulator import Array, make_read_only
from sims.engines.external import bullet_world
from sims.vision.pinhole_camera import PinholeCamera

_MIN_CONTRAST = 0.3
"""Minimum difference between ball and ground in some colour, on a scale from 0 to 1."""
_WAVE_COUNT = 6
"""Number of waves whose sum is the ground's pattern."""
_MIN_LIGHT_ELEVATION = np.pi / 6
"""Minimum elevation of the light, rad (30 degrees)."""
_MAX_LIGHT_ELEVATION = np.pi / 2.25
"""Maximum elevation of the light, rad (80 degrees)."""
_BALL_VALUE = (0.15, 1.0)
"""Range of the brightness of balls, on a scale from 0 to 1; black is excluded."""


@dataclass(frozen=True)
class SceneAppearance:
    """Appearance of a scene; colours are red, green, blue from 0 to 1.

    Attributes:
        light: Unit vector (3,) towards the light.
        ball: Colour of the ball.
        ground: Colour of the ground.
        sky: Colour above the horizon.
        waves: Pattern of the ground, rows of (wave vector x, y in rad/m, phase in rad, amplitude as
            a fraction of brightness).
        shadow: Fraction of the light that the ball's shadow removes.
        noise: Standard deviation of the camera noise, grey levels of 255.
        crf: Constant rate factor of the video encoder: 0 is lossless, above 30 is coarse.
    """

    light: Array
    ball: tuple[float, float, float]
    ground: tuple[float, float, float]
    sky: tuple[float, float, float]
    waves: Array
    shadow: float = 0.4
    noise: float = 1.0
    crf: int = 20

    @classmethod
    def draw(cls, rng: np.random.Generator) -> SceneAppearance:
        """Draw a random appearance: light, colours, pattern of the ground, shadow, noise.

        The light is 30 to 80 degrees above the ground, and the colours of ball and ground are
        distinguishable.

        Args:
            rng: Random number generator.
        """
        # The order of the draws must not change, because it determines the result of a seed.
        azimuth = rng.uniform(0, 2 * np.pi)
        elevation = rng.uniform(_MIN_LIGHT_ELEVATION, _MAX_LIGHT_ELEVATION)
        horizontal = np.cos(elevation)
        light = [
            horizontal * np.cos(azimuth),
            horizontal * np.sin(azimuth),
            np.sin(elevation),
        ]
        # A ball of any colour, on a ground from grey to weakly coloured, below a bright sky.
        ground = _draw_colour(rng, saturation=(0.0, 0.4), value=(0.3, 0.85))
        ball = _draw_colour(rng, saturation=(0.0, 1.0), value=_BALL_VALUE)
        while np.max(np.abs(np.subtract(ball, ground))) < _MIN_CONTRAST:
            ball = _draw_colour(rng, saturation=(0.0, 1.0), value=_BALL_VALUE)
        sky = _draw_colour(rng, saturation=(0.0, 0.3), value=(0.7, 1.0))
        full_turn = 2 * np.pi
        # Each wave has 0.5 to 6 rad/m and changes the brightness of the ground by up to 4 %.
        bearing = rng.uniform(0, full_turn, _WAVE_COUNT)
        wave_number = rng.uniform(0.5, 6.0, _WAVE_COUNT)
        phase = rng.uniform(0, full_turn, _WAVE_COUNT)
        amplitude = rng.uniform(0.0, 0.04, _WAVE_COUNT)
        wave_x = wave_number * np.cos(bearing)
        wave_y = wave_number * np.sin(bearing)
        waves = np.stack([wave_x, wave_y, phase, amplitude], axis=1)
        return cls(
            make_read_only(light),
            ball,
            ground,
            sky,
            make_read_only(waves),
            shadow=rng.uniform(0.2, 0.6),
            noise=rng.uniform(0.5, 2.5),  # grey levels
            crf=int(rng.integers(14, 24)),
        )

    def compute_ground_brightness(self, x: Array, y: Array) -> Array:
        """Return the brightness of the ground at positions (x, y) in m, 1 on average.

        Args:
            x: Positions, any shape.
            y: Positions, of the shape of `x`.
        """
        brightness = np.ones_like(x)
        for kx, ky, phase, amplitude in self.waves:
            brightness += amplitude * np.sin(kx * x + ky * y + phase)
        return brightness


def _draw_colour(
    rng: np.random.Generator,
    saturation: tuple[float, float],
    value: tuple[float, float],
) -> tuple[float, float, float]:
    """Draw a colour with any hue, and with saturation and value in the given ranges."""
    return colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(*saturation), rng.uniform(*value))


_SUBDIVISIONS = 3
"""Number of subdivisions of the icosahedron's faces; the silhouette is then round to 0.3 %."""


@functools.cache
def make_sphere_mesh() -> tuple[Array, tuple[int, ...]]:
    """Return a triangle mesh of the unit sphere.

    Each face of an icosahedron is divided into four, repeatedly: the midpoints of the edges are
    moved onto the sphere. The faces are those of the convex hull.

    Returns:
        Points (642, 3), and the corners of the triangles as a flat list of indices, three per
        triangle, anticlockwise as seen from outside.
    """
    golden = (1 + 5**0.5) / 2
    # The 12 corners of an icosahedron are those of three golden rectangles at right angles.
    corners = np.array([(-1, golden, 0), (1, golden, 0), (-1, -golden, 0), (1, -golden, 0)])
    points = np.concatenate([np.roll(corners, shift, axis=1) for shift in range(3)])
    points /= np.hypot(1, golden)
    for _ in range(_SUBDIVISIONS):
        faces = ConvexHull(points).simplices
        edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)), axis=0)
        middles = points[edges].sum(axis=1)
        middles /= np.linalg.norm(middles, axis=1, keepdims=True)
        points = np.concatenate([points, middles])
    faces = ConvexHull(points).simplices
    # Order the corners of each face such that its normal points outwards.
    a, b, c = points[faces.T]
    is_inward = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    faces[is_inward] = faces[is_inward, ::-1]
    return make_read_only(points), tuple(faces.ravel().tolist())


RgbImage: TypeAlias = NDArray[np.uint8]
"""Picture (height, width, 3): red, green, blue."""
ColourArray: TypeAlias = NDArray[np.float32]
"""Picture in floating-point grey levels; or each pixel's coverage (height, width, 1)."""
PixelWindow: TypeAlias = tuple[int, int, int, int]
"""Part of a picture in pixels: left, top, right (exclusive), bottom (exclusive)."""

_NEAR_PLANE = 0.2
"""Distance from the camera below which nothing is drawn, m."""
_FAR_PLANE = 200.0
"""Distance from the camera beyond which nothing is drawn, m."""
_HALF_GROUND_SIDE = 60.0
"""Half the side length of the ground, m."""
_HALF_GROUND_THICKNESS = 0.05
"""Half the thickness of the ground, whose upper side is at height 0, m."""
_OUTLINE_MARGIN_PIXELS = 2
"""Number of pixels around the ball's outline that are rendered with it."""
_FINE_RENDER_RADIUS = 20
"""Radius in pixels below which a ball is rendered three times finer; larger ones twice."""
_MIN_SHADOW_EDGE = 0.02
"""Half the width of a shadow's edge where the ball is on the ground, in ball radii."""
_SUN_ANGLE = 0.01
"""Growth of the shadow's edge per distance from ball to ground, as from the sun's disc, rad."""


class BallScene:
    """Scene with ground, ball and camera, ready to be rendered.

    Args:
        camera: Camera.
        appearance: Colours, light and noise.
        radius: Radius of the ball, m.
        rng: Random number generator for the camera noise.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        appearance: SceneAppearance,
        radius: float,
        rng: np.random.Generator,
    ) -> None:
        """Render the background once, and create the ball's mesh.

        `_client` is the number of PyBullet's renderer, `_view_directions` the viewing direction of
        each pixel, `_background` the scene without the ball, and `_ball` the body of the ball.

        Args:
            camera: Camera that does not move.
            appearance: Colours, light and noise of the pictures.
            radius: Radius of the ball in m.
            rng: Random generator of the noise.
        """
        self.camera = camera
        self.appearance = appearance
        self.radius = radius
        self._rng = rng
        pybullet = bullet_world.import_pybullet()
        self._client: int = pybullet.connect(pybullet.DIRECT)
        self.close = weakref.finalize(self, pybullet.disconnect, self._client)
        extents = [_HALF_GROUND_SIDE, _HALF_GROUND_SIDE, _HALF_GROUND_THICKNESS]
        ground = self._create_body(pybullet.GEOM_BOX, appearance.ground, halfExtents=extents)
        self._move_body(ground, (0, 0, -_HALF_GROUND_THICKNESS))
        width, height = camera.size
        full_window = 0, 0, width, height
        self._view_directions = self._compute_view_directions()
        picture, coverage = self._render_body(full_window, 1, ground)
        # Frames are rendered without the ground, because it does not change.
        pybullet.removeBody(ground, physicsClientId=self._client)
        self._background = self._render_background(picture, coverage)
        points, faces = make_sphere_mesh()
        self._ball = self._create_body(
            pybullet.GEOM_MESH,
            appearance.ball,
            vertices=(radius * points).tolist(),
            indices=faces,
            # Normals of the sphere instead of its faces, for smooth shading.
            normals=points.tolist(),
        )

    def render_frames(self, positions: Iterable[Array]) -> Iterator[RgbImage]:
        """Render one frame for each position (3,) of the ball's centre, m."""
        return (self.render_frame(np.asarray(position, dtype=np.float64)) for position in positions)

    def render_frame(self, position: Array) -> RgbImage:
        """Render one frame of the film.

        Args:
            position: (3,) centre of the ball, m.

        Returns:
            Picture (height, width, 3) with shadow, ball and noise.
        """
        picture = self._background.copy()
        # The shadow comes first, because the ball may hide a part of it.
        self._cast_shadow(picture, position)
        self._draw_ball(picture, position)
        if self.appearance.noise > 0:
            grain = self._rng.standard_normal(picture.shape, dtype=np.float32)
            picture += self.appearance.noise * grain
        # Add half a grey level, because the conversion to integers truncates.
        return (picture + 0.5).clip(0, 255).astype(np.uint8)

    def _move_body(self, body: int, position: ArrayLike) -> None:
        """Move a body of the scene to a position in m, without rotation."""
        bullet_world.import_pybullet().resetBasePositionAndOrientation(
            body, position, (0, 0, 0, 1), physicsClientId=self._client
        )

    def _create_body(self, shape: int, colour: tuple[float, float, float], **size: object) -> int:
        """Create a body that is only drawn, without mass and collisions, and return its id.

        Args:
            shape: Bullet's constant of the shape, such as `GEOM_BOX`.
            colour: Red, green and blue, 0 to 1.
            size: Arguments of Bullet's shape, such as `halfExtents`.
        """
        pybullet = bullet_world.import_pybullet()
        visual = pybullet.createVisualShape(
            shape,
            rgbaColor=[*colour, 1.0],
            physicsClientId=self._client,
            **size,
        )
        # No mass and no collision shape (-1), because nothing is simulated here.
        body: int = pybullet.createMultiBody(0.0, -1, visual, physicsClientId=self._client)
        return body

    def _compute_view_directions(self) -> Array:
        """Return the viewing direction of each pixel as world vectors (height, width, 3).

        They are the inverse of the projection at depth 1: their component along the camera's
        forward axis is 1, so they are longer than unit vectors.
        """
        width, height = self.camera.size
        v, u = np.mgrid[:height, :width]
        right, down, forward = self.camera.axes
        middle_u, middle_v = self.camera.principal_point
        x = (u - middle_u) / self.camera.focal
        y = (v - middle_v) / self.camera.focal
        result: Array = x[..., None] * right + y[..., None] * down + forward
        return result

    def _render_background(self, picture: ColourArray, coverage: ColourArray) -> ColourArray:
        """Return the scene without the ball, and store the visible ground points for shadows.

        `_ground_points` (height, width, 3) has the ground point that each pixel shows in m, and
        `_shows_ground` (height, width) whether it shows the ground and not the sky.

        Args:
            picture: (height, width, 3) rendered ground.
            coverage: (height, width, 1) fraction of each pixel that the ground covers.
        """
        # A ray meets the ground at height 0.
        with np.errstate(divide="ignore"):
            ground_distance = -self.camera.position[2] / self._view_directions[..., 2]
        # Without the second condition, rays above the horizon would meet the ground behind the
        # camera.
        is_ground = (coverage[..., 0] > 0.5) & (ground_distance > 0)
        ray_lengths = np.where(is_ground, ground_distance, 0.0)
        points = self.camera.position + ray_lengths[..., None] * self._view_directions
        self._ground_points = points.astype(np.float32)
        self._shows_ground = is_ground
        brightness = self.appearance.compute_ground_brightness(points[..., 0], points[..., 1])
        ground = picture * brightness[..., None]
        sky = 255 * np.array(self.appearance.sky)
        return np.where(is_ground[..., None], ground, sky).astype(np.float32)

    def _cast_shadow(self, picture: ColourArray, position: Array) -> None:
        """Darken the ground in the ball's shadow.

        A ground point is in the shadow if it is closer than the ball's radius to the line through
        the ball's centre along the light. The sun's disc softens the edge, the more the higher the
        ball is.

        Args:
            picture: (height, width, 3) colours in grey levels, changed in place.
            position: (3,) centre of the ball in the world, m.
        """
        light = self.appearance.light
        slant = 1 / light[2]
        # Distance from the ball to the ground along the light, m.
        travel = position[2] / light[2]
        shadow_centre = position - travel * light
        # A square around the shadow: slanting light stretches the disc to an ellipse, and a tenth
        # is added for the soft edge.
        signs = np.array([(-1, -1, 0.0), (-1, 1, 0.0), (1, -1, 0.0), (1, 1, 0.0)])
        corners = shadow_centre + self.radius * slant * 1.1 * signs
        window = _find_window(self.camera.project(corners), self.camera.size)
        if window is None:
            return
        left, top, right, bottom = window
        window_slice = np.s_[top:bottom, left:right]
        offsets = self._ground_points[window_slice] - shadow_centre.astype(np.float32)
        # Distance from that line by Pythagoras; rounding may make the square negative.
        light_components = offsets @ light.astype(np.float32)
        squared_distances = (offsets * offsets).sum(axis=-1)
        squares = squared_distances - light_components * light_components
        distance = np.sqrt(np.maximum(squares, 0))
        edge_half_width = _MIN_SHADOW_EDGE * self.radius + _SUN_ANGLE * travel
        # 0 outside the shadow, 1 inside, and linear across its edge; the sky has no shadow.
        depth = (self.radius + edge_half_width - distance) / (2 * edge_half_width)
        shadow = np.clip(depth, 0, 1) * self._shows_ground[window_slice]
        brightness = 1 - self.appearance.shadow * shadow
        picture[window_slice] *= brightness[..., None].astype(np.float32)

    def _draw_ball(self, picture: ColourArray, position: Array) -> None:
        """Blend the ball into the picture, weighted by its coverage of each pixel.

        Only the window of pixels around the ball is rendered, with several rays for each pixel. A
        ball behind the camera or outside the picture changes nothing.

        Args:
            picture: (height, width, 3) colours in grey levels, changed in place.
            position: (3,) centre of the ball in the world, m.
        """
        centre, (semi_major_axis, _) = self.camera.project_sphere(position, self.radius)
        half_size = semi_major_axis + _OUTLINE_MARGIN_PIXELS
        if not np.isfinite(half_size):
            return
        corners = np.array([centre - half_size, centre + half_size])
        window = _find_window(corners, self.camera.size)
        if window is None:
            return
        self._move_body(self._ball, position)
        oversampling = 3 if semi_major_axis < _FINE_RENDER_RADIUS else 2
        ball, coverage = self._render_body(window, oversampling, self._ball)
        left, top, right, bottom = window
        window_slice = np.s_[top:bottom, left:right]
        picture[window_slice] = coverage * ball + (1 - coverage) * picture[window_slice]

    def _render_body(
        self, window: PixelWindow, oversampling: int, body: int
    ) -> tuple[ColourArray, ColourArray]:
        """Render a body in a window of the picture.

        PyBullet's software renderer draws the window with several fine pixels per pixel, which are
        averaged, so that edges are smooth.

        Args:
            window: Window (left, top, right, bottom) in pixels.
            oversampling: Number of fine pixels per pixel in each direction.
            body: Id of the body.

        Returns:
            Mean colours of the body in grey levels (height, width, 3), and the fraction of each
            pixel that it covers (height, width, 1).
        """
        pybullet = bullet_world.import_pybullet()
        camera = self.camera
        left, top, right, bottom = window  # right and bottom are exclusive
        width = right - left
        height = bottom - top
        # Size of a pixel on the near plane, m.
        pixel_size = _NEAR_PLANE / camera.focal
        # The renderer counts pixels from their corner: shift by half a fine pixel, measured on
        # spheres.
        shift = 0.5 / oversampling
        u, v = camera.principal_point - (shift, -shift)
        # The edges of the window are half a pixel outside the centres of its outermost pixels.
        left_edge = left - 0.5 - u
        right_edge = right - 0.5 - u
        lower_edge = bottom - 0.5 - v
        upper_edge = top - 0.5 - v
        # The renderer's vertical axis points up, but the rows of a picture are counted downwards.
        projection = pybullet.computeProjectionMatrix(
            pixel_size * left_edge,
            pixel_size * right_edge,
            -pixel_size * lower_edge,
            -pixel_size * upper_edge,
            _NEAR_PLANE,
            _FAR_PLANE,
        )
        view = pybullet.computeViewMatrix(camera.position, camera.target, (0, 0, 1))
        _, _, colours, _, bodies = pybullet.getCameraImage(
            width * oversampling,
            height * oversampling,
            view,
            projection,
            lightDirection=self.appearance.light.tolist(),
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )
        # Average the fine pixels of each pixel; only colours of the body itself count.
        grouped = height, oversampling, width, oversampling
        is_body = np.reshape(bodies, (*grouped, 1)) == body
        coverage = is_body.mean(axis=(1, 3), dtype=np.float32)
        colour = np.reshape(colours, (*grouped, 4))[..., :3]  # without transparency
        sums = np.where(is_body, colour, 0).sum(axis=(1, 3), dtype=np.float32)
        # At least 1, so that pixels without the body are not divided by zero.
        count = np.maximum(coverage * oversampling**2, 1)
        return sums / count, coverage


def _find_window(pixels: Array, size: tuple[int, int]) -> PixelWindow | None:
    """Return the smallest window of the picture that contains some positions.

    Args:
        pixels: (n, 2) positions in pixels; they may be outside the picture.
        size: width and height of the picture, pixels.

    Returns:
        The window; None if all positions are outside on one side, or one of them is not finite.
    """
    if not np.isfinite(pixels).all():
        return None
    width, height = size
    (first_u, first_v), (last_u, last_v) = pixels.min(axis=0), pixels.max(axis=0)
    left, top = max(0, math.floor(first_u)), max(0, math.floor(first_v))
    right = min(width, math.ceil(last_u) + 1)
    bottom = min(height, math.ceil(last_v) + 1)
    if left < right and top < bottom:
        return left, top, right, bottom
    return None
