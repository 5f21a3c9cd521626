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
from numpy.typing import NDArray

from sims import bullet
from sims.base import Array
from sims.camera.camera import Camera
from sims.camera.look import Look
from sims.camera.sphere import sphere

Image: TypeAlias = NDArray[np.uint8]
"""A picture (height, width, 3), red, green, blue."""

_NEAR, _FAR = 0.2, 200.0
_GROUND = 60.0
_MARGIN, _SMALL = 2, 20


class Stage:
    """A scene, a ball and a camera, ready to film.

    Args:
        camera: where from.
        look: colours, light, noise.
        radius: of the ball, m.
        rng: the camera's noise.
    """

    def __init__(self, camera: Camera, look: Look, radius: float, rng: np.random.Generator) -> None:
        self.camera, self.look, self.radius, self._rng = camera, look, radius, rng
        p = bullet.engine()
        self._client: int = p.connect(p.DIRECT)
        self.close = weakref.finalize(self, p.disconnect, self._client)
        ground = self._body(p.GEOM_BOX, look.ground, halfExtents=[_GROUND, _GROUND, 0.05])
        p.resetBasePositionAndOrientation(
            ground, (0, 0, -0.05), (0, 0, 0, 1), physicsClientId=self._client
        )
        width, height = camera.size
        self._rays = self._directions()
        picture, covered = self._render((0, 0, width, height), 1, ground)
        p.removeBody(ground, physicsClientId=self._client)
        self._still = self._background(picture, covered)
        points, faces = sphere()
        corners = (radius * points).tolist()
        self._ball = self._body(
            p.GEOM_MESH, look.ball, vertices=corners, indices=faces, normals=points.tolist()
        )

    def film(self, positions: Iterable[Array]) -> Iterator[Image]:
        """One frame for each position (3,) of the ball's centre, m."""
        return (self.frame(np.asarray(position, dtype=np.float64)) for position in positions)

    def frame(self, position: Array) -> Image:
        """The picture with the ball's centre at `position` (3,), m."""
        picture = self._still.copy()
        self._cast_shadow(picture, position)
        self._draw_ball(picture, position)
        if self.look.noise > 0:
            picture += self.look.noise * self._rng.standard_normal(picture.shape, dtype=np.float32)
        return (picture + 0.5).clip(0, 255).astype(np.uint8)

    def _body(self, shape: int, colour: tuple[float, float, float], **size: object) -> int:
        p = bullet.engine()
        visual = p.createVisualShape(
            shape, rgbaColor=[*colour, 1.0], physicsClientId=self._client, **size
        )
        body: int = p.createMultiBody(0.0, -1, visual, physicsClientId=self._client)
        return body

    def _directions(self) -> Array:
        """For each pixel the world vector (height, width, 3) along which the camera looks."""
        v, u = np.mgrid[: self.camera.size[1], : self.camera.size[0]]
        right, down, forward = self.camera.axes
        a, b = (
            (u - self.camera.middle[0]) / self.camera.focal,
            (v - self.camera.middle[1]) / self.camera.focal,
        )
        result: Array = a[..., None] * right + b[..., None] * down + forward
        return result

    def _background(
        self, picture: NDArray[np.float32], covered: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        with np.errstate(divide="ignore"):
            far = -self.camera.position[2] / self._rays[..., 2]
        meets = (covered[..., 0] > 0.5) & (far > 0)
        points = self.camera.position + np.where(meets, far, 0.0)[..., None] * self._rays
        self._points = points.astype(np.float32)
        self._open = meets
        bright = self.look.pattern(points[..., 0], points[..., 1])
        sky = 255 * np.array(self.look.sky)
        return np.where(meets[..., None], picture * bright[..., None], sky).astype(np.float32)

    def _cast_shadow(self, picture: NDArray[np.float32], position: Array) -> None:
        """Darken the ground from which the ball hides the light; its edge is as soft as the sun's
        disc is wide.
        """
        light = self.look.light
        stretch, travel = 1 / light[2], position[2] / light[2]
        foot = position - travel * light
        corners = foot + self.radius * stretch * 1.1 * np.array(
            [(a, b, 0.0) for a in (-1, 1) for b in (-1, 1)]
        )
        window = _window(self.camera.project(corners), self.camera.size)
        if window is None:
            return
        place = np.s_[window[1] : window[3], window[0] : window[2]]
        away = self._points[place] - foot.astype(np.float32)
        along = away @ light.astype(np.float32)
        distance = np.sqrt(np.maximum((away * away).sum(axis=-1) - along * along, 0))
        soft = 0.02 * self.radius + 0.01 * travel
        hidden = np.clip((self.radius + soft - distance) / (2 * soft), 0, 1) * self._open[place]
        picture[place] *= (1 - self.look.shadow * hidden)[..., None].astype(np.float32)

    def _draw_ball(self, picture: NDArray[np.float32], position: Array) -> None:
        centre, (longer, _) = self.camera.outline(position, self.radius)
        reach = longer + _MARGIN
        if not np.isfinite(reach):
            return
        window = _window(np.array([centre - reach, centre + reach]), self.camera.size)
        if window is None:
            return
        p = bullet.engine()
        p.resetBasePositionAndOrientation(
            self._ball, position, (0, 0, 0, 1), physicsClientId=self._client
        )
        ball, covered = self._render(window, 3 if longer < _SMALL else 2, self._ball)
        place = np.s_[window[1] : window[3], window[0] : window[2]]
        picture[place] = covered * ball + (1 - covered) * picture[place]

    def _render(
        self, window: tuple[int, int, int, int], fine: int, body: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """A window (left, top, right, bottom) of the picture: colours of `body`, and its share of
        each pixel.
        """
        p = bullet.engine()
        camera = self.camera
        left, top, right, bottom = window
        width, height = right - left, bottom - top
        at = _NEAR / camera.focal
        # the renderer counts pixels from their corner: half a fine pixel, measured on spheres
        u, v = camera.middle - (0.5 / fine, -0.5 / fine)
        projection = p.computeProjectionMatrix(
            at * (left - 0.5 - u),
            at * (right - 0.5 - u),
            -at * (bottom - 0.5 - v),
            -at * (top - 0.5 - v),
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
        there = np.reshape(bodies, (height, fine, width, fine, 1)) == body
        share = there.mean(axis=(1, 3), dtype=np.float32)
        colour = np.reshape(colours, (height, fine, width, fine, 4))[..., :3]
        sums = np.where(there, colour, 0).sum(axis=(1, 3), dtype=np.float32)
        return sums / np.maximum(share * fine**2, 1), share


def _window(pixels: Array, size: tuple[int, int]) -> tuple[int, int, int, int] | None:
    """The part of the picture (left, top, right, bottom) that holds `pixels` (n, 2); None if they
    lie outside.
    """
    if not np.isfinite(pixels).all():
        return None
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    left, top = (max(0, math.floor(x)) for x in low)
    right, bottom = (min(end, math.ceil(x) + 1) for x, end in zip(high, size, strict=True))
    return (left, top, right, bottom) if left < right and top < bottom else None
