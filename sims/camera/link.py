"""Spots of many pictures joined to the paths of the things that made them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sims.base import Array
from sims.camera.spots import Spot

_PATIENCE = 15
_ALIKE = (0.65, 1.55)
_LEAST = 3
_CHANCE = 0.5
_MEMORY = 20
"""Pictures over which the colour of a path is averaged."""
_TINGE, _SHARE = 25.0, 0.45
"""Grey levels, and share of the contrast with the background, by which a thing's colour may vary.
"""
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
        weight = 1.0 / min(len(self.spots) + 1, _MEMORY)
        self.tone = (1.0 - weight) * self.tone + weight * np.array(spot.colour)
        self.frames.append(frame)
        self.spots.append(spot)

    def expected(self, frame: int) -> tuple[float, float, float]:
        """Where it should be if it goes on straight (u, v), and how far from there it may be: a
        bounce turns it.
        """
        last = self.spots[-1]
        if len(self.spots) < 2:
            return last.u, last.v, 4 * last.radius + 10
        gap, before = self.frames[-1] - self.frames[-2], self.spots[-2]
        du, dv = (last.u - before.u) / gap, (last.v - before.v) / gap
        wait = frame - self.frames[-1]
        return (
            last.u + du * wait,
            last.v + dv * wait,
            2 * float(np.hypot(du, dv)) * wait + last.radius + 2,
        )

    def near(self, frame: int, spot: Spot) -> float:
        """Distance of a spot from where this should be, as a share of what is allowed; infinite for
        another thing.

        Where a ball meets its shadow and leaves it again, the shadow goes on as the ball went
        before; its colour tells.
        """
        u, v, reach = self.expected(frame)
        off = float(np.hypot(spot.u - u, spot.v - v)) / reach
        if off > 1 or not _ALIKE[0] < spot.radius / self.spots[-1].radius < _ALIKE[1]:
            return np.inf
        unlike = self.unlike(spot.colour, spot.contrast)
        return off + unlike if unlike <= 1 else np.inf

    def unlike(self, colour: Sequence[float], contrast: float) -> float:
        """How far a colour is from this one's, as a share of what light and compression may do to
        it.
        """
        tinge = _TINGE * (1.0 + _BLEEDS / self.spots[-1].radius)
        return float(np.abs(self.tone - colour).max()) / max(
            tinge, _SHARE * contrast, _SHARE * self.contrast
        )

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
        return float(np.linalg.norm(np.ptp(self.places, axis=0)))

    @property
    def weight(self) -> float:
        """How much speaks for it: edge, in pixels, that lies on circles beyond what chance lays
        there.

        Counted in pictures alone, a remnant of shadow that is there all the time would outweigh a
        ball.
        """
        return sum((s.agree - _CHANCE) * s.radius for s in self.spots)


def linked(pictures: Sequence[Sequence[Spot]]) -> list[Path]:
    """The paths in a film, the best first; short ones are left out."""
    done: list[Path] = []
    live: list[Path] = []
    for frame, spots in enumerate(pictures):
        done += [p for p in live if frame - p.frames[-1] > _PATIENCE]
        live = [p for p in live if frame - p.frames[-1] <= _PATIENCE]
        pairs = sorted(
            (p.near(frame, s), i, k) for i, p in enumerate(live) for k, s in enumerate(spots)
        )
        paths, taken = set(), set()
        for distance, i, k in pairs:
            if not np.isfinite(distance) or i in paths or k in taken:
                continue
            paths.add(i)
            taken.add(k)
            live[i].add(frame, spots[k])
        for k, spot in enumerate(spots):
            if k not in taken:
                live.append(Path())
                live[-1].add(frame, spot)
    return sorted(
        (p for p in done + live if len(p.frames) >= _LEAST),
        key=lambda p: -p.weight * (p.travel > p.radius),
    )


def joined(paths: Sequence[Path]) -> tuple[Path, list[Path]]:
    """The first path with those that go on where it was lost from view, and the other paths."""
    main, others = paths[0], []
    frames, spots = list(main.frames), list(main.spots)
    for path in paths[1:]:
        apart = not set(path.frames) & set(frames)
        alike = _ALIKE[0] < path.radius / main.radius < _ALIKE[1]
        alike &= main.unlike(path.tone.tolist(), path.contrast) <= 1
        if apart and alike and _aside(main.places, path.places) < 3 * main.radius:
            frames += path.frames
            spots += path.spots
        else:
            others.append(path)
    order = np.argsort(frames).tolist()
    return Path([frames[i] for i in order], [spots[i] for i in order], main.tone), others


def _aside(line: Array, points: Array) -> float:
    """Median distance of points from the straight line along which other points lie."""
    middle = line.mean(axis=0)
    _, _, axes = np.linalg.svd(line - middle, full_matrices=False)
    return float(np.median(np.abs((points - middle) @ axes[-1])))
