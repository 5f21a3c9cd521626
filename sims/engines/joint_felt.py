"""The forces on one coordinate at an instant, for `sims.engines.joint`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from math import copysign

import numpy as np

from sims.base import Array
from sims.engines.external import Lane
from sims.engines.forces import Forces, kick, rate
from sims.engines.scalar import Resistance

NUDGE = 1e-3
"""Change of velocity (m/s or rad/s) over which the slope of the force is taken."""


class Felt(ABC):
    """The forces on one coordinate, linear in the velocity about the last look.

    Attributes:
        weight: the engine's own, where last looked.
        limit: of dry friction.
    """

    def __init__(self, gravity: Callable[[float], float], inertia: float) -> None:
        self._gravity = gravity
        self._inertia = inertia
        self.weight = self.limit = self._at = self._force = self._slope = 0.0

    @abstractmethod
    def feel(self, i: int) -> bool:
        """Set the inputs of step i; whether any differs from the step before."""

    @abstractmethod
    def look(self, t: float, x: float, v: float) -> None:
        """Ask for all forces at this instant."""

    def force(self, v: float) -> float:
        """Gravity and all but friction, at a velocity near the one looked at."""
        return self._force + self._slope * (v - self._at)

    def end(self, w: float, step: float) -> float:
        """The velocity half a step after `w`, the force being the one at its end; a growing force
        is taken as is.
        """
        # (3) with f linear in v about the last look: its slope goes over to the inertia's side,
        # which a growing force would make smaller, down to nothing.
        slope = min(self._slope, 0.0)
        force = self._force + slope * (w - self._at)
        return kick(w, force, self.limit, 1.0 / (self._inertia - 0.5 * step * slope), 0.5 * step)

    def acceleration(self, v: float) -> float:
        """Of the smooth motion; zero where friction holds."""
        return rate(v, self.force(v), self.limit) / self._inertia


class Asked(Felt):
    """Whatever the system and the effects say, at two velocities for the slope between them."""

    def __init__(self, gravity: Callable[[float], float], lane: Lane, inertia: float) -> None:
        super().__init__(gravity, inertia)
        self._ask = Forces([lane], 2)
        self._signals = {name: values.tolist() for name, values in lane.inputs.items()}

    def feel(self, i: int) -> bool:
        """See `Felt`."""
        # The first step has none before it, not even an equal one.
        changed = i == 0 or any(values[i] != values[i - 1] for values in self._signals.values())
        if changed:
            self._ask.feel({name: values[i] for name, values in self._signals.items()})
        return changed

    def look(self, t: float, x: float, v: float) -> None:
        """See `Felt`."""
        moment = self._ask.moment
        moment.t.fill(t)
        moment.x.fill(x)
        moment.v[0, 0] = v
        # Away from rest, where forces may jump.
        nudge = copysign(NUDGE, v)
        moment.v[1, 0] = v + nudge
        force, nudged = self._ask.force()[:, 0].tolist()
        self.weight = self._gravity(x)
        self.limit = self._ask.limit()
        self._at = v
        self._force = self.weight + force
        self._slope = (nudged - force) / nudge


class Known(Felt):
    """An input that acts as it is, and what opposes motion in plain numbers."""

    def __init__(
        self, gravity: Callable[[float], float], lane: Lane, inertia: float, opposing: Resistance
    ) -> None:
        super().__init__(gravity, inertia)
        self._drive: list[float] = drive_of(lane).tolist()
        self._felt = self._drive[0]
        self._resistance = opposing.at
        self.limit = opposing.limit

    def feel(self, i: int) -> bool:
        """See `Felt`."""
        before = self._felt
        self._felt = self._drive[i]
        return bool(self._felt != before)

    def look(self, t: float, x: float, v: float) -> None:  # noqa: ARG002
        """See `Felt`."""
        opposed, slope = self._resistance(abs(v))
        self.weight = self._gravity(x)
        self._at = v
        self._force = self.weight + self._felt - opposed * v
        self._slope = -slope


def drive_of(lane: Lane) -> Array:
    """(S,) generalised force of the inputs over each step, at least one value."""
    if not lane.inputs:
        return np.zeros(max(lane.steps.size, 1))
    signals = {name: values[:, None] for name, values in lane.inputs.items()}
    size = len(next(iter(signals.values())))
    nothing = np.zeros((size, 1))
    moment = lane.moment(nothing, nothing, nothing, signals)
    drive: Array = lane.system.drive(moment)[:, 0]
    return drive
