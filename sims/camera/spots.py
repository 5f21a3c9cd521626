"""Round things that differ from the background in one picture, measured to a fraction of a pixel.

What differs is divided into connected spots. A circle is fitted to each spot's edge, found along
rays from its middle where the difference has fallen to half of what it is inside: there half a
pixel's area is the ball's, whatever its colour. Rays that meet something else (a shadow, the
picture's edge, a patch of like colour) lie off the circle and are left out; a spot for which too
few agree is no ball.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sims.base import Array
from sims.camera import circle
from sims.camera.packages import imported
from sims.camera.render import Image

_RAYS = 36
_LEAST_AREA = 6
_LEAST_LEVEL = 12.0
_AGREE = 0.6
_GOOD = 0.85
_MOST_SPOTS = 4
_TINY = 2.5
_ROUNDS = 3
_STILL = 0.02
_FINE = 0.25
_LOOSE = 0.5
_RIM = 5
_AROUND = 1.6
_SHADE = (0.25, 0.97)


class Spot(NamedTuple):
    """A ball-like thing: middle and radius of its outline in pixels, the share of rays that agree,
    their scatter.

    `edges` (n, 2) are the points of its edge to which the circle was fitted; none for a ball of a
    few pixels. `colour` is that of its middle, `contrast` how far that is from the background
    there, in grey levels. A `ghost` is a ball or shadow in the background that the picture lacks.
    """

    u: float
    v: float
    radius: float
    agree: float
    scatter: float
    edges: Array = np.empty((0, 2))
    colour: tuple[float, ...] = (0.0, 0.0, 0.0)
    contrast: float = 0.0
    ghost: bool = False

    def with_radius(self, radius: float) -> Spot:
        """The same, its middle fitted again to the edge with the radius known from other pictures.

        Where shade hides a part of the edge, the middle and a free radius give way together.
        """
        if len(self.edges) < 0.4 * _RAYS:
            return self
        u, v = self.u, self.v
        for _ in range(12):
            away = self.edges - (u, v)
            far = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-9)
            rest = far - radius
            weights = 1 / (1 + (rest / _LOOSE) ** 2) ** 2
            rows = np.stack([away[:, 0] / far, away[:, 1] / far, rest])
            (a, b, p), (_, c, q), _ = ((rows * weights) @ rows.T).tolist()
            if (area := a * c - b * b) < 1e-6:
                return self
            du, dv = (c * p - b * q) / area, (a * q - b * p) / area
            u, v = u + du, v + dv
            if abs(du) + abs(dv) < 1e-3:
                break
        if np.hypot(u - self.u, v - self.v) > 0.5 * radius:
            return self
        return self._replace(u=u, v=v)


class Finder:
    """Finds spots in pictures of one scene.

    Args:
        background: the scene without the ball.
        sigma: noise, 1 sigma in grey levels.
        shadows: whether what is merely darker than the background is taken for shadow; wrong for a
            ball of the ground's own hue.
    """

    def __init__(self, background: Image, sigma: float, shadows: bool) -> None:
        self.background, self.sigma, self.shadows = background, sigma, shadows
        self.level = max(_LEAST_LEVEL, 6 * sigma)
        self._plain = background.astype(np.float32)
        cv2 = imported("cv2")
        self._grey = cv2.cvtColor(background, cv2.COLOR_RGB2GRAY)
        self._square = np.maximum((self._plain * self._plain).sum(axis=2), 1.0)

    def spots(self, picture: Image, ghosts: bool = False) -> list[Spot]:
        """What looks like a ball, the largest first; with the ghosts, if asked for."""
        cv2 = imported("cv2")
        difference = self._difference(picture)
        brightness = cv2.absdiff(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), self._grey)
        mask = (difference > self.level).astype(np.uint8)
        if not mask.any():
            return []
        if self.shadows:
            shade = self._even(picture, mask) > 0
            mask[shade] = 0
            # single pixels that shadow and noise leave
            mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        else:
            shade = np.zeros(mask.shape, bool)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        large = sorted(((len(c), i) for i, c in enumerate(contours) if len(c) > 3), reverse=True)[
            :_MOST_SPOTS
        ]
        found = [self._spot(contours[i], (brightness, difference), shade) for _, i in large]
        seen = [self._coloured(spot, picture) for spot in found if spot is not None]
        return seen if ghosts else [spot for spot in seen if not spot.ghost]

    def _coloured(self, spot: Spot, picture: Image) -> Spot:
        """The spot with the colour of its middle, and whether it is the background that stands out
        against the rest.
        """
        cv2, side = imported("cv2"), 2 * max(1, int(0.4 * spot.radius)) + 1
        here, behind = (
            cv2.getRectSubPix(part, (side, side), (spot.u, spot.v)).reshape(-1, 3).mean(axis=0)
            for part in (picture, self.background)
        )
        cos, sin = _directions()
        rows = (
            (spot.v + _AROUND * spot.radius * sin[:, 0] + 0.5)
            .astype(np.intp)
            .clip(0, picture.shape[0] - 1)
        )
        columns = (
            (spot.u + _AROUND * spot.radius * cos[:, 0] + 0.5)
            .astype(np.intp)
            .clip(0, picture.shape[1] - 1)
        )
        out, out_behind = (
            np.partition(part[rows, columns], _RAYS // 2, axis=0)[_RAYS // 2].astype(np.float64)
            for part in (picture, self.background)
        )
        contrast = float(np.abs(here - behind).max())
        ghost = self._is_ghost((here, out), (behind, out_behind))
        return spot._replace(colour=tuple(here.tolist()), contrast=contrast, ghost=ghost)

    def unshaded(self, picture: Image) -> NDArray[np.bool_]:
        """Where the picture lacks a shadow that the background has."""
        cv2 = imported("cv2")
        mask = (self._difference(picture) > self.level).astype(np.uint8)
        lighter = (self._even(picture, mask) > 1).astype(np.uint8)
        count, parts, sizes, _ = cv2.connectedComponentsWithStats(lighter)
        gone = np.zeros(mask.shape, bool)
        for part in range(1, count):
            if sizes[part, cv2.CC_STAT_AREA] < _LEAST_AREA:
                continue
            inside = (parts == part).astype(np.uint8)
            near = cv2.dilate(inside, np.ones((3, 3), np.uint8))
            ring = (cv2.dilate(near, np.ones((5, 5), np.uint8)) > 0) & (near == 0) & (mask == 0)
            if not ring.any():
                continue
            here, behind = (
                (np.median(each[inside > 0], axis=0), np.median(each[ring], axis=0))
                for each in (picture, self.background)
            )
            if self._is_ghost(here, behind):
                gone |= inside > 0
        return gone

    def _is_ghost(self, here: tuple[Array, Array], behind: tuple[Array, Array]) -> bool:
        """Whether a thing is in the background and not in the picture: colours (inside, around) of
        both.
        """
        stands_out, stood_out = (
            float(np.abs(inside - around).max()) for inside, around in (here, behind)
        )
        return stood_out > stands_out + self.level / 2

    def _difference(self, picture: Image) -> NDArray[np.uint8]:
        """The largest difference over the colours."""
        cv2 = imported("cv2")
        apart = cv2.absdiff(picture, self.background)
        result: NDArray[np.uint8] = cv2.max(cv2.max(apart[..., 0], apart[..., 1]), apart[..., 2])
        return result

    def _even(self, picture: Image, mask: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The factor by which the picture is the background where that is one in all colours, else
        0.

        Below 1 it is shadow, above 1 shadow gone.
        """
        result = np.zeros(mask.shape, np.float32)
        rows, columns = np.nonzero(mask)
        there = picture[rows, columns].astype(np.float32)
        plain = self._plain[rows, columns]
        factor = (there * plain).sum(axis=1) / self._square[rows, columns]
        rest = np.abs(there - factor[:, None] * plain).max(axis=1) / np.maximum(factor, 1)
        even = np.minimum(factor, 1 / np.maximum(factor, 1e-3))
        shade = (even > _SHADE[0]) & (even < _SHADE[1]) & (rest < max(6.0, 3 * self.sigma))
        result[rows, columns] = np.where(shade, factor, 0)
        return result

    def _spot(
        self, contour: Any, differences: tuple[NDArray[np.uint8], ...], shade: NDArray[np.bool_]
    ) -> Spot | None:
        cv2 = imported("cv2")
        left, top, width, height = cv2.boundingRect(contour)
        if width * height < _LEAST_AREA or max(width, height) > 0.9 * min(shade.shape):
            return None
        filled = np.zeros((height + 2, width + 2), np.uint8)
        cv2.drawContours(filled, [contour], -1, 1, -1, offset=(1 - left, 1 - top))
        if int(filled.sum()) < _LEAST_AREA:
            return None
        inside = cv2.distanceTransform(filled, cv2.DIST_L2, 5)
        row, column = np.unravel_index(int(inside.argmax()), inside.shape)
        radius = max(float(inside[row, column]), 1.0)
        u, v = left + float(column) - 1, top + float(row) - 1
        # a window around it, where shadow counts as background unless the spot encloses it
        reach = int(2 * max(radius, 0.5 * max(width, height))) + 4
        u0, v0 = max(0, int(u) - reach), max(0, int(v) - reach)
        place = np.s_[v0 : int(v) + reach + 1, u0 : int(u) + reach + 1]
        windows = np.stack([each[place] for each in differences]).astype(np.float32)
        # the edge itself, half ball and half background, may pass for shadow
        hidden = shade[place].astype(np.uint8)
        cv2.drawContours(hidden, [contour], -1, 0, -1, offset=(-u0, -v0))
        cv2.drawContours(hidden, [contour], -1, 0, _RIM, offset=(-u0, -v0))
        windows[:, hidden > 0] = 0
        if radius < _TINY:
            return self._tiny(windows[1], u - u0, v - v0, radius, u0, v0)
        return self._circle(windows, (u - u0, v - v0, radius), u0, v0)

    def _circle(
        self, windows: NDArray[np.float32], start: tuple[float, float, float], u0: int, v0: int
    ) -> Spot | None:
        u, v, radius = start
        kept, rest, edges = np.empty(0, bool), np.empty(0), None
        for _ in range(_ROUNDS):
            edges = self._edges(windows, u, v, radius)
            if edges is None:
                return None
            fitted = circle.fit(edges, (u, v, None))
            if fitted is None or circle.agreeing(fitted).sum() < _GOOD * _RAYS:
                fitted = circle.better(fitted, circle.fit(edges, circle.through_an_arc(edges)))
            if fitted is None:
                return None
            moved = max(abs(new - old) for new, old in zip(fitted[0], (u, v, radius), strict=True))
            (u, v, radius), rest = fitted
            kept = circle.agreeing(fitted)
            if moved < _STILL:
                break
        agree = float(kept.sum()) / _RAYS
        height, width = windows.shape[1:]
        if (
            edges is None
            or agree < _AGREE
            or not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5)
        ):
            return None
        scatter = float(np.sqrt(np.mean(rest[kept] ** 2)))
        return Spot(u + u0, v + v0, radius, agree, scatter, edges + np.array([u0, v0]))

    def _edges(
        self, windows: NDArray[np.float32], u: float, v: float, radius: float
    ) -> Array | None:
        """Points (n, 2) where the difference has fallen to half along rays from (u, v); None for
        too few.

        What it falls from is taken just inside the edge, since a lit ball is not the same all over.
        Brightness counts where it differs enough: video files keep colours at half the resolution.
        """
        steps = np.arange(max(0.0, 0.7 * radius - 2), 1.5 * radius + 2, _FINE, dtype=np.float32)
        cos, sin = _directions()
        along_u, along_v = (
            (u + cos * steps).astype(np.float32),
            (v + sin * steps).astype(np.float32),
        )
        profiles = [_along(window, along_u, along_v) for window in windows]
        inner = (steps > min(0.5 * radius, radius - 3.5)) & (
            steps < max(0.7 * radius, radius - 1.3)
        )
        half_way = int(inner.sum()) // 2
        levels = [np.partition(p[:, inner], half_way, axis=1)[:, half_way] for p in profiles]
        bright = (levels[0] > 1.5 * self.level) & (levels[0] > 0.7 * levels[1])
        values = np.where(bright[:, None], *profiles)
        half = 0.5 * np.where(bright, *levels)[:, None]
        below = (values[:, 1:] < half) & (values[:, :-1] >= half)
        below[:, : int(np.flatnonzero(inner)[0])] = False
        k = below.argmax(axis=1)
        lines = np.arange(_RAYS)
        a, b = values[lines, k], values[lines, k + 1]
        has = (
            below.any(axis=1) & (half[:, 0] > 0.4 * self.level) & (b > -500)
        )  # far below: the picture ends there
        if has.sum() < 0.5 * _RAYS:
            return None
        share = (a - half[:, 0])[has] / np.maximum(a - b, 1e-6)[has]
        out = steps[k[has]] + _FINE * share
        return np.stack([u + cos[has, 0] * out, v + sin[has, 0] * out], axis=1).astype(np.float64)

    def _tiny(
        self, window: NDArray[np.float32], u: float, v: float, radius: float, u0: int, v0: int
    ) -> Spot | None:
        """A ball of a few pixels: the middle of the difference, and a circle of its sum."""
        rows, columns = np.mgrid[: window.shape[0], : window.shape[1]]
        near = np.hypot(columns - u, rows - v) <= radius + 2.5
        weights = np.where(near & (window > 0.4 * self.level), window, 0.0)
        total = float(weights.sum())
        peak = float(np.percentile(window[near], 90))
        if total <= 0 or peak < self.level:
            return None
        area = total / max(peak, 1.0)
        if area < _LEAST_AREA / 2:
            return None
        u, v = float((weights * columns).sum() / total), float((weights * rows).sum() / total)
        return Spot(u + u0, v + v0, float(np.sqrt(area / np.pi)), _AGREE, 0.2)


def _along(
    window: NDArray[np.float32], u: NDArray[np.float32], v: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Values of a window at places between its pixels; far below zero outside."""
    cv2 = imported("cv2")
    result: NDArray[np.float32] = cv2.remap(
        window, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-1000.0
    )
    return result


@lru_cache(maxsize=1)
def _directions() -> tuple[Array, Array]:
    angles = np.linspace(0, 2 * np.pi, _RAYS, endpoint=False)[:, None]
    return np.cos(angles), np.sin(angles)
