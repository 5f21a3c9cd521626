"""Motion under a constant force, with bounces, in closed form: no steps at all.

From impact to impact every coordinate is a parabola, so the engine goes from impact to impact, and
then reads all samples off the parabolas at once. s seconds after x and v,

    x(s) = x + v s + a s^2 / 2                                             (1)
    v(s) = v + a s                                                         (2)

and a ball at height H with upward speed u and downward acceleration g meets the ground after

    s = (u + w) / g = 2 H / (w - u),    w = sqrt(u^2 + 2 g H)              (3)

of which the first form loses digits where u < 0 and the second where u > 0 (W. H. Press et al.,
Numerical Recipes, 3rd edition, 2007, section 5.6).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sims.base import Array
from sims.engines.ground import Ground, Indices, Mask
from sims.system import Lanes, Motion


@dataclass
class Arcs:
    """Parabolas x + v s + a s^2 / 2, s seconds after t: lanes (n,), t (n, 1); x, v, a (n, D)."""

    lanes: Indices
    t: Array
    x: Array
    v: Array
    a: Array

    def take(self, chosen: Mask) -> Arcs:
        """Some of them."""
        return Arcs(
            lanes=self.lanes[chosen],
            t=self.t[chosen],
            x=self.x[chosen],
            v=self.v[chosen],
            a=self.a[chosen],
        )

    def joined(self, others: list[Arcs]) -> Arcs:
        """These and others, sorted by lane."""
        every = [self, *others]
        lanes = np.concatenate([arcs.lanes for arcs in every])
        order = np.argsort(lanes, kind="stable")

        def joined(name: str) -> Array:
            values: Array = np.concatenate([getattr(arcs, name) for arcs in every])
            return values[order]

        return Arcs(lanes[order], joined("t"), joined("x"), joined("v"), joined("a"))


def fly(lanes: Lanes, a: Array, ground: Ground | None) -> Motion:
    """The motion of lanes of constant acceleration `a` (L, D), over `ground` if there is any."""
    times = _kept_times(lanes)
    start = np.zeros((len(a), 1))
    first = Arcs(np.arange(len(a)), start, lanes.x, lanes.v, a)
    if ground is None:
        return _sampled(first, times)
    first.x = first.x.copy()  # the caller's, which what begins in the ground must not change
    first.x[:, -1:] = np.maximum(first.x[:, -1:], ground.floor)
    arcs: list[Arcs] = []
    first = _begun(first, ground)
    # What rests already has no impacts; the others lose one by one whose next impact is too late.
    moves = (first.a[:, -1] != 0) | (first.v[:, -1] != 0)
    now = first.take(moves)
    while now.lanes.size:
        s = _fall(now, ground.floor)
        impact = (now.t + s)[:, 0]
        last = times[now.lanes if len(times) > 1 else 0, -1]
        goes = impact <= last
        now, flies = _bounced(now.take(goes), s[goes], ground, a)
        arcs.append(now)
        now = now.take(flies)
    return _sampled(first.joined(arcs), times)


def _kept_times(lanes: Lanes) -> Array:
    """(L, R) instants of the states to be kept, or (1, R) if all lanes share them."""
    steps = lanes.steps[:1] if lanes.steps.strides[0] == 0 else lanes.steps
    start = np.zeros((len(steps), 1))
    times = np.concatenate([start, np.cumsum(steps, axis=1)], axis=1)
    return np.ascontiguousarray(times[:, :: lanes.every])


def _begun(arcs: Arcs, ground: Ground) -> Arcs:
    """The first arcs, with those that start on the ground thrown back or laid to rest."""
    rate = arcs.v[:, -1]
    down = (arcs.x[:, -1] <= ground.floor[:, 0]) & (rate <= 0)
    if not down.any():
        return arcs
    struck = np.flatnonzero(down & (rate < 0))
    outcome = ground.strike(struck, arcs.v[struck], arcs.a[struck])
    arcs.v = arcs.v.copy()
    arcs.v[struck] = outcome.v
    still = arcs.v[:, -1] == 0
    rests = down & still & (arcs.a[:, -1] <= 0)
    arcs.a = arcs.a.copy()
    arcs.a[rests, -1] = 0.0
    return arcs


def _fall(arcs: Arcs, floor: Array) -> Array:
    """(n, 1) seconds to the impact; infinite if there is none."""
    high = arcs.x[:, -1:] - floor[arcs.lanes]
    up = arcs.v[:, -1:]
    down = -arcs.a[:, -1:]
    root = np.sqrt(up * up + 2.0 * down * high)  # not a number if it turns back before
    rising = np.where(down > 0, (up + root) / down, np.inf)
    falling = 2.0 * high / (root - up)
    seconds = np.where(up < 0, falling, rising)  # (3)
    result: Array = np.where(np.isnan(seconds), np.inf, seconds)
    return result


def _bounced(arcs: Arcs, s: Array, ground: Ground, a: Array) -> tuple[Arcs, Mask]:
    """The arcs after the impact s (n, 1) seconds on, and which of them fly again."""
    x = arcs.x + s * (arcs.v + s * (0.5 * arcs.a))  # (1)
    outcome = ground.strike(arcs.lanes, arcs.v + s * arcs.a, arcs.a)  # (2)
    x[:, -1:] = ground.floor[arcs.lanes]  # without the rounding of (1) and (3)
    after = a[arcs.lanes]
    after[outcome.rests, -1] = 0.0  # the ground bears what rests on it
    return Arcs(arcs.lanes, arcs.t + s, x, outcome.v, after), ~outcome.rests


def _sampled(arcs: Arcs, times: Array) -> Motion:
    """States at the instants times (L or 1, R), of arcs that are sorted by lane."""
    lanes = int(arcs.lanes[-1]) + 1
    instants = times.shape[1]
    # Each arc has the instants from its beginning to that of the next arc of its lane, or to the
    # last one.
    begins = _places(times, arcs)
    same_lane = arcs.lanes[1:] == arcs.lanes[:-1]
    ends = np.append(np.where(same_lane, begins[1:], instants), instants)
    counts = ends - begins

    def spread(values: Array) -> Array:
        return np.repeat(values, counts).reshape(lanes, instants)

    s = times - spread(arcs.t[:, 0])
    result = np.empty((3, arcs.x.shape[1], lanes, instants))
    for d in range(arcs.x.shape[1]):
        x, v, a = result[:, d]
        x[...] = spread(arcs.x[:, d])
        v[...] = spread(arcs.v[:, d])
        a[...] = spread(arcs.a[:, d])
        x += s * (v + s * (0.5 * a))  # (1), before v is overwritten
        v += s * a  # (2)
    x, v, a = np.moveaxis(result, 1, 3)
    return Motion(x, v, a)


def _places(times: Array, arcs: Arcs) -> Indices:
    """(n,) for each arc the first instant of its lane that is not before it begins."""
    begins = arcs.t[:, 0]
    if len(times) == 1:
        return np.searchsorted(times[0], begins)
    # Bisection of all arcs at once: `searchsorted` takes one row of instants, here each lane has
    # its own.
    size = times.shape[1]
    low = np.zeros(begins.size, dtype=np.intp)
    high = np.full(begins.size, size, dtype=np.intp)
    for _ in range(size.bit_length()):
        middle = (low + high) // 2
        there = times[arcs.lanes, np.minimum(middle, size - 1)]
        before = (there < begins) & (low < high)
        low = np.where(before, middle + 1, low)
        high = np.where(before, high, middle)
    return low
