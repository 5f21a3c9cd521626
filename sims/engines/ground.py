"""Impacts with level ground: what becomes of the velocity, and when bouncing has died out.

The last coordinate strikes the ground at its `floor`; the others run along it. Restitution is the
system's, changed by the contact effects in their order. The ground takes tangential speed mu (1 +
e) |vn|, never more than there is (R. M. Brach, J. Appl. Mech. 56(1), 133, 1989,
doi:10.1115/1.3176033), or less where the system says at which share of it a body that spins up
grips. A ball that rests on the ground has no impacts and is not slowed by it.

Bounces of a ball with e < 1 die out in finite time after infinitely many. They are taken as over
once a flight would last less than `SHORTEST`, or after `PATIENCE` flights below `SHORT` in a row;
what the bounces left out would have taken from the tangential speed is taken at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sims.base import Array
from sims.system import Contact, Lanes

Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

SHORTEST = 5e-5  # seconds: a flight of that length rises 3 nm
SHORT, PATIENCE = 2e-3, 64  # seconds and flights


@dataclass
class Outcome:
    """What follows an impact: velocity (n, D) and whether the ball stays on the ground (n,)."""

    v: Array
    rests: Mask


class Ground:
    """The ground under every lane.

    Attributes:
        floor: (L, 1) value of the last coordinate where it is struck.
    """

    def __init__(self, lanes: Lanes) -> None:
        self.floor = lanes.system.floor(lanes.constants)
        self._restitution = lanes.system.restitution(lanes.theta)
        self._friction = lanes.system.friction(lanes.constants)
        self._grip = lanes.system.grip(lanes.constants)
        self._effects = [
            (effect, c) for effect, c in lanes.effects if isinstance(effect, Contact) and c.any()
        ]
        self._shorts = np.zeros(len(lanes.x), dtype=np.intp)

    def strike(self, lanes: Indices, v: Array, a: Array) -> Outcome:
        """The impact of some lanes.

        Args:
            lanes: (n,) which.
            v: (n, D) velocity before, downward.
            a: (n, D) acceleration of free motion there.
        """
        speed = np.abs(v[:, -1:])
        e = self._restitution[lanes]
        mu = np.zeros_like(speed) if self._friction is None else self._friction[lanes]
        for effect, c in self._effects:
            own = c[:, lanes]
            on = (own != 0).any(axis=0)
            e = np.where(on, effect.restitution(own, e, speed), e)
            mu = mu + np.where(on, effect.friction(own), 0.0)
        up, down = e * speed, -a[:, -1:]
        rests = self._over(lanes, up, down)
        lost = mu * (1.0 + e) * speed
        if rests.any():
            left = np.where(e < 1.0, mu * (1.0 + e) * up / np.where(e < 1.0, 1.0 - e, 1.0), 0.0)
            lost = np.where(rests, lost + left, lost)
            up = np.where(rests, 0.0, up)
        if mu.any():
            along = _size(v[:, :-1])
            least = 0.0 if self._grip is None else 1.0 - self._grip[lanes]
            kept = np.where(
                mu > 0, np.maximum(1.0 - lost / np.where(along > 0, along, 1.0), least), 1.0
            )
            return Outcome(np.concatenate([v[:, :-1] * kept, up], axis=1), rests[:, 0])
        return Outcome(np.concatenate([v[:, :-1], up], axis=1), rests[:, 0])

    def _over(self, lanes: Indices, up: Array, down: Array) -> Mask:
        """(n, 1) whether bouncing is over, after an impact that would be left with speed `up`."""
        flight = 2.0 * up / np.where(down > 0, down, 1.0)
        falls = down > 0
        short = np.where((falls & (flight < SHORT))[:, 0], self._shorts[lanes] + 1, 0)
        self._shorts[lanes] = short
        over: Mask = falls & ((flight < SHORTEST) | (short > PATIENCE)[:, None])
        return over


def _size(v: Array) -> Array:
    """(n, 1) length of vectors (n, k)."""
    if v.shape[1] == 1:
        return np.abs(v)
    size: Array = np.sqrt((v * v).sum(axis=1, keepdims=True))
    return size
