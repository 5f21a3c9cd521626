"""Heights in metres from a tracked ball.

With the camera known they follow exactly. Without it: along the straight line of a vertical fall
the inverse depth, and so the ball's radius r in pixels, is linear in the place s on the picture,
and height is a projective function of s. Both together leave one unknown factor S:

    z = radius + S (s_ground - s) / r(s)

For a camera that looks level S is the ball's radius in metres. A camera that looks down sees
heights shortened and not the ball, so S is larger; then the fall itself tells it, since the second
derivative of z must be -g.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sims.base import Array, InputError
from sims.camera.files import Filmed
from sims.camera.track import Track

GRAVITY = 9.81
_ARC = 7
_HELD = 0.25
_DIFFER = 0.05


@dataclass(frozen=True)
class Heights:
    """Heights z (n,) of the ball's centre in metres, its radius in metres, how they were found, and
    what to know.
    """

    z: Array
    radius: float
    how: str
    notes: tuple[str, ...] = ()


class _Arc(NamedTuple):
    """A flight between bounces: its coefficients (curvature first), from when to when, and how
    firmly it tells.
    """

    curve: Array
    begin: float
    end: float
    weight: float


def by_camera(track: Track, filmed: Filmed) -> Heights:
    """Heights through the camera that made the film.

    Raises:
        InputError: the camera's picture has another shape than the film's.
    """
    camera = filmed.camera
    if camera.size[0] * track.size[1] != camera.size[1] * track.size[0]:
        raise InputError(
            f"the camera's picture has {camera.size} px, the film {track.size}; expected the same shape"
        )
    camera = camera.resized(*track.size)
    z = camera.heights(np.stack([track.u, track.v], axis=1), filmed.x, filmed.y, filmed.radius)
    return Heights(z, filmed.radius, "through the known camera")


def by_scale(track: Track, diameter: float | None, scale: str | None) -> Heights:
    """Heights from the ball's diameter [m], or from the fall where `scale` is "fall" or no diameter
    is given.

    Raises:
        InputError: the film does not show what that needs.
    """
    s, radius = _place(track), _radius(track)
    rest = s / radius
    arcs = _arcs(track.times, rest)
    ground = _ground(track, rest, arcs)
    fallen = _factor(arcs)
    notes = []
    if diameter is None or scale == "fall":
        if fallen is None:
            raise InputError(
                "the scale is unknown: no flight of this film shows gravity clearly; give --ball-diameter METRES"
            )
        factor, how = (
            fallen,
            f"scaled by the fall (gravity {GRAVITY:g} m/s^2; a drag would be taken for scale)",
        )
        ball = diameter / 2 if diameter else factor
    else:
        factor, how, ball = (
            diameter / 2,
            "scaled by the ball's diameter, as for a camera that looks level",
            diameter / 2,
        )
        if fallen is not None and abs(fallen / factor - 1) > _DIFFER:
            notes.append(
                f"the fall says {fallen / factor - 1:+.0%} for all heights: the camera looks down or up, "
                "or gravity is not 9.81 m/s^2; --scale fall uses the fall"
            )
    return Heights(ball + factor * (ground - rest), ball, how, tuple(notes))


def _place(track: Track) -> Array:
    """Place along the line of the fall, down positive, px, such that the line's own perspective is
    in `_radius`.
    """
    seen = track.seen
    points = np.stack([track.u[seen], track.v[seen]], axis=1)
    middle = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - middle, full_matrices=False)
    axis = axes[0] * (1.0 if axes[0][1] >= 0 else -1.0)
    if abs(axis[1]) < 0.5:
        raise InputError(
            "the ball moves across the picture rather than down; expected a drop filmed upright"
        )
    result: Array = (np.stack([track.u, track.v], axis=1) - middle) @ axis
    return result


def _radius(track: Track) -> Array:
    """The radius as a linear function of the place: what one frame says is too noisy."""
    s, seen = _place(track), track.seen
    line = np.polyfit(s[seen], track.radius[seen], 1)
    for _ in range(3):
        rest = np.abs(track.radius[seen] - np.polyval(line, s[seen]))
        line = np.polyfit(
            s[seen],
            track.radius[seen],
            1,
            w=1 / (1 + (rest / max(float(np.median(rest)), 1e-9)) ** 2),
        )
    result: Array = np.maximum(np.polyval(line, s), 0.3 * float(np.median(track.radius[seen])))
    return result


def _arcs(times: Array, q: Array) -> list[_Arc]:
    """Flights: stretches between places where the ball turns from down to up, each with its
    parabola.
    """
    seen = np.flatnonzero(np.isfinite(q))
    lowest = [i for i in range(1, len(seen) - 1) if q[seen[i - 1]] < q[seen[i]] >= q[seen[i + 1]]]
    edges = [0, *lowest, len(seen) - 1]
    arcs = []
    for a, b in pairwise(edges):
        inside = seen[a + (a > 0) : b - (b < len(seen) - 1) + 1]
        if len(inside) < _ARC or np.ptp(q[inside]) < 0.3:
            continue
        t = times[inside]
        curve, rest, *_ = np.polyfit(t, q[inside], 2, full=True)
        scatter = float(np.sqrt(rest[0] / len(t))) if len(rest) else 0.0
        if scatter < 0.05 * np.ptp(q[inside]) + 0.02:
            arcs.append(_Arc(curve, t[0], t[-1], len(t) * float(t[-1] - t[0]) ** 4))
    return arcs


def _factor(arcs: list[_Arc]) -> float | None:
    """S for which the flights fall with gravity: its `q` has the second derivative g / S."""
    falling = [arc for arc in arcs if arc.curve[0] > 0]
    if not falling:
        return None
    mean = np.average(
        [2 * arc.curve[0] for arc in falling], weights=[arc.weight for arc in falling]
    )
    return float(GRAVITY / mean)


def _ground(track: Track, q: Array, arcs: list[_Arc]) -> float:
    """`q` where the ball touches the ground: where flights meet, or where it lies."""
    meets = []
    for before, after in pairwise(arcs):
        roots = np.roots(before.curve - after.curve)
        real = [
            r.real
            for r in roots
            if abs(r.imag) < 1e-9 and before.end - 0.1 < r.real < after.begin + 0.1
        ]
        meets += [float(np.polyval(before.curve, r)) for r in real[:1]]
    if meets:
        return float(np.median(meets))
    return float(np.nanpercentile(q, 99.5)) if len(track.seen) else 0.0


def scatter(times: Array, z: Array) -> float:
    """1 sigma of what a cubic leaves of each flight, m: also errors that last for several samples;
    NaN without flight.

    A cubic has room for gravity and a drag. White noise estimated from neighbouring samples alone
    would pass over the errors that a slowly changing outline makes.
    """
    squares, freedom = 0.0, 0
    for arc in _arcs(times, -z):
        inside = (times >= arc.begin) & (times <= arc.end) & np.isfinite(z)
        t = times[inside] - arc.begin
        if len(t) > _ARC:
            squares += float(np.sum((z[inside] - np.polyval(np.polyfit(t, z[inside], 3), t)) ** 2))
            freedom += len(t) - 4
    return float(np.sqrt(squares / freedom)) if freedom else float("nan")


def released(track: Track) -> int:
    """The frame at which the ball begins to move; 0 unless it is held for a while before."""
    s, seen = _place(track), track.seen
    start = float(np.median(s[seen[:5]]))
    moved = np.flatnonzero(np.abs(s[seen] - start) > max(1.0, 4 * track.noise))
    if not len(moved) or track.times[seen[moved[0]]] - track.times[seen[0]] < _HELD:
        return int(seen[0])
    return int(seen[moved[0]])
