"""Closed-form motion under a constant force, with bounces, without steps.

Between impacts every coordinate is a parabola. The engine advances from impact to impact, and then
evaluates all samples on the parabolas. A time s after state x, v,

    x(s) = x + v s + a s^2 / 2                                             (1)
    v(s) = v + a s                                                         (2)

and a ball at height H with upward speed u and downward acceleration g meets the ground after

    s = (u + w) / g = 2 H / (w - u),    w = sqrt(u^2 + 2 g H)              (3)

of which the first form has cancellation for u < 0 and the second for u > 0 (W. H. Press et al.,
Numerical Recipes, 3rd edition, 2007, section 5.6).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sims.core.simulator import Array
from sims.core.system import IntegrationBatch, Trajectories
from sims.engines.ground_contact import GroundContact, Indices, Mask


@dataclass
class BallisticArcs:
    """Parabolas x + v s + a s^2 / 2, a time s after t.

    Attributes:
        lanes: (n,) batch element of each parabola.
        t: (n, 1) start times in seconds.
        x: (n, D) positions at the start.
        v: (n, D) velocities at the start.
        a: (n, D) accelerations.
    """

    lanes: Indices
    t: Array
    x: Array
    v: Array
    a: Array

    def select(self, chosen: Mask) -> BallisticArcs:
        """Return the arcs selected by a mask (n,)."""
        return BallisticArcs(
            lanes=self.lanes[chosen],
            t=self.t[chosen],
            x=self.x[chosen],
            v=self.v[chosen],
            a=self.a[chosen],
        )

    def concatenate(self, others: list[BallisticArcs]) -> BallisticArcs:
        """Return these arcs and others, sorted by batch element."""
        every = [self, *others]
        lanes = np.concatenate([arcs.lanes for arcs in every])
        order = np.argsort(lanes, kind="stable")

        def joined(name: str) -> Array:
            values: Array = np.concatenate([getattr(arcs, name) for arcs in every])
            return values[order]

        return BallisticArcs(lanes[order], joined("t"), joined("x"), joined("v"), joined("a"))


def integrate_ballistic(
    lanes: IntegrationBatch, a: Array, ground: GroundContact | None
) -> Trajectories:
    """Integrate elements with constant acceleration, with impacts if there is a ground.

    Args:
        lanes: batch to integrate.
        a: (L, D) accelerations.
        ground: ground contact; None without ground.

    Returns:
        The trajectories.
    """
    times = _kept_times(lanes)
    start = np.zeros((len(a), 1))
    first = BallisticArcs(np.arange(len(a)), start, lanes.x, lanes.v, a)
    if ground is None:
        return _sampled(first, times)
    first.x = first.x.copy()  # the caller's array must not be changed
    first.x[:, -1:] = np.maximum(first.x[:, -1:], ground.floor)
    arcs: list[BallisticArcs] = []
    first = _begun(first, ground)
    # Resting elements have no impacts; the others are removed when their next impact is after the
    # end.
    moves = (first.a[:, -1] != 0) | (first.v[:, -1] != 0)
    now = first.select(moves)
    while now.lanes.size:
        s = _fall(now, ground.floor)
        impact = (now.t + s)[:, 0]
        last = times[now.lanes if len(times) > 1 else 0, -1]
        goes = impact <= last
        now, flies = _bounced(now.select(goes), s[goes], ground, a)
        arcs.append(now)
        now = now.select(flies)
    return _sampled(first.concatenate(arcs), times)


def _kept_times(lanes: IntegrationBatch) -> Array:
    """Return the times (L, R) of the recorded states, or (1, R) if all elements share them."""
    steps = lanes.steps[:1] if lanes.steps.strides[0] == 0 else lanes.steps
    start = np.zeros((len(steps), 1))
    times = np.concatenate([start, np.cumsum(steps, axis=1)], axis=1)
    return np.ascontiguousarray(times[:, :: lanes.steps_per_sample])


def _begun(arcs: BallisticArcs, ground: GroundContact) -> BallisticArcs:
    """Return the first arcs, with impact or rest of elements that start on the ground."""
    rate = arcs.v[:, -1]
    down = (arcs.x[:, -1] <= ground.floor[:, 0]) & (rate <= 0)
    if not down.any():
        return arcs
    struck = np.flatnonzero(down & (rate < 0))
    outcome = ground.resolve_impacts(struck, arcs.v[struck], arcs.a[struck])
    arcs.v = arcs.v.copy()
    arcs.v[struck] = outcome.v
    still = arcs.v[:, -1] == 0
    rests = down & still & (arcs.a[:, -1] <= 0)
    arcs.a = arcs.a.copy()
    arcs.a[rests, -1] = 0.0
    return arcs


def _fall(arcs: BallisticArcs, floor: Array) -> Array:
    """Return the seconds (n, 1) to the next impact; infinite if there is none."""
    high = arcs.x[:, -1:] - floor[arcs.lanes]
    up = arcs.v[:, -1:]
    down = -arcs.a[:, -1:]
    root = np.sqrt(up * up + 2.0 * down * high)  # NaN if it does not reach the ground
    rising = np.where(down > 0, (up + root) / down, np.inf)
    falling = 2.0 * high / (root - up)
    seconds = np.where(up < 0, falling, rising)  # (3)
    result: Array = np.where(np.isnan(seconds), np.inf, seconds)
    return result


def _bounced(
    arcs: BallisticArcs, s: Array, ground: GroundContact, a: Array
) -> tuple[BallisticArcs, Mask]:
    """Return the arcs after the impact.

    Args:
        arcs: arcs before the impact.
        s: (n, 1) seconds from the start of the arc to the impact.
        ground: ground contact.
        a: (L, D) accelerations of free motion.

    Returns:
        The arcs after the impact, and which elements (n,) continue to bounce.
    """
    x = arcs.x + s * (arcs.v + s * (0.5 * arcs.a))  # (1)
    outcome = ground.resolve_impacts(arcs.lanes, arcs.v + s * arcs.a, arcs.a)  # (2)
    x[:, -1:] = ground.floor[arcs.lanes]  # removes the rounding of (1) and (3)
    after = a[arcs.lanes]
    after[outcome.is_resting, -1] = 0.0  # the ground supports resting elements
    return BallisticArcs(arcs.lanes, arcs.t + s, x, outcome.v, after), ~outcome.is_resting


def _sampled(arcs: BallisticArcs, times: Array) -> Trajectories:
    """Return the states at times (L or 1, R), from arcs sorted by batch element."""
    lanes = int(arcs.lanes[-1]) + 1
    instants = times.shape[1]
    # Each arc covers the samples from its beginning to that of the next arc of its element, or to
    # the last sample.
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
        x += s * (v + s * (0.5 * a))  # (1), computed before v is overwritten
        v += s * a  # (2)
    x, v, a = np.moveaxis(result, 1, 3)
    return Trajectories(x, v, a)


def _places(times: Array, arcs: BallisticArcs) -> Indices:
    """Return the index (n,) of the first sample of its element that is not before each arc."""
    begins = arcs.t[:, 0]
    if len(times) == 1:
        return np.searchsorted(times[0], begins)
    # All arcs are bisected together, because `searchsorted` accepts only one row of times, while
    # here each element has its own.
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
