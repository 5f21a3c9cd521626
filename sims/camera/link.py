"""Spots of many pictures joined to the paths of the things that made them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sims.base import Array
from sims.camera.spots import Spot

_PATIENCE = 15
"""Pictures for which a thing may be lost from view and still be the same."""
_ALIKE = (0.65, 1.55)
"""Between these a radius may be of another picture's: the way towards the camera, and blur."""
_LEAST = 3
"""Pictures that show a thing; what fewer show is noise."""
_CHANCE = 0.5
"""Share of the rays that agree on a circle by chance."""
_MEMORY = 20
"""Pictures over which the colour of a path is averaged."""
_TINGE = 25.0
"""Grey levels by which a thing's colour may vary."""
_SHARE = 0.45
"""Share of its contrast with the background by which it may vary as well."""
_BEHIND = 3
"""Median radii from a path's line within which another path may be its continuation."""
_BLEEDS = 1.5
"""Pixels over which video files, which keep colours at half the resolution, mix a ball's with the
background's.
"""


@dataclass
class Path:
    """One thing's way: numbers of the pictures that show it, and where."""

    frames: list[int] = field(default_factory=list)
    spots: list[Spot] = field(default_factory=list)
    tone: Array = field(default_factory=lambda: np.zeros(3))

    def add(self, frame: int, spot: Spot) -> None:
        """Go on with a spot of one more picture."""
        # a plain mean at first, later one that forgets: light changes along the way
        count = len(self.spots) + 1
        weight = 1.0 / min(count, _MEMORY)
        colour = np.array(spot.colour)
        self.tone = (1.0 - weight) * self.tone + weight * colour
        self.frames.append(frame)
        self.spots.append(spot)

    def expected(self, frame: int) -> tuple[float, float, float]:
        """Where it should be if it goes on straight (u, v), and how far from there it may be: a
        bounce turns it.
        """
        last = self.spots[-1]
        u, v = last.u, last.v
        # of one picture nobody knows where it goes
        if len(self.spots) < 2:
            return u, v, 4 * last.radius + 10
        before = self.spots[-2]
        gap = self.frames[-1] - self.frames[-2]
        du = (u - before.u) / gap
        dv = (v - before.v) / gap
        wait = frame - self.frames[-1]
        # twice the way: one that turns round is as far from where it should be
        speed = float(np.hypot(du, dv))
        reach = 2 * speed * wait + last.radius + 2
        return u + du * wait, v + dv * wait, reach

    def near(self, frame: int, spot: Spot) -> float:
        """Distance of a spot from where this should be, as a share of what is allowed; infinite for
        another thing.

        Where a ball meets its shadow and leaves it again, the shadow goes on as the ball went
        before; its colour tells.
        """
        u, v, reach = self.expected(frame)
        off = float(np.hypot(spot.u - u, spot.v - v)) / reach
        if off > 1:
            return np.inf
        low, high = _ALIKE
        if not low < spot.radius / self.spots[-1].radius < high:
            return np.inf
        unlike = self.unlike(spot.colour, spot.contrast)
        return off + unlike if unlike <= 1 else np.inf

    def unlike(self, colour: Sequence[float], contrast: float) -> float:
        """How far a colour is from this one's, as a share of what light and compression may do to
        it.
        """
        # the smaller the ball, the more of it is mixed with the background
        tinge = _TINGE * (1.0 + _BLEEDS / self.spots[-1].radius)
        allowed = max(
            tinge,
            _SHARE * contrast,
            _SHARE * self.contrast,
        )
        apart = np.abs(self.tone - colour)
        return float(apart.max()) / allowed

    @property
    def contrast(self) -> float:
        """Of its last picture."""
        return self.spots[-1].contrast

    @property
    def radius(self) -> float:
        """Its median radius."""
        return float(np.median([s.radius for s in self.spots]))

    @property
    def places(self) -> Array:
        """Middles (n, 2)."""
        return np.array([(s.u, s.v) for s in self.spots])

    @property
    def travel(self) -> float:
        """How far it gets, corner to corner of what it visits, in pixels."""
        spans = np.ptp(self.places, axis=0)
        return float(np.linalg.norm(spans))

    @property
    def weight(self) -> float:
        """How much speaks for it: edge, in pixels, that lies on circles beyond what chance lays
        there.

        Counted in pictures alone, a remnant of shadow that is there all the time would outweigh a
        ball.
        """
        return sum((spot.agree - _CHANCE) * spot.radius for spot in self.spots)


def linked(pictures: Sequence[Sequence[Spot]]) -> list[Path]:
    """The paths in a film, the best first; short ones are left out."""
    done: list[Path] = []
    live: list[Path] = []
    for frame, spots in enumerate(pictures):
        done += [path for path in live if frame - path.frames[-1] > _PATIENCE]
        live = [path for path in live if frame - path.frames[-1] <= _PATIENCE]
        taken = _continued(live, frame, spots)
        # what continues nothing begins something
        for k, spot in enumerate(spots):
            if k not in taken:
                path = Path()
                path.add(frame, spot)
                live.append(path)
    paths = [path for path in done + live if len(path.frames) >= _LEAST]
    # what stays where it is comes last, whatever speaks for it
    return sorted(paths, key=lambda path: -path.weight * (path.travel > path.radius))


def _continued(live: Sequence[Path], frame: int, spots: Sequence[Spot]) -> set[int]:
    """Add each spot to the path that it suits best; the numbers of the spots that suit one."""
    pairs = []
    for i, path in enumerate(live):
        for k, spot in enumerate(spots):
            distance = path.near(frame, spot)
            if np.isfinite(distance):
                pairs.append((distance, i, k))
    paths: set[int] = set()
    taken: set[int] = set()
    # the nearest pair first; a path gets one spot, and a spot one path
    for _, i, k in sorted(pairs):
        if i in paths or k in taken:
            continue
        paths.add(i)
        taken.add(k)
        live[i].add(frame, spots[k])
    return taken


def joined(paths: Sequence[Path]) -> tuple[Path, list[Path]]:
    """The first path with those that go on where it was lost from view, and the other paths."""
    main = paths[0]
    others = []
    frames = list(main.frames)
    spots = list(main.spots)
    low, high = _ALIKE
    for path in paths[1:]:
        # one ball is in one place: what shows in the same picture is another thing
        apart = not set(path.frames) & set(frames)
        alike = low < path.radius / main.radius < high
        alike &= main.unlike(path.tone.tolist(), path.contrast) <= 1
        aside = _aside(main.places, path.places)
        if apart and alike and aside < _BEHIND * main.radius:
            frames += path.frames
            spots += path.spots
        else:
            others.append(path)
    order = np.argsort(frames).tolist()
    whole = Path(
        [frames[i] for i in order],
        [spots[i] for i in order],
        main.tone,
    )
    return whole, others


def _aside(line: Array, points: Array) -> float:
    """Median distance of points from the straight line along which other points lie."""
    middle = line.mean(axis=0)
    # the last axis is the one across, along which the line's points differ least
    _, _, axes = np.linalg.svd(line - middle, full_matrices=False)
    across = (points - middle) @ axes[-1]
    return float(np.median(np.abs(across)))
