"""The forces on many lanes of one coordinate, linear in the velocity about the last look: those of
`sims.engines.joint` with arrays in place of numbers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from sims.base import Array
from sims.engines.external import Lane
from sims.engines.forces import Forces, kicks
from sims.engines.joint_felt import NUDGE, drive_of
from sims.engines.scalar import resistances

Seen = tuple[Array, Array | None, Array, Array]
"""Weight, limit of dry friction, force and its slope in the velocity, (n,) each."""


class Felt(ABC):
    """What a look gave, for n lanes.

    Attributes:
        weight: (n,) the engine's own, where last looked.
        limit: (n,) of dry friction; None where no lane has any.
    """

    def __init__(self, gravity: Callable[[Array], Array], lanes: Sequence[Lane]) -> None:
        self._gravity = gravity
        self._lanes = lanes
        nothing = np.zeros(len(lanes))
        self.weight = self._at = self._force = self._slope = nothing
        self.limit: Array | None = None

    @abstractmethod
    def feel(self, k: int, t: Array, x: Array, v: Array) -> None:
        """Set the inputs of step k; lanes whose inputs differ from the step before look again, at
        this instant.
        """

    @abstractmethod
    def _see(self, t: Array, x: Array, v: Array) -> Seen:
        """Ask for all forces at these instants."""

    def only(self, count: int) -> None:
        """Go on with the first lanes."""
        self._lanes = self._lanes[:count]
        self.weight = self.weight[:count]
        self.limit = None if self.limit is None else self.limit[:count]
        self._at = self._at[:count]
        self._force = self._force[:count]
        self._slope = self._slope[:count]

    def look(self, t: Array, x: Array, v: Array) -> None:
        """Ask for all forces at these instants, (n,) each."""
        self._at = v
        self.weight, self.limit, self._force, self._slope = self._see(t, x, v)

    def _look_again(self, where: Array, t: Array, x: Array, v: Array) -> None:
        """Ask for all forces of some lanes, where `where` (n,) is True."""
        weight, limit, force, slope = self._see(t, x, v)
        self._at = np.where(where, v, self._at)
        self.weight = np.where(where, weight, self.weight)
        self._force = np.where(where, force, self._force)
        self._slope = np.where(where, slope, self._slope)
        if limit is not None and self.limit is not None:
            self.limit = np.where(where, limit, self.limit)

    def force(self, v: Array) -> Array:
        """(n,) gravity and all but friction, at velocities near those looked at."""
        return self._force + self._slope * (v - self._at)

    def end(self, w: Array, half: Array, inertia: Array) -> Array:
        """(n,) velocities half a step, `half`, after `w`; see `joint`."""
        slope = np.minimum(self._slope, 0.0)
        force = self._force + slope * (w - self._at)
        return kicks(w, force, self.limit, 1.0 / (inertia - half * slope), half)


class Asked(Felt):
    """Whatever the system and the effects say, at two velocities for the slope between them."""

    def __init__(self, gravity: Callable[[Array], Array], lanes: Sequence[Lane]) -> None:
        super().__init__(gravity, lanes)
        names = lanes[0].inputs
        size = max((lane.inputs[name].size for lane in lanes for name in names), default=1)
        # (S, lanes), so that the values of a step lie together.
        self._signals = {name: _columns([lane.inputs[name] for lane in lanes]) for name in names}
        changes = np.zeros((size, len(lanes)), dtype=bool)
        for values in self._signals.values():
            changes[1:] |= values[1:] != values[:-1]
        self._changes = changes
        self._turns = _rows_with(changes)
        self._ask = Forces(lanes, 2)

    def only(self, count: int) -> None:
        """See `Felt`."""
        if count < len(self._lanes):
            super().only(count)
            self._ask = Forces(self._lanes, 2)
            self._signals = {name: u[:, :count] for name, u in self._signals.items()}
            self._changes = self._changes[:, :count]
            self._turns = _rows_with(self._changes)
            self._set(self._step)

    def feel(self, k: int, t: Array, x: Array, v: Array) -> None:
        """See `Felt`."""
        self._step = k
        if k in self._turns:
            self._set(k)
            self._look_again(self._changes[k], t, x, v)

    def _set(self, k: int) -> None:
        signals = {name: u[k] for name, u in self._signals.items()}
        self._ask.feel({name: np.tile(u, 2)[:, None] for name, u in signals.items()})

    def _see(self, t: Array, x: Array, v: Array) -> Seen:
        moment = self._ask.moment
        count = t.size
        for half in (slice(count), slice(count, None)):
            moment.t[half, 0] = t
            moment.x[half, 0] = x
            moment.v[half, 0] = v
        # Away from rest, where forces may jump.
        nudge = np.copysign(NUDGE, v)
        moment.v[count:, 0] += nudge
        both = self._ask.force()[:, 0]
        force, nudged = both[:count], both[count:]
        weight = self._gravity(x)
        limit = self._ask.limits() if self._ask.rubs else None
        return weight, limit, weight + force, (nudged - force) / nudge


class Known(Felt):
    """An input that acts as it is, and what opposes motion by laws written out."""

    def __init__(self, gravity: Callable[[Array], Array], lanes: Sequence[Lane]) -> None:
        super().__init__(gravity, lanes)
        self._drive = _columns([drive_of(lane) for lane in lanes])
        self._changes = np.zeros(self._drive.shape, dtype=bool)
        self._changes[1:] = self._drive[1:] != self._drive[:-1]
        self._turns = _rows_with(self._changes)
        self._now = self._drive[0]
        self._opposing = resistances(lanes)
        self.limit = self._opposing.limit

    def only(self, count: int) -> None:
        """See `Felt`."""
        super().only(count)
        self._drive = self._drive[:, :count]
        self._changes = self._changes[:, :count]
        self._turns = _rows_with(self._changes)
        self._now = self._now[:count]
        self._opposing = self._opposing.first(count)

    def feel(self, k: int, t: Array, x: Array, v: Array) -> None:
        """See `Felt`."""
        if k in self._turns:
            self._now = self._drive[k]
            self._look_again(self._changes[k], t, x, v)

    def _see(self, t: Array, x: Array, v: Array) -> Seen:  # noqa: ARG002
        opposed, slope = self._opposing.at(np.abs(v))
        weight = self._gravity(x)
        return weight, self._opposing.limit, weight + self._now - opposed * v, -slope


def _rows_with(where: NDArray[np.bool_]) -> set[int]:
    """The rows of (S, L) in which any value is True."""
    return set(np.flatnonzero(where.any(axis=1)).tolist())


def _columns(rows: Sequence[Array]) -> Array:
    """Rows of several sizes as (S, L), the last value of a shorter one over and over."""
    size = max(row.size for row in rows)
    result = np.empty((size, len(rows)))
    for i, row in enumerate(rows):
        result[: row.size, i] = row
        result[row.size :, i] = row[-1]
    return result
