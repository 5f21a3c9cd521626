"""Heights in metres from a tracked ball.

With the camera known they follow exactly. Without it: along the straight line of a vertical fall
the inverse depth, and so the ball's radius r in pixels, is linear in the place s on the picture,
and height is a projective function of s. Both together leave one unknown factor S:

    z = radius + S (s_ground - s) / r(s)                (1)

For a camera that looks level S is the ball's radius in metres. A camera that looks down sees
heights shortened and not the ball, so S is larger; then the fall itself tells it, since the second
derivative of z must be -g.

With q = s / r(s), and since r is linear in s, (1) is the following but for a constant factor, which
the unknown S takes up; g is gravity:

    z = radius + S (q_ground - q)                       (2)
    q'' = g / S in flight                               (3)
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
"""m/s^2, where a film does not know better."""
_ARC = 7
"""Frames that a flight has at least: fewer do not tell a parabola."""
_RISE = 0.3
"""What a flight extends over at least, in radii, or in metres where it is of heights."""
_HELD = 0.25
"""Seconds for which a ball is held at least before it is said to be."""
_DIFFER = 0.05
"""Share by which the fall's scale and the diameter's differ that is said."""
_MEETING = 0.1
"""Seconds around the end of a flight and the beginning of the next within which they meet."""
_FITS = 3
"""Of the radius: the first weighs all frames alike, the others by what the one before left."""


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
        sizes = f"the camera's picture has {camera.size} px, the film {track.size}"
        raise InputError(f"{sizes}; expected the same shape")
    # A film may have been scaled: the camera is scaled with it.
    camera = camera.resized(*track.size)
    z = camera.heights(np.stack([track.u, track.v], axis=1), filmed.x, filmed.y, filmed.radius)
    return Heights(z, filmed.radius, "through the known camera")


def by_scale(track: Track, diameter: float | None, scale: str | None) -> Heights:
    """Heights from the ball's diameter [m], or from the fall where `scale` is "fall" or no diameter
    is given.

    Raises:
        InputError: the film does not show what that needs.
    """
    q = _place(track) / _radius(track)
    arcs = _arcs(track.times, q)
    ground = _ground(track, q, arcs)
    fallen = _factor(arcs)
    notes = []
    if diameter is None or scale == "fall":
        if fallen is None:
            raise InputError(
                "the scale is unknown: no flight of this film shows gravity clearly; "
                "give the ball's diameter"
            )
        factor = fallen
        how = f"scaled by the fall (gravity {GRAVITY:g} m/s^2; a drag would be taken for scale)"
        # Without a diameter the ball is as large as a level camera would have it.
        ball = diameter / 2 if diameter else factor
    else:
        factor = ball = diameter / 2
        how = "scaled by the ball's diameter, as for a camera that looks level"
        if fallen is not None and abs(fallen / factor - 1) > _DIFFER:
            notes.append(
                f"the fall says {fallen / factor - 1:+.0%} for all heights: the camera looks down "
                "or up, or gravity is not 9.81 m/s^2; the scale 'fall' uses the fall"
            )
    return Heights(ball + factor * (ground - q), ball, how, tuple(notes))  # (2)


def _place(track: Track) -> Array:
    """Place along the line of the fall, down positive, px, such that the line's own perspective is
    in `_radius`.
    """
    seen = track.seen
    points = np.stack([track.u[seen], track.v[seen]], axis=1)
    middle = points.mean(axis=0)
    # The line of the fall is the direction in which the points spread most; v counts downwards.
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
    places, radii = s[seen], track.radius[seen]
    line = np.polyfit(places, radii, 1)
    for _ in range(_FITS):
        rest = np.abs(radii - np.polyval(line, places))
        # A frame whose outline is far off, as at an impact, hardly counts.
        typical = max(float(np.median(rest)), 1e-9)
        line = np.polyfit(places, radii, 1, w=1 / (1 + (rest / typical) ** 2))
    # The line may cross zero beyond the frames that show the ball; a radius may not.
    result: Array = np.maximum(np.polyval(line, s), 0.3 * float(np.median(radii)))
    return result


def _arcs(times: Array, q: Array) -> list[_Arc]:
    """Flights: stretches between places where the ball turns from down to up, each with its
    parabola.
    """
    seen = np.flatnonzero(np.isfinite(q))
    last = len(seen) - 1
    # q counts downwards: the ball is lowest where q is largest.
    lowest = [i for i in range(1, last) if q[seen[i - 1]] < q[seen[i]] >= q[seen[i + 1]]]
    arcs = []
    for a, b in pairwise([0, *lowest, last]):
        # The frame of the bounce itself belongs to no flight.
        inside = seen[a + (a > 0) : b - (b < last) + 1]
        if len(inside) < _ARC or np.ptp(q[inside]) < _RISE:
            continue
        t = times[inside]
        curve, rest, *_ = np.polyfit(t, q[inside], 2, full=True)
        scatter = float(np.sqrt(rest[0] / len(t))) if len(rest) else 0.0
        # What is no parabola is no flight: a hand, a roll, another ball.
        if scatter < 0.05 * np.ptp(q[inside]) + 0.02:
            # The variance of a parabola's curvature goes as 1 / (n T^4), for n samples in T.
            arcs.append(_Arc(curve, t[0], t[-1], len(t) * float(t[-1] - t[0]) ** 4))
    return arcs


def _factor(arcs: list[_Arc]) -> float | None:
    """S for which the flights fall with gravity: its `q` has the second derivative g / S."""
    falling = [arc for arc in arcs if arc.curve[0] > 0]
    if not falling:
        return None
    curvatures = [2 * arc.curve[0] for arc in falling]
    mean = np.average(curvatures, weights=[arc.weight for arc in falling])
    return float(GRAVITY / mean)  # (3)


def _ground(track: Track, q: Array, arcs: list[_Arc]) -> float:
    """`q` where the ball touches the ground: where flights meet, or where it lies."""
    meets = []
    for before, after in pairwise(arcs):
        roots = np.roots(before.curve - after.curve)
        # Two parabolas meet twice at most: at the bounce, and where neither flight is.
        begin, end = before.end - _MEETING, after.begin + _MEETING
        real = [r.real for r in roots if abs(r.imag) < 1e-9 and begin < r.real < end]
        meets += [float(np.polyval(before.curve, r)) for r in real[:1]]
    if meets:
        return float(np.median(meets))
    # Without two flights: the lowest place, but for frames in which the tracker erred.
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
            cubic = np.polyfit(t, z[inside], 3)
            squares += float(np.sum((z[inside] - np.polyval(cubic, t)) ** 2))
            # Four coefficients are fitted.
            freedom += len(t) - 4
    return float(np.sqrt(squares / freedom)) if freedom else float("nan")


def released(track: Track) -> int:
    """The frame at which the ball begins to move; 0 unless it is held for a while before."""
    s, seen = _place(track), track.seen
    start = float(np.median(s[seen[:5]]))
    # A hand trembles, and an outline errs: a pixel, or four sigmas, is no fall yet.
    moved = np.flatnonzero(np.abs(s[seen] - start) > max(1.0, 4 * track.noise))
    first = int(seen[0])
    if not len(moved):
        return first
    release = int(seen[moved[0]])
    held = track.times[release] - track.times[first]
    return first if held < _HELD else release
