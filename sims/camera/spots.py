"""Round things that differ from the background in one picture, measured to a fraction of a pixel.

What differs is divided into connected spots. A circle is fitted to each spot's edge, found along
rays from its middle where the difference has fallen to half of what it is inside: there half a
pixel's area is the ball's, whatever its colour. Rays that meet something else (a shadow, the
picture's edge, a patch of like colour) lie off the circle and are left out; a spot for which too
few agree is no ball.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sims.base import Array
from sims.camera import circle
from sims.camera.packages import imported
from sims.camera.render import Image

_RAYS = 36
"""Rays along which an edge is looked for, all around."""
_LEAST_AREA = 6
"""Pixels of a spot; less is noise."""
_LEAST_LEVEL = 12.0
"""Grey levels from the background, even where the camera has no noise: compression has."""
_AGREE = 0.6
"""Share of the rays that must agree on a circle."""
_GOOD = 0.85
"""Where fewer agree with the first circle, one is begun on arcs: a shadow at the side bends it."""
_MOST_SPOTS = 4
"""Spots of a picture that are measured, the largest."""
_TINY = 2.5
"""Pixels; a smaller radius has no room for rays."""
_ROUNDS = 3
"""Rounds of edge and circle, each from the circle before."""
_STILL = 0.02
"""Pixels; a circle that moves by less has settled."""
_FINE = 0.25
"""Pixels from one sample along a ray to the next."""
_LOOSE = 0.5
"""Pixels; width of the weights where the radius is known."""
_RIM = 5
"""Pixels; width of the line around a spot in which nothing passes for shadow."""
_AROUND = 1.6
"""Radii from the middle at which a spot's surroundings are looked at."""
_SHADE = (0.25, 0.97)
"""Factors on the background that are shadow; darker is a thing, lighter is noise."""
_UNEVEN = 6.0
"""Grey levels by which colours may miss one factor and still be shadow."""
_OUTSIDE = -1000.0
"""Stands for what is beyond the picture; far below every difference."""
_SINGULAR = 1e-6
"""A determinant below this belongs to edges that do not fix a middle."""
_TURNS = 12
"""Steps of Gauss-Newton at most."""

Values: TypeAlias = NDArray[np.float32]
"""Grey levels, or places in pixels."""
Mask: TypeAlias = NDArray[np.bool_]


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
        for _ in range(_TURNS):
            away_u = self.edges[:, 0] - u
            away_v = self.edges[:, 1] - v
            far = np.maximum(np.hypot(away_u, away_v), 1e-9)
            rest = far - radius
            # Geman and McClure's weights: what is not on the circle hardly counts
            weights = 1 / (1 + (rest / _LOOSE) ** 2) ** 2
            # (2) of sims.camera.circle without dR
            rows = np.stack([away_u / far, away_v / far, rest])
            normal = (rows * weights) @ rows.T
            (a, b, p), (_, c, q), _ = normal.tolist()
            area = a * c - b * b
            if area < _SINGULAR:
                return self
            # Cramer's rule
            du = (c * p - b * q) / area
            dv = (a * q - b * p) / area
            u += du
            v += dv
            if abs(du) + abs(dv) < 1e-3:
                break
        # it has run to something else's edge
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
        self.background = background
        self.sigma = sigma
        self.shadows = shadows
        # six sigma: of ten thousand pixels none passes by noise alone
        self.level = max(_LEAST_LEVEL, 6 * sigma)
        self._plain = background.astype(np.float32)
        cv2 = imported("cv2")
        self._grey = cv2.cvtColor(background, cv2.COLOR_RGB2GRAY)
        squares = (self._plain * self._plain).sum(axis=2)
        self._square = np.maximum(squares, 1.0)

    def spots(self, picture: Image, ghosts: bool = False) -> list[Spot]:
        """What looks like a ball, the largest first; with the ghosts, if asked for."""
        cv2 = imported("cv2")
        difference = self._difference(picture)
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        brightness = cv2.absdiff(grey, self._grey)
        mask = (difference > self.level).astype(np.uint8)
        if not mask.any():
            return []
        if self.shadows:
            shade = self._even(picture, mask) > 0
            mask[shade] = 0
            # single pixels that shadow and noise leave
            pair = np.ones((2, 2), np.uint8)
            mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, pair)
        else:
            shade = np.zeros(mask.shape, bool)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        lengths = [(len(c), i) for i, c in enumerate(contours) if len(c) > 3]
        large = sorted(lengths, reverse=True)[:_MOST_SPOTS]
        seen = []
        for _, i in large:
            spot = self._spot(contours[i], (brightness, difference), shade)
            if spot is not None:
                seen.append(self._coloured(spot, picture))
        return seen if ghosts else [spot for spot in seen if not spot.ghost]

    def _coloured(self, spot: Spot, picture: Image) -> Spot:
        """The spot with the colour of its middle, and whether it is the background that stands out
        against the rest.
        """
        here = _inside(picture, spot)
        behind = _inside(self.background, spot)
        out = _around(picture, spot)
        out_behind = _around(self.background, spot)
        contrast = float(np.abs(here - behind).max())
        ghost = self._is_ghost((here, out), (behind, out_behind))
        return spot._replace(colour=tuple(here.tolist()), contrast=contrast, ghost=ghost)

    def unshaded(self, picture: Image) -> Mask:
        """Where the picture lacks a shadow that the background has."""
        cv2 = imported("cv2")
        mask = (self._difference(picture) > self.level).astype(np.uint8)
        lighter = (self._even(picture, mask) > 1).astype(np.uint8)
        count, parts, sizes, _ = cv2.connectedComponentsWithStats(lighter)
        gone = np.zeros(mask.shape, bool)
        # part 0 is what lies between the others
        for part in range(1, count):
            if sizes[part, cv2.CC_STAT_AREA] < _LEAST_AREA:
                continue
            inside = (parts == part).astype(np.uint8)
            # a pixel is left out between inside and ring, half one and half the other
            near = cv2.dilate(inside, np.ones((3, 3), np.uint8))
            wide = cv2.dilate(near, np.ones((5, 5), np.uint8))
            ring = (wide > 0) & (near == 0) & (mask == 0)
            if not ring.any():
                continue
            within = inside > 0
            shown = _medians(picture, within, ring)
            hidden = _medians(self.background, within, ring)
            # a pale ball is lighter too, but it stands out in the picture
            if self._is_ghost(shown, hidden):
                gone |= within
        return gone

    def _is_ghost(self, here: tuple[Array, Array], behind: tuple[Array, Array]) -> bool:
        """Whether a thing is in the background and not in the picture: colours (inside, around) of
        both.
        """
        stands_out = float(np.abs(here[0] - here[1]).max())
        stood_out = float(np.abs(behind[0] - behind[1]).max())
        return stood_out > stands_out + self.level / 2

    def _difference(self, picture: Image) -> NDArray[np.uint8]:
        """The largest difference over the colours."""
        cv2 = imported("cv2")
        apart = cv2.absdiff(picture, self.background)
        red_green = cv2.max(apart[..., 0], apart[..., 1])
        result: NDArray[np.uint8] = cv2.max(red_green, apart[..., 2])
        return result

    def _even(self, picture: Image, mask: NDArray[np.uint8]) -> Values:
        """The factor by which the picture is the background where that is one in all colours, else
        0.

        Below 1 it is shadow, above 1 shadow gone.
        """
        result = np.zeros(mask.shape, np.float32)
        rows, columns = np.nonzero(mask)
        there = picture[rows, columns].astype(np.float32)
        plain = self._plain[rows, columns]
        # least squares over the three colours
        product = (there * plain).sum(axis=1)
        factor = product / self._square[rows, columns]
        apart = np.abs(there - factor[:, None] * plain).max(axis=1)
        rest = apart / np.maximum(factor, 1)
        # shadow gone is judged as shadow is, by the inverse
        even = np.minimum(factor, 1 / np.maximum(factor, 1e-3))
        darkest, lightest = _SHADE
        shade = (even > darkest) & (even < lightest)
        shade &= rest < max(_UNEVEN, 3 * self.sigma)
        result[rows, columns] = np.where(shade, factor, 0)
        return result

    def _spot(
        self,
        contour: Any,
        differences: tuple[NDArray[np.uint8], ...],
        shade: Mask,
    ) -> Spot | None:
        """What a contour holds, measured in `differences` of brightness and of the worst colour."""
        cv2 = imported("cv2")
        left, top, width, height = cv2.boundingRect(contour)
        # what nearly fills the picture is no ball before a background
        if width * height < _LEAST_AREA or max(width, height) > 0.9 * min(shade.shape):
            return None
        filled = np.zeros((height + 2, width + 2), np.uint8)
        offset = 1 - left, 1 - top
        cv2.drawContours(filled, [contour], -1, 1, -1, offset=offset)
        if int(filled.sum()) < _LEAST_AREA:
            return None
        # the largest disc inside is the ball even where a shadow hangs on to it
        inside = cv2.distanceTransform(filled, cv2.DIST_L2, 5)
        row, column = np.unravel_index(int(inside.argmax()), inside.shape)
        radius = max(float(inside[row, column]), 1.0)
        u = left + float(column) - 1
        v = top + float(row) - 1
        # a window around it, where shadow counts as background unless the spot encloses it
        reach = int(2 * max(radius, 0.5 * max(width, height))) + 4
        u0 = max(0, int(u) - reach)
        v0 = max(0, int(v) - reach)
        place = np.s_[v0 : int(v) + reach + 1, u0 : int(u) + reach + 1]
        windows = np.stack([each[place] for each in differences]).astype(np.float32)
        # the edge itself, half ball and half background, may pass for shadow
        hidden = shade[place].astype(np.uint8)
        offset = -u0, -v0
        cv2.drawContours(hidden, [contour], -1, 0, -1, offset=offset)
        cv2.drawContours(hidden, [contour], -1, 0, _RIM, offset=offset)
        windows[:, hidden > 0] = 0
        if radius < _TINY:
            return self._tiny(windows[1], u - u0, v - v0, radius, u0, v0)
        return self._circle(windows, (u - u0, v - v0, radius), u0, v0)

    def _circle(
        self,
        windows: Values,
        start: circle.Circle,
        u0: int,
        v0: int,
    ) -> Spot | None:
        """The spot's circle in windows that begin at (u0, v0); None where too few rays agree."""
        u, v, radius = start
        on_it = np.empty(0, bool)
        rest = np.empty(0)
        edges = None
        for _ in range(_ROUNDS):
            edges = self._edges(windows, u, v, radius)
            if edges is None:
                return None
            fitted = circle.fit(edges, (u, v, None))
            enough = fitted is not None and circle.agreeing(fitted).sum() >= _GOOD * _RAYS
            if not enough:
                from_an_arc = circle.fit(edges, circle.through_an_arc(edges))
                fitted = circle.better(fitted, from_an_arc)
            if fitted is None:
                return None
            before = u, v, radius
            found, rest = fitted
            moved = max(abs(new - old) for new, old in zip(found, before, strict=True))
            u, v, radius = found
            on_it = circle.agreeing(fitted)
            if moved < _STILL:
                break
        agree = float(on_it.sum()) / _RAYS
        height, width = windows.shape[1:]
        # a middle outside the window belongs to an arc of something large
        within = -0.5 <= u <= width - 0.5
        within &= -0.5 <= v <= height - 0.5
        if edges is None or agree < _AGREE or not within:
            return None
        scatter = float(np.sqrt(np.mean(rest[on_it] ** 2)))
        whole = edges + np.array([u0, v0])
        return Spot(u + u0, v + v0, radius, agree, scatter, whole)

    def _edges(self, windows: Values, u: float, v: float, radius: float) -> Array | None:
        """Points (n, 2) where the difference has fallen to half along rays from (u, v); None for
        too few.

        What it falls from is taken just inside the edge, since a lit ball is not the same all over.
        Brightness counts where it differs enough: video files keep colours at half the resolution.
        """
        begin = max(0.0, 0.7 * radius - 2)
        steps = np.arange(begin, 1.5 * radius + 2, _FINE, dtype=np.float32)
        cos, sin = _directions()
        along_u = (u + cos * steps).astype(np.float32)
        along_v = (v + sin * steps).astype(np.float32)
        profiles = [_along(window, along_u, along_v) for window in windows]
        # the last pixels before the edge, without those that blur has reached
        inner = steps > min(0.5 * radius, radius - 3.5)
        inner &= steps < max(0.7 * radius, radius - 1.3)
        half_way = int(inner.sum()) // 2
        levels = []
        for profile in profiles:
            ranked = np.partition(profile[:, inner], half_way, axis=1)
            levels.append(ranked[:, half_way])
        brightness, worst = levels
        bright = brightness > 1.5 * self.level
        bright &= brightness > 0.7 * worst
        values = np.where(bright[:, None], *profiles)
        half = 0.5 * np.where(bright, brightness, worst)
        crossed = half[:, None]
        below = values[:, 1:] < crossed
        below &= values[:, :-1] >= crossed
        # a dark patch further inside is no edge
        below[:, : int(np.flatnonzero(inner)[0])] = False
        # of several crossings the first
        k = below.argmax(axis=1)
        lines = np.arange(_RAYS)
        a = values[lines, k]
        b = values[lines, k + 1]
        has = below.any(axis=1) & (half > 0.4 * self.level)
        # where it falls to what is outside, the picture ends and not the ball
        has &= b > 0.5 * _OUTSIDE
        if has.sum() < 0.5 * _RAYS:
            return None
        # between the two samples, in proportion
        drop = np.maximum(a - b, 1e-6)
        share = (a - half)[has] / drop[has]
        out = steps[k[has]] + _FINE * share
        edge_u = u + cos[has, 0] * out
        edge_v = v + sin[has, 0] * out
        return np.stack([edge_u, edge_v], axis=1).astype(np.float64)

    def _tiny(
        self,
        window: Values,
        u: float,
        v: float,
        radius: float,
        u0: int,
        v0: int,
    ) -> Spot | None:
        """A ball of a few pixels: the middle of the difference, and a circle of its sum."""
        height, width = window.shape
        rows, columns = np.mgrid[:height, :width]
        near = np.hypot(columns - u, rows - v) <= radius + 2.5
        weights = np.where(near & (window > 0.4 * self.level), window, 0.0)
        total = float(weights.sum())
        peak = float(np.percentile(window[near], 90))
        if total <= 0 or peak < self.level:
            return None
        # a pixel that the ball covers in part differs in part: sums measure areas
        area = total / max(peak, 1.0)
        if area < _LEAST_AREA / 2:
            return None
        u = u0 + float((weights * columns).sum() / total)
        v = v0 + float((weights * rows).sum() / total)
        equal = float(np.sqrt(area / np.pi))
        # no rays, so no share of them: as good as the worst circle
        return Spot(u, v, equal, _AGREE, 0.2)


def _medians(picture: Image, inside: Mask, around: Mask) -> tuple[Array, Array]:
    """Median colours (3,) of two parts of a picture."""
    within: Array = np.median(picture[inside], axis=0)
    outside: Array = np.median(picture[around], axis=0)
    return within, outside


def _inside(picture: Image, spot: Spot) -> Array:
    """Mean colour (3,) of a spot's middle."""
    side = 2 * max(1, int(0.4 * spot.radius)) + 1
    patch = imported("cv2").getRectSubPix(picture, (side, side), (spot.u, spot.v))
    colour: Array = patch.reshape(-1, 3).mean(axis=0)
    return colour


def _around(picture: Image, spot: Spot) -> Array:
    """Median colour (3,) around a spot."""
    cos, sin = _directions()
    height, width = picture.shape[:2]
    away = _AROUND * spot.radius
    half = _RAYS // 2
    rows = (spot.v + away * sin[:, 0] + 0.5).astype(np.intp)
    columns = (spot.u + away * cos[:, 0] + 0.5).astype(np.intp)
    # at the picture's border its last pixels stand for what is beyond
    rows = rows.clip(0, height - 1)
    columns = columns.clip(0, width - 1)
    ranked = np.partition(picture[rows, columns], half, axis=0)
    colour: Array = ranked[half].astype(np.float64)
    return colour


def _along(window: Values, u: Values, v: Values) -> Values:
    """Values of a window at places between its pixels; far below zero outside."""
    cv2 = imported("cv2")
    result: Values = cv2.remap(
        window,
        u,
        v,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=_OUTSIDE,
    )
    return result


@lru_cache(maxsize=1)
def _directions() -> tuple[Array, Array]:
    """Cosines and sines (rays, 1) of the rays."""
    angles = np.linspace(0, 2 * np.pi, _RAYS, endpoint=False)[:, None]
    return np.cos(angles), np.sin(angles)
