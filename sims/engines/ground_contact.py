"""Impacts with level ground: velocity after an impact, and end of bouncing.

The last coordinate strikes the ground at its `floor`; the others are tangential. Restitution e is
the system's, modified by the contact effects in their order. With the normal speed n and the
tangential velocity u before the impact,

    n' = e n                                                               (1)
    u' = u max(1 - mu (1 + e) n / |u|, 1 - g)                              (2)

so the ground removes the tangential speed mu (1 + e) n, but never more than there is (R. M. Brach,
J. Appl. Mech. 56(1), 133, 1989, doi:10.1115/1.3176033). The maximum tangential impulse share g is
1, or less where the system specifies at which share a body that starts to spin begins to roll. A
ball that rests on the ground has no impacts and is not slowed by it.

A ball with e < 1 stops bouncing in finite time after infinitely many bounces. A flight that starts
with speed n' under a downward acceleration f lasts

    2 n' / f                                                               (3)

Bouncing is treated as finished when this time is less than `MIN_FLIGHT_SECONDS`, or after more than
`MAX_SHORT_FLIGHTS` consecutive flights shorter than `SHORT_FLIGHT_SECONDS`. The omitted bounces
have impact speeds n', e
n', e^2 n', ..., and the tangential speed that they would remove is removed at once:

    mu (1 + e) (n' + e n' + e^2 n' + ...) = mu (1 + e) n' / (1 - e)        (4)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Array
from sims.core.system import Contact, IntegrationBatch

Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

MIN_FLIGHT_SECONDS = 5e-5
"""Minimum duration of a flight in seconds; a flight of this duration rises 3 nm."""
SHORT_FLIGHT_SECONDS = 2e-3
"""Duration in seconds below which a flight counts as short, see `MAX_SHORT_FLIGHTS`."""
MAX_SHORT_FLIGHTS = 64
"""Maximum number of consecutive short flights; after more, bouncing is finished."""


@dataclass
class ImpactOutcome:
    """Result of impacts: velocity (n, D), and whether the ball stays on the ground (n,)."""

    v: Array
    is_resting: Mask


class GroundContact:
    """Ground contact of all batch elements.

    Attributes:
        floor: (L, 1) value of the last coordinate at which it strikes the ground.
    """

    def __init__(self, lanes: IntegrationBatch) -> None:
        self.floor = lanes.system.floor(lanes.constants)
        self._restitution = lanes.system.restitution(lanes.theta)
        self._friction = lanes.system.friction(lanes.constants)
        self._grip = lanes.system.grip(lanes.constants)
        self._effects = [
            (effect, c) for effect, c in lanes.effects if isinstance(effect, Contact) and c.any()
        ]
        self._shorts = np.zeros(len(lanes.x), dtype=np.intp)

    def resolve_impacts(self, lanes: Indices, v: Array, a: Array) -> ImpactOutcome:
        """Compute the impact of some batch elements.

        Args:
            lanes: (n,) indices of the elements.
            v: (n, D) velocity before the impact, directed downward.
            a: (n, D) acceleration of free motion at the impact.

        Returns:
            Velocities after the impact, and which elements stay on the ground.
        """
        speed = np.abs(v[:, -1:])
        e = self._restitution[lanes]
        mu = np.zeros_like(speed) if self._friction is None else self._friction[lanes]
        for effect, c in self._effects:
            own = c[:, lanes]
            on = (own != 0).any(axis=0)
            # An inactive effect is not applied, so that it changes nothing, not even by rounding.
            changed = effect.restitution(own, e, speed)
            e = np.where(on, changed, e)
            mu = mu + np.where(on, effect.friction(own), 0.0)
        up = e * speed
        down = -a[:, -1:]  # (1)
        rests = self._over(lanes, up, down)
        lost = mu * (1.0 + e) * speed
        if rests.any():
            yields = np.where(e < 1.0, 1.0 - e, 1.0)
            later = mu * (1.0 + e) * up / yields  # (4)
            left = np.where(e < 1.0, later, 0.0)
            lost = np.where(rests, lost + left, lost)
            up = np.where(rests, 0.0, up)
        if mu.any():
            along = _size(v[:, :-1])
            least = 0.0 if self._grip is None else 1.0 - self._grip[lanes]
            share = 1.0 - lost / np.where(along > 0, along, 1.0)
            kept = np.where(mu > 0, np.maximum(share, least), 1.0)  # (2)
            after = np.concatenate([v[:, :-1] * kept, up], axis=1)
            return ImpactOutcome(after, rests[:, 0])
        after = np.concatenate([v[:, :-1], up], axis=1)
        return ImpactOutcome(after, rests[:, 0])

    def _over(self, lanes: Indices, up: Array, down: Array) -> Mask:
        """Return whether bouncing is finished (n, 1), after an impact with rebound speed `up`."""
        flight = 2.0 * up / np.where(down > 0, down, 1.0)  # (3)
        falls = down > 0  # without downward acceleration it never comes back
        is_short = (falls & (flight < SHORT_FLIGHT_SECONDS))[:, 0]
        shorts = np.where(is_short, self._shorts[lanes] + 1, 0)
        self._shorts[lanes] = shorts
        tired = (shorts > MAX_SHORT_FLIGHTS)[:, None]
        over: Mask = falls & ((flight < MIN_FLIGHT_SECONDS) | tired)
        return over


def _size(v: Array) -> Array:
    """Return the length (n, 1) of vectors (n, k)."""
    if v.shape[1] == 1:
        return np.abs(v)
    size: Array = np.sqrt((v * v).sum(axis=1, keepdims=True))
    return size
