"""What a fixed camera sees when the ball is not there, and where the film is cut."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sims.base import Array, InputError
from sims.camera.render import Image

MOST = 25
"""Frames of which the background is the median."""
_PIXELS = 5_000
"""Pixels of a picture that the first pass looks at, about."""
_CUT = 0.5
"""Share of the pixels that change where the film is cut or the camera moves."""
_STEP = 12
"""Grey levels; less is noise or a shadow's edge, and no other picture."""
_GRAIN = 4
"""Grey levels of compression beyond the camera's noise, which is told by the median."""
_NEAR = 1.3
"""Of a ball's radius: how far around its middle it hides the background, with its soft edge."""
_EDGE = 3
"""Pixels beyond that, which compression spoils."""
_NORMAL = 1.4826
"""Standard deviations of normal noise in its median magnitude."""
_WORST = 1.5
"""The largest of three such magnitudes is taken for so many times one of them."""


@dataclass(frozen=True)
class Survey:
    """What a first pass over the frames tells.

    Attributes:
        times: (n,) seconds.
        moved: (n,) how much changed from the frame before, mean grey levels.
        cuts: numbers of the frames with which another picture begins.
        size: width and height, px.
    """

    times: Array
    moved: Array
    cuts: tuple[int, ...]
    size: tuple[int, int]

    def shots(self) -> list[tuple[int, int]]:
        """First and behind the last frame between cuts."""
        edges = [0, *self.cuts, len(self.times)]
        # none between two cuts in a row
        return [(a, b) for a, b in pairwise(edges) if b > a]


def survey(frames: Iterable[tuple[float, Image]]) -> Survey:
    """Look at every frame once, coarsely.

    Raises:
        InputError: the picture changes its size.
    """
    times = []
    moved = []
    cuts = []
    size = 0, 0
    before = None
    for number, (time, picture) in enumerate(frames):
        if number and picture.shape[1::-1] != size:
            expected = f"{size[0]} x {size[1]} px as before"
            raise InputError(f"frame {number}: expected {expected}, found another size")
        height, width = picture.shape[:2]
        size = width, height
        share = height * width / _PIXELS
        skip = max(1, int(share**0.5))
        coarse = picture[::skip, ::skip].astype(np.int16)
        earlier = coarse if before is None else before
        change = np.abs(coarse - earlier).max(axis=2)
        if np.mean(change > _STEP) > _CUT:
            cuts.append(number)
            # what changed is the picture, and no ball has moved
            change[:] = 0
        times.append(time)
        # small changes are noise; they would make a resting picture look busy
        usual = np.median(change)
        beyond = change - 2 * usual - _GRAIN
        moved.append(float(np.maximum(beyond, 0).mean()))
        before = coarse
    return Survey(np.array(times), np.array(moved), tuple(cuts), size)


def chosen(moved: Array, most: int = MOST) -> list[int]:
    """Numbers of at most `most` frames evenly spaced in how much has moved until then.

    Evenly in time, a ball that comes to rest would be in most of them and so in the median.
    """
    count = len(moved)
    # a little for every frame, so that a film in which nothing moves still has marks
    least = 1e-3 * moved.sum() / max(1, count)
    way = np.cumsum(moved + least + 1e-12)
    marks = np.linspace(way[0], way[-1], min(most, count))
    places = np.searchsorted(way, marks - 1e-12).clip(0, count - 1)
    return sorted(set(places.tolist()))


def median(pictures: list[Image]) -> Image:
    """The median of pictures, pixel by pixel."""
    stack = np.stack(pictures)
    half = len(stack) // 2
    # a partition finds the middle without sorting, and stays in whole grey levels
    stack.partition(half, axis=0)
    result: Image = stack[half].copy()
    return result


def without(
    pictures: list[Image],
    balls: list[list[tuple[float, float, float]]],
    before: Image,
    shaded: NDArray[np.bool_] | None = None,
) -> Image:
    """The median without what hides the background; `before` where none is left.

    Args:
        pictures: n of them, (height, width, 3).
        balls: each picture's (u, v, radius).
        before: the background as it was taken to be.
        shaded: (n, height, width) where shadow is besides.
    """
    height, width = before.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    nowhere = np.zeros((len(pictures), height, width), bool)
    hidden = nowhere if shaded is None else shaded.copy()
    for mask, there in zip(hidden, balls, strict=True):
        for u, v, radius in there:
            far = np.hypot(columns - u, rows - v)
            mask |= far < _NEAR * radius + _EDGE
    # elsewhere the median stands: never hidden, or hidden in all pictures
    ever = hidden.any(axis=0) & ~hidden.all(axis=0)
    colours = np.stack(pictures)[:, ever].astype(np.float32)
    values = np.where(hidden[:, ever, None], np.nan, colours)
    result = before.copy()
    if ever.any():
        middle = _median_of_seen(values)
        # half a level, since the conversion to whole ones cuts off
        result[ever] = (middle + 0.5).astype(np.uint8)
    return result


def _median_of_seen(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The median over the first axis without NaN, of which not all are; numpy's own takes four
    times as long.
    """
    # NaN come last, so the count of the others says where the middle is
    ranked = np.sort(values, axis=0)
    count = np.isfinite(values).sum(axis=0, keepdims=True)
    low = np.take_along_axis(ranked, (count - 1) // 2, axis=0)
    high = np.take_along_axis(ranked, count // 2, axis=0)
    result: NDArray[np.float32] = (low[0] + high[0]) / 2
    return result


def noise(pictures: list[Image], background: Image) -> float:
    """1 sigma of the camera in grey levels of its worst colour, from pictures in which little
    differs.
    """
    # a few tell: each has as many numbers as pixels
    every = max(1, len(pictures) // 8)
    worst = [_difference(picture, background) for picture in pictures[::every]]
    return float(_NORMAL * np.median(np.stack(worst)) / _WORST)


def _difference(picture: Image, background: Image) -> NDArray[np.int16]:
    """The largest difference (height, width) over the colours."""
    # whole numbers without sign would wrap round
    signed = picture.astype(np.int16)
    apart = np.abs(signed - background)
    result: NDArray[np.int16] = apart.max(axis=2)
    return result
