"""Tracking: where in each frame of a film the ball is, and nowhere where it is not to be seen."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from sims.base import Array, InputError
from sims.camera import background
from sims.camera.link import Path, joined, linked
from sims.camera.render import Image
from sims.camera.spots import Finder, Spot

_LEAST_FRAMES = 5
_WINDOW = 9
_FEW = 8
_HELD = 200_000_000
"""Bytes of frames that are kept in memory."""
_FEWEST = 3
_MISFIT = 0.2


@dataclass(frozen=True)
class Track:
    """A tracked ball.

    Attributes:
        times: (n,) seconds of the frames, of one shot.
        u: (n,) pixels to the right of the upper left pixel's centre; NaN in frames without a ball.
        v: (n,) pixels down.
        radius: (n,) pixels, of the ball's outline.
        noise: 1 sigma of u and v in pixels, from the path itself.
        size: width and height of the picture.
        notes: what a user should know, in sentences.
        background: the scene without the ball.
        pictures: a few frames of it, by number.
    """

    times: Array
    u: Array
    v: Array
    radius: Array
    noise: float
    size: tuple[int, int]
    notes: tuple[str, ...]
    background: Image = field(repr=False)
    pictures: dict[int, Image] = field(repr=False)

    @property
    def seen(self) -> NDArray[np.intp]:
        """Numbers of the frames that show the ball."""
        return np.flatnonzero(np.isfinite(self.u))


def track(frames: Iterable[tuple[float, Image]]) -> Track:
    """Track the ball that moves before a camera that does not.

    Args:
        frames: time in seconds and picture (height, width, 3) of each frame; iterated three times.

    Raises:
        InputError: there is no ball to be seen.
    """
    frames = _Kept(frames)
    survey = background.survey(frames)
    notes: list[str] = []
    first, end = _shot(survey, notes)
    numbers = [first + k for k in background.chosen(survey.moved[first:end])]
    pictures = [picture for number, (_, picture) in enumerate(frames) if number in set(numbers)]
    finder = _finder(pictures)
    spots = [finder.spots(p) if first <= k < end else [] for k, (_, p) in enumerate(frames)][
        first:end
    ]
    paths = linked(spots)
    if not paths:
        raise InputError(_nothing(end - first, sum(map(bool, spots))))
    path, others = joined(paths)
    if len(path.frames) < _LEAST_FRAMES or path.travel < path.radius:
        raise InputError(_nothing(end - first, len(path.frames)))
    _others(path, others, notes)
    return _made(
        survey.times[first:end],
        path,
        survey.size,
        notes,
        finder,
        {n - first: p for n, p in zip(numbers, pictures, strict=True)},
    )


class _Kept:
    """Frames that are read once where they are few and small, and from their source each time where
    not.
    """

    def __init__(self, source: Iterable[tuple[float, Image]]) -> None:
        self._source = source
        self._kept: list[tuple[float, Image]] | None = None

    def __iter__(self) -> Iterator[tuple[float, Image]]:
        if self._kept is not None:
            yield from self._kept
            return
        kept, held = [], 0
        for time, picture in self._source:
            held += picture.nbytes
            if held <= _HELD:
                kept.append((time, picture))
            else:
                kept.clear()
            yield time, picture
        if held <= _HELD:
            self._kept = kept


def _nothing(frames: int, some: int) -> str:
    seen = f"something round in {some} of {frames} frames, but nothing" if some else "nothing"
    return f"no ball found: {seen} that moves and stays round; film with a fixed camera and a ball unlike its background"


def _shot(survey: background.Survey, notes: list[str]) -> tuple[int, int]:
    shots = survey.shots()
    first, end = max(shots, key=lambda s: s[1] - s[0])
    if len(shots) > 1:
        cuts = ", ".join(f"{survey.times[c]:.2f} s" for c in survey.cuts[:5])
        span = f"{survey.times[first]:.2f} to {survey.times[end - 1]:.2f} s"
        notes.append(
            f"the film is cut or the camera moves (at {cuts}); only the longest part is tracked, {span}"
        )
    if end - first < _LEAST_FRAMES:
        raise InputError(
            f"expected at least {_LEAST_FRAMES} frames without a cut, found {end - first}"
        )
    return first, end


def _finder(pictures: list[Image]) -> Finder:
    """A finder with the better treatment of shadows, and a background that the ball has been taken
    out of.
    """
    plain = background.median(pictures)
    every = max(1, len(pictures) // _FEW)
    for _ in range(2):
        sigma = background.noise(pictures, plain)
        finders = [Finder(plain, sigma, shadows) for shadows in (True, False)]
        # a ball of the ground's own hue is itself taken for shadow; then shadow must be borne
        tried = [[finder.spots(p, ghosts=True) for p in pictures[::every]] for finder in finders]
        good = [
            sum(max((s.agree for s in spots if not s.ghost), default=0.0) for spots in each)
            for each in tried
        ]
        chosen = 0 if good[0] >= 0.8 * good[1] else 1
        best, known = finders[chosen], tried[chosen]
        found = [
            known[i // every] if i % every == 0 else best.spots(p, ghosts=True)
            for i, p in enumerate(pictures)
        ]
        hiding = _hiding(found)
        shaded = _shaded([best.unshaded(p) for p in pictures]) if best.shadows else None
        plain = background.without(pictures, hiding, plain, shaded)
    return Finder(plain, sigma, best.shadows)


def _hiding(found: list[list[Spot]]) -> list[list[tuple[float, float, float]]]:
    """Where something hides the background in each picture.

    A ball that rests for most of the film, or its shadow, gets into the median. Pictures that lack
    it there show the background, and the others do not.
    """
    balls = [[(s.u, s.v, s.radius) for s in spots if not s.ghost] for spots in found]
    ghosts = [[(s.u, s.v, s.radius) for s in spots if s.ghost] for spots in found]
    for one in [ghost for there in ghosts for ghost in there]:
        lacking = [any(_same(one, other) for other in there) for there in ghosts]
        if sum(lacking) >= _FEWEST:
            balls = [
                there if lacks else [*there, one]
                for there, lacks in zip(balls, lacking, strict=True)
            ]
    return balls


def _shaded(lit: list[NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """Where a shadow hides the background in each picture (n, height, width), seen by those in
    which it is gone.
    """
    stack = np.stack(lit)
    result: NDArray[np.bool_] = ~stack & (stack.sum(axis=0) >= _FEWEST)
    return result


def _same(a: tuple[float, float, float], b: tuple[float, float, float]) -> bool:
    return abs(a[0] - b[0]) + abs(a[1] - b[1]) < 0.3 * b[2] + 0.5 and 0.7 < a[2] / b[2] < 1.4


def _others(path: Path, others: Sequence[Path], notes: list[str]) -> None:
    rivals = [
        p
        for p in others
        if len(set(p.frames) & set(path.frames)) >= max(8, 0.25 * len(path.frames))
        and p.travel > 2 * p.radius
        and 0.4 < p.radius / path.radius < 2.5
    ]
    if rivals:
        shared = len(set(rivals[0].frames) & set(path.frames))
        notes.append(
            f"a second ball, or its shadow, moves in {shared} of the same frames; the clearer one is tracked"
        )


def _made(
    times: Array,
    path: Path,
    size: tuple[int, int],
    notes: list[str],
    finder: Finder,
    pictures: dict[int, Image],
) -> Track:
    columns = np.full((3, len(times)), np.nan)
    steady, misfits = _steadied(path.spots)
    for frame, spot in zip(path.frames, steady, strict=True):
        columns[:, frame] = spot.u, spot.v, spot.radius
    columns[:, [f for f, wrong in zip(path.frames, misfits, strict=True) if wrong]] = np.nan
    u, v, radius = columns
    gone = int(np.isnan(u).sum())
    if gone:
        notes.append(
            f"{gone} of {len(times)} frames show no ball that could be measured; their cells are empty"
        )
    noise = (
        max(rough(u), rough(v))
        if len(times) > _WINDOW
        else float(np.median([s.scatter for s in path.spots]))
    )
    noise = (
        noise
        if np.isfinite(noise) and noise > 0
        else float(np.median([s.scatter for s in path.spots]))
    )
    return Track(times, u, v, radius, noise, size, tuple(notes), finder.background, pictures)


def _steadied(spots: list[Spot]) -> tuple[list[Spot], list[bool]]:
    """Middles fitted again with radii that change evenly along the path, as perspective has it on a
    straight line.

    The second list says whose own radius is too far from that: something else than the ball was
    measured there.
    """
    if len(spots) < _WINDOW:
        return spots, [False] * len(spots)
    places = np.array([(1.0, s.u, s.v) for s in spots])
    centre, spread = places.mean(axis=0), np.maximum(np.ptp(places, axis=0), 1.0)
    axes = np.linalg.svd((places - centre)[:, 1:], full_matrices=False)[2]
    along = (places - centre)[:, 1:] @ axes[0] / spread[1:].max()
    basis = np.stack([np.ones_like(along), along], axis=1)
    radius = np.array([s.radius for s in spots])
    weights = np.ones_like(radius)
    line = np.zeros(2)
    for _ in range(10):
        line = np.linalg.lstsq(basis * weights[:, None], radius * weights, rcond=None)[0]
        rest = np.abs(radius - basis @ line)
        weights = 1 / (1 + (rest / max(float(np.median(rest)), 0.02)) ** 2)
    fitted = np.maximum(basis @ line, 0.5)
    wrong = np.abs(radius - fitted) > np.maximum(_MISFIT * fitted, 1.0)
    return [s.with_radius(float(r)) for s, r in zip(spots, fitted, strict=True)], wrong.tolist()


def rough(values: Array) -> float:
    """1 sigma of what a cubic through nine samples in a row leaves, where they move; NaN if they
    never do.

    Windows with a gap are passed over, those with a bounce do not weigh much: the median counts.
    """
    if len(values) < _WINDOW:
        return float("nan")
    windows = sliding_window_view(values, _WINDOW)
    windows = windows[np.isfinite(windows).all(axis=1)]
    windows = windows[
        np.ptp(windows, axis=1)
        > 1e-3 * max(float(np.ptp(values[np.isfinite(values)])), 1e-12) * _WINDOW
    ]
    if not len(windows):
        return float("nan")
    basis = np.linalg.qr(np.vander(np.linspace(-1, 1, _WINDOW), 4))[0]
    rest = windows - windows @ basis @ basis.T
    return float(np.sqrt(np.median((rest**2).sum(axis=1)) / (_WINDOW - 4)))
