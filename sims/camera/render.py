"""Films of a ball, rendered by Bullet's processor-only renderer (TinyRenderer), without a window.

What does not move is rendered once. Of each frame only a window around the ball is rendered,
several times finer than the picture and then averaged, so that edges are smooth as a lens makes
them and a frame costs a fraction of what the whole picture would. Ground pattern, shadow and camera
noise are laid over in numpy: the renderer has no procedural textures, and its shadow map darkens
flat ground by itself.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterable, Iterator
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sims import bullet
from sims.base import Array
from sims.camera.camera import Camera
from sims.camera.look import Look
from sims.camera.sphere import sphere

Image: TypeAlias = NDArray[np.uint8]
"""A picture (height, width, 3), red, green, blue."""
Colours: TypeAlias = NDArray[np.float32]
"""The same while it is worked at, in grey levels; or each pixel's share (height, width, 1)."""
Window: TypeAlias = tuple[int, int, int, int]
"""A part of a picture: left, top, behind its right, below its bottom."""

_NEAR = 0.2
"""m from the camera; what is closer is not drawn."""
_FAR = 200.0
"""m from the camera; what is further is not drawn."""
_GROUND = 60.0
"""m, half the side of the ground."""
_THICKNESS = 0.05
"""m, half that of the ground, whose upper side is at height 0."""
_MARGIN = 2
"""Pixels around the ball's outline that are rendered with it."""
_SMALL = 20
"""Pixels; a ball of a smaller radius is rendered three times finer, a larger one twice."""
_SHARPEST = 0.02
"""Of the ball's radius: half the width of a shadow's edge where the ball lies on the ground."""
_SUN = 0.01
"""rad; how much wider the edge gets with the way from ball to ground, as from the sun's disc."""


class Stage:
    """A scene, a ball and a camera, ready to film.

    Args:
        camera: where from.
        look: colours, light, noise.
        radius: of the ball, m.
        rng: the camera's noise.
    """

    def __init__(self, camera: Camera, look: Look, radius: float, rng: np.random.Generator) -> None:
        self.camera = camera
        self.look = look
        self.radius = radius
        self._rng = rng
        p = bullet.engine()
        self._client: int = p.connect(p.DIRECT)
        self.close = weakref.finalize(self, p.disconnect, self._client)
        extents = [_GROUND, _GROUND, _THICKNESS]
        ground = self._body(p.GEOM_BOX, look.ground, halfExtents=extents)
        self._place(ground, (0, 0, -_THICKNESS))
        width, height = camera.size
        everything = 0, 0, width, height
        self._rays = self._directions()
        picture, covered = self._render(everything, 1, ground)
        # frames are rendered without it: it does not change
        p.removeBody(ground, physicsClientId=self._client)
        self._still = self._background(picture, covered)
        points, faces = sphere()
        self._ball = self._body(
            p.GEOM_MESH,
            look.ball,
            vertices=(radius * points).tolist(),
            indices=faces,
            # of the sphere and not of its faces, so that shading is smooth
            normals=points.tolist(),
        )

    def film(self, positions: Iterable[Array]) -> Iterator[Image]:
        """One frame for each position (3,) of the ball's centre, m."""
        return (self.frame(np.asarray(position, dtype=np.float64)) for position in positions)

    def frame(self, position: Array) -> Image:
        """The picture with the ball's centre at `position` (3,), m."""
        picture = self._still.copy()
        # the shadow first: the ball may hide a part of it
        self._cast_shadow(picture, position)
        self._draw_ball(picture, position)
        if self.look.noise > 0:
            grain = self._rng.standard_normal(picture.shape, dtype=np.float32)
            picture += self.look.noise * grain
        # half a level, since the conversion to whole ones cuts off
        return (picture + 0.5).clip(0, 255).astype(np.uint8)

    def _place(self, body: int, position: ArrayLike) -> None:
        bullet.engine().resetBasePositionAndOrientation(
            body, position, (0, 0, 0, 1), physicsClientId=self._client
        )

    def _body(self, shape: int, colour: tuple[float, float, float], **size: object) -> int:
        p = bullet.engine()
        visual = p.createVisualShape(
            shape,
            rgbaColor=[*colour, 1.0],
            physicsClientId=self._client,
            **size,
        )
        # no mass and no collision shape: nothing is simulated here
        body: int = p.createMultiBody(0.0, -1, visual, physicsClientId=self._client)
        return body

    def _directions(self) -> Array:
        """For each pixel the world vector (height, width, 3) along which the camera looks."""
        v, u = np.mgrid[: self.camera.size[1], : self.camera.size[0]]
        right, down, forward = self.camera.axes
        # (2) of sims.camera.camera, for depth 1 and turned round
        middle_u, middle_v = self.camera.middle
        a = (u - middle_u) / self.camera.focal
        b = (v - middle_v) / self.camera.focal
        result: Array = a[..., None] * right + b[..., None] * down + forward
        return result

    def _background(self, picture: Colours, covered: Colours) -> Colours:
        """The scene without the ball, from the rendered ground and its share of each pixel.

        Keeps for shadows where the ground is that each pixel shows, and whether it shows any.
        """
        # a ray meets the ground where its height is 0
        with np.errstate(divide="ignore"):
            far = -self.camera.position[2] / self._rays[..., 2]
        # without the second, what is above the horizon would meet it behind the camera
        meets = (covered[..., 0] > 0.5) & (far > 0)
        along = np.where(meets, far, 0.0)
        points = self.camera.position + along[..., None] * self._rays
        self._points = points.astype(np.float32)
        self._open = meets
        bright = self.look.pattern(points[..., 0], points[..., 1])
        ground = picture * bright[..., None]
        sky = 255 * np.array(self.look.sky)
        return np.where(meets[..., None], ground, sky).astype(np.float32)

    def _cast_shadow(self, picture: Colours, position: Array) -> None:
        """Darken the ground from which the ball hides the light; its edge is as soft as the sun's
        disc is wide.
        """
        light = self.look.light
        stretch = 1 / light[2]
        travel = position[2] / light[2]
        # where the line through the ball's centre along the light meets the ground
        foot = position - travel * light
        signs = np.array(
            [
                (-1, -1, 0.0),
                (-1, 1, 0.0),
                (1, -1, 0.0),
                (1, 1, 0.0),
            ]
        )
        # a slanting light makes the disc an ellipse, longer by the stretch
        corners = foot + self.radius * stretch * 1.1 * signs
        window = _window(self.camera.project(corners), self.camera.size)
        if window is None:
            return
        left, top, right, bottom = window
        place = np.s_[top:bottom, left:right]
        away = self._points[place] - foot.astype(np.float32)
        # distance from that line, by Pythagoras; rounding may make it slightly imaginary
        along = away @ light.astype(np.float32)
        far = (away * away).sum(axis=-1)
        squares = far - along * along
        distance = np.sqrt(np.maximum(squares, 0))
        soft = _SHARPEST * self.radius + _SUN * travel
        depth = (self.radius + soft - distance) / (2 * soft)
        hidden = np.clip(depth, 0, 1) * self._open[place]
        left_over = 1 - self.look.shadow * hidden
        picture[place] *= left_over[..., None].astype(np.float32)

    def _draw_ball(self, picture: Colours, position: Array) -> None:
        """Lay the ball over the picture, each pixel by the share that the ball has of it."""
        centre, (longer, _) = self.camera.outline(position, self.radius)
        reach = longer + _MARGIN
        if not np.isfinite(reach):
            return
        around = np.array([centre - reach, centre + reach])
        window = _window(around, self.camera.size)
        if window is None:
            return
        self._place(self._ball, position)
        fine = 3 if longer < _SMALL else 2
        ball, covered = self._render(window, fine, self._ball)
        left, top, right, bottom = window
        place = np.s_[top:bottom, left:right]
        picture[place] = covered * ball + (1 - covered) * picture[place]

    def _render(self, window: Window, fine: int, body: int) -> tuple[Colours, Colours]:
        """A window (left, top, right, bottom) of the picture: colours of `body`, and its share of
        each pixel.
        """
        p = bullet.engine()
        camera = self.camera
        left, top, right, bottom = window
        width = right - left
        height = bottom - top
        # metres on the near plane that a pixel shows
        at = _NEAR / camera.focal
        # the renderer counts pixels from their corner: half a fine pixel, measured on spheres
        shift = 0.5 / fine
        u, v = camera.middle - (shift, -shift)
        # edges of the window, half a pixel from the centres of its outermost ones
        left_edge = left - 0.5 - u
        right_edge = right - 0.5 - u
        lower_edge = bottom - 0.5 - v
        upper_edge = top - 0.5 - v
        projection = p.computeProjectionMatrix(
            at * left_edge,
            at * right_edge,
            -at * lower_edge,
            -at * upper_edge,
            _NEAR,
            _FAR,
        )
        view = p.computeViewMatrix(camera.position, camera.target, (0, 0, 1))
        _, _, colours, _, bodies = p.getCameraImage(
            width * fine,
            height * fine,
            view,
            projection,
            lightDirection=self.look.light.tolist(),
            shadow=0,
            renderer=p.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )
        # fine pixels in groups that make one each; colours of the body alone are averaged
        grouped = height, fine, width, fine
        there = np.reshape(bodies, (*grouped, 1)) == body
        share = there.mean(axis=(1, 3), dtype=np.float32)
        colour = np.reshape(colours, (*grouped, 4))[..., :3]
        sums = np.where(there, colour, 0).sum(axis=(1, 3), dtype=np.float32)
        count = np.maximum(share * fine**2, 1)
        return sums / count, share


def _window(pixels: Array, size: tuple[int, int]) -> Window | None:
    """The part of the picture (left, top, right, bottom) that holds `pixels` (n, 2); None if they
    lie outside.
    """
    if not np.isfinite(pixels).all():
        return None
    left, top = (max(0, math.floor(x)) for x in pixels.min(axis=0))
    last_u, last_v = pixels.max(axis=0)
    right = min(size[0], math.ceil(last_u) + 1)
    bottom = min(size[1], math.ceil(last_v) + 1)
    if left < right and top < bottom:
        return left, top, right, bottom
    return None
