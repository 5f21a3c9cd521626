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
_CUT = 0.5
_STEP = 12


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
        return [(a, b) for a, b in pairwise(edges) if b > a]


def survey(frames: Iterable[tuple[float, Image]]) -> Survey:
    """Look at every frame once, coarsely.

    Raises:
        InputError: the picture changes its size.
    """
    times, moved, cuts = [], [], []
    size, before = (0, 0), None
    for number, (time, picture) in enumerate(frames):
        if number and picture.shape[1::-1] != size:
            raise InputError(
                f"frame {number}: expected {size[0]} x {size[1]} px as before, found another size"
            )
        size = picture.shape[1], picture.shape[0]
        skip = max(1, int((picture.shape[0] * picture.shape[1] / _PIXELS) ** 0.5))
        coarse = picture[::skip, ::skip].astype(np.int16)
        change = np.abs(coarse - (coarse if before is None else before)).max(axis=2)
        if np.mean(change > _STEP) > _CUT:
            cuts.append(number)
            change[:] = 0
        times.append(time)
        # small changes are noise; they would make a resting picture look busy
        moved.append(float(np.maximum(change - 2 * np.median(change) - 4, 0).mean()))
        before = coarse
    return Survey(np.array(times), np.array(moved), tuple(cuts), size)


def chosen(moved: Array, most: int = MOST) -> list[int]:
    """Numbers of at most `most` frames evenly spaced in how much has moved until then.

    Evenly in time, a ball that comes to rest would be in most of them and so in the median.
    """
    way = np.cumsum(moved + 1e-3 * moved.sum() / max(1, len(moved)) + 1e-12)
    marks = np.linspace(way[0], way[-1], min(most, len(moved)))
    return sorted(set(np.searchsorted(way, marks - 1e-12).clip(0, len(moved) - 1).tolist()))


def median(pictures: list[Image]) -> Image:
    """The median of pictures, pixel by pixel."""
    stack = np.stack(pictures)
    stack.partition(len(stack) // 2, axis=0)
    result: Image = stack[len(stack) // 2].copy()
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
    rows, columns = np.mgrid[: before.shape[0], : before.shape[1]]
    hidden = np.zeros((len(pictures), *rows.shape), bool) if shaded is None else shaded.copy()
    for mask, there in zip(hidden, balls, strict=True):
        for u, v, radius in there:
            mask |= np.hypot(columns - u, rows - v) < 1.3 * radius + 3
    ever = hidden.any(axis=0) & ~hidden.all(axis=0)
    values = np.where(hidden[:, ever, None], np.nan, np.stack(pictures)[:, ever].astype(np.float32))
    result = before.copy()
    if ever.any():
        result[ever] = (_median_of_seen(values) + 0.5).astype(np.uint8)
    return result


def _median_of_seen(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The median over the first axis without NaN, of which not all are; numpy's own takes four
    times as long.
    """
    ranked = np.sort(values, axis=0)  # NaN last
    count = np.isfinite(values).sum(axis=0, keepdims=True)
    low, high = (
        np.take_along_axis(ranked, place, axis=0)[0] for place in ((count - 1) // 2, count // 2)
    )
    result: NDArray[np.float32] = (low + high) / 2
    return result


def noise(pictures: list[Image], background: Image) -> float:
    """1 sigma of the camera in grey levels of its worst colour, from pictures in which little
    differs.
    """
    worst = [
        _difference(picture, background) for picture in pictures[:: max(1, len(pictures) // 8)]
    ]
    return float(
        1.4826 * np.median(np.stack(worst)) / 1.5
    )  # the largest of three magnitudes is 1.5 times one


def _difference(picture: Image, background: Image) -> NDArray[np.int16]:
    result: NDArray[np.int16] = np.abs(picture.astype(np.int16) - background).max(axis=2)
    return result
