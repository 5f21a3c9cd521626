"""Tracking: where in each frame of a film the ball is, and nowhere where it is not to be seen."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from sims.base import Array, InputError
from sims.camera import background
from sims.camera.circle import Circle
from sims.camera.link import Path, joined, linked
from sims.camera.render import Image
from sims.camera.spots import Finder, Spot

_LEAST_FRAMES = 5
"""Frames that must show the ball."""
_WINDOW = 9
"""Samples in a row from which noise is told, and below which no path is steadied."""
_FEW = 8
"""Pictures on which both treatments of shadow are tried."""
_HELD = 200_000_000
"""Bytes of frames that are kept in memory."""
_FEWEST = 3
"""Pictures that must lack a thing before the background is said to have it."""
_MISFIT = 0.2
"""Share by which a radius may miss the line of its path."""
_SHADOWS = 0.8
"""Share of the agreement without shadows' treatment that suffices to treat them."""
_ROUNDS = 10
"""Rounds of reweighed least squares."""
_SURE = 0.02
"""Pixels; radii are not known better."""


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
    wanted = set(numbers)
    pictures = [picture for number, (_, picture) in enumerate(frames) if number in wanted]
    finder = _finder(pictures)
    spots = []
    for number, (_, picture) in enumerate(frames):
        if first <= number < end:
            spots.append(finder.spots(picture))
    paths = linked(spots)
    if not paths:
        raise InputError(_nothing(end - first, sum(map(bool, spots))))
    path, others = joined(paths)
    # what hardly moves may be a ball, but not one whose fall can be measured
    if len(path.frames) < _LEAST_FRAMES or path.travel < path.radius:
        raise InputError(_nothing(end - first, len(path.frames)))
    _others(path, others, notes)
    shown = {n - first: p for n, p in zip(numbers, pictures, strict=True)}
    return _measured(survey.times[first:end], path, survey.size, notes, finder, shown)


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
        frames = []
        held = 0
        for time, picture in self._source:
            held += picture.nbytes
            if held <= _HELD:
                frames.append((time, picture))
            else:
                # too many: what is held so far goes at once
                frames.clear()
            yield time, picture
        if held <= _HELD:
            self._kept = frames


def _nothing(frames: int, some: int) -> str:
    """The message that there is no ball, though something round is in `some` of the frames."""
    seen = f"something round in {some} of {frames} frames, but nothing" if some else "nothing"
    return (
        f"no ball found: {seen} that moves and stays round; "
        "film with a fixed camera and a ball unlike its background"
    )


def _shot(survey: background.Survey, notes: list[str]) -> tuple[int, int]:
    """First and behind the last frame of the longest part without a cut."""
    shots = survey.shots()
    first, end = max(shots, key=lambda shot: shot[1] - shot[0])
    if len(shots) > 1:
        cuts = ", ".join(f"{survey.times[cut]:.2f} s" for cut in survey.cuts[:5])
        span = f"{survey.times[first]:.2f} to {survey.times[end - 1]:.2f} s"
        notes.append(
            f"the film is cut or the camera moves (at {cuts}); "
            f"only the longest part is tracked, {span}"
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
    # twice: what the first background hides is seen against the second
    for _ in range(2):
        sigma = background.noise(pictures, plain)
        careful = Finder(plain, sigma, shadows=True)
        careless = Finder(plain, sigma, shadows=False)
        by_careful = [careful.spots(p, ghosts=True) for p in pictures[::every]]
        by_careless = [careless.spots(p, ghosts=True) for p in pictures[::every]]
        # a ball of the ground's own hue is itself taken for shadow; then shadow must be borne
        if _roundness(by_careful) >= _SHADOWS * _roundness(by_careless):
            best, known = careful, by_careful
        else:
            best, known = careless, by_careless
        found = []
        for i, picture in enumerate(pictures):
            if i % every == 0:
                found.append(known[i // every])
            else:
                found.append(best.spots(picture, ghosts=True))
        hiding = _hiding(found)
        shaded = None
        if best.shadows:
            shaded = _shaded([best.unshaded(picture) for picture in pictures])
        plain = background.without(pictures, hiding, plain, shaded)
    return Finder(plain, sigma, best.shadows)


def _roundness(pictures: list[list[Spot]]) -> float:
    """Share of rays that agree on each picture's best circle, added up."""
    return sum(
        max((spot.agree for spot in spots if not spot.ghost), default=0.0) for spots in pictures
    )


def _hiding(found: list[list[Spot]]) -> list[list[Circle]]:
    """Where something hides the background in each picture.

    A ball that rests for most of the film, or its shadow, gets into the median. Pictures that lack
    it there show the background, and the others do not.
    """
    balls: list[list[Circle]] = []
    ghosts: list[list[Circle]] = []
    for spots in found:
        balls.append([(s.u, s.v, s.radius) for s in spots if not s.ghost])
        ghosts.append([(s.u, s.v, s.radius) for s in spots if s.ghost])
    for one in [ghost for there in ghosts for ghost in there]:
        lacking = [any(_same(one, other) for other in there) for there in ghosts]
        # one or two pictures may lack it by mistake
        if sum(lacking) < _FEWEST:
            continue
        for there, lacks in zip(balls, lacking, strict=True):
            if not lacks:
                there.append(one)
    return balls


def _shaded(lit: list[NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """Where a shadow hides the background in each picture (n, height, width), seen by those in
    which it is gone.
    """
    stack = np.stack(lit)
    result: NDArray[np.bool_] = ~stack & (stack.sum(axis=0) >= _FEWEST)
    return result


def _same(a: Circle, b: Circle) -> bool:
    """Whether two circles are of one thing that stays where it is."""
    apart = abs(a[0] - b[0]) + abs(a[1] - b[1])
    return apart < 0.3 * b[2] + 0.5 and 0.7 < a[2] / b[2] < 1.4


def _others(path: Path, others: Sequence[Path], notes: list[str]) -> None:
    """Note that something else moved beside the ball."""
    frames = set(path.frames)
    for other in others:
        shared = len(frames & set(other.frames))
        # in passing, small or at rest it is no second ball
        beside = shared >= max(8, 0.25 * len(path.frames))
        moves = other.travel > 2 * other.radius
        if beside and moves and 0.4 < other.radius / path.radius < 2.5:
            notes.append(
                f"a second ball, or its shadow, moves in {shared} of the same frames; "
                "the clearer one is tracked"
            )
            return


def _measured(
    times: Array,
    path: Path,
    size: tuple[int, int],
    notes: list[str],
    finder: Finder,
    pictures: dict[int, Image],
) -> Track:
    """The track of a path, with noise and notes; `pictures` are a few of the frames."""
    columns = np.full((3, len(times)), np.nan)
    steady, misfits = _steadied(path.spots)
    for frame, spot, misfit in zip(path.frames, steady, misfits, strict=True):
        # an empty cell is better than something else's place
        if not misfit:
            columns[:, frame] = spot.u, spot.v, spot.radius
    u, v, radius = columns
    gone = int(np.isnan(u).sum())
    if gone:
        notes.append(
            f"{gone} of {len(times)} frames show no ball that could be measured; "
            "their cells are empty"
        )
    noise = np.nan
    if len(times) > _WINDOW:
        noise = max(rough(u), rough(v))
    # too short or all at rest: how far edges lie off their circles is the next best
    if not (np.isfinite(noise) and noise > 0):
        noise = float(np.median([spot.scatter for spot in path.spots]))
    return Track(
        times,
        u,
        v,
        radius,
        noise,
        size,
        tuple(notes),
        finder.background,
        pictures,
    )


def _steadied(spots: list[Spot]) -> tuple[list[Spot], list[bool]]:
    """Middles fitted again with radii that change evenly along the path, as perspective has it on a
    straight line.

    The second list says whose own radius is too far from that: something else than the ball was
    measured there.
    """
    if len(spots) < _WINDOW:
        return spots, [False] * len(spots)
    places = np.array([(spot.u, spot.v) for spot in spots])
    offsets = places - places.mean(axis=0)
    spread = np.maximum(np.ptp(places, axis=0), 1.0)
    # how far along the path's own direction, about -1 to 1
    axes = np.linalg.svd(offsets, full_matrices=False)[2]
    along = offsets @ axes[0] / spread.max()
    basis = np.stack([np.ones_like(along), along], axis=1)
    radius = np.array([s.radius for s in spots])
    weights = np.ones_like(radius)
    line = np.zeros(2)
    for _ in range(_ROUNDS):
        weighed = basis * weights[:, None]
        line = np.linalg.lstsq(weighed, radius * weights, rcond=None)[0]
        rest = np.abs(radius - basis @ line)
        # heavy tails: what was measured at something else must not bend the line
        width = max(float(np.median(rest)), _SURE)
        weights = 1 / (1 + (rest / width) ** 2)
    fitted = np.maximum(basis @ line, 0.5)
    allowed = np.maximum(_MISFIT * fitted, 1.0)
    wrong = np.abs(radius - fitted) > allowed
    steady = [s.with_radius(float(r)) for s, r in zip(spots, fitted, strict=True)]
    return steady, wrong.tolist()


def rough(values: Array) -> float:
    """1 sigma of what a cubic through nine samples in a row leaves, where they move; NaN if they
    never do.

    Windows with a gap are passed over, those with a bounce do not weigh much: the median counts.
    """
    if len(values) < _WINDOW:
        return float("nan")
    windows = sliding_window_view(values, _WINDOW)
    windows = windows[np.isfinite(windows).all(axis=1)]
    # at rest the same pixels give the same error again and again, which is no scatter
    there = values[np.isfinite(values)]
    travel = max(float(np.ptp(there)), 1e-12)
    windows = windows[np.ptp(windows, axis=1) > 1e-3 * travel * _WINDOW]
    if not len(windows):
        return float("nan")
    # what is left by a cubic, of four numbers, has four degrees of freedom less
    cubic = np.vander(np.linspace(-1, 1, _WINDOW), 4)
    basis = np.linalg.qr(cubic)[0]
    rest = windows - windows @ basis @ basis.T
    squares = (rest**2).sum(axis=1)
    return float(np.sqrt(np.median(squares) / (_WINDOW - 4)))
