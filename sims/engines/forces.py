"""The forces on lanes from outside an engine, and what dry friction leaves of them.

Numbers and arrays: an engine that goes lane by lane takes `rate` and `kick`, one that steps many
lanes at once `rates` and `kicks`. They are the same to the bit, and tests hold them to it.

Dry friction of limit L leaves of a force F, at velocity v,

    F - L sign(v)                      where v is not 0                    (1)
    F - L sign(F), or 0 if |F| <= L    where v is 0                        (2)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sims.base import Array
from sims.engines.external import Lane, Places
from sims.system import Effect, Force, Friction, Moment, System


@dataclass(frozen=True)
class _Part:
    """An effect on those of the lanes that it acts on.

    Attributes:
        effect: of the kinds `Force` and `Friction`.
        c: (K, r, 1) its coefficients.
        moment: what it is asked at, r rows.
        rows: (r,) which rows of the whole moment these are; None for all of them.
        felt: what changes from step to step in `moment`.
    """

    effect: Effect
    c: Array
    moment: Moment
    rows: Places | None
    felt: tuple[Array, ...] = ()


class Forces:
    """The forces on lanes from outside the engine: the effects' and the system's own but for
    gravity.

    Args:
        lanes: whose, of one system and the same constants' names.
        looks: how many velocities to ask for at once; rows are those of the first velocity, a lane
            each, then those of the second.
    """

    def __init__(self, lanes: Sequence[Lane], looks: int) -> None:
        first = lanes[0]
        self._count = len(lanes)
        shape = (looks * len(lanes), first.x.size)

        def every(values: Sequence[Array]) -> Array:
            return np.tile(np.concatenate(values), (looks, 1))

        theta = every([lane.theta for lane in lanes])
        known = {name: every([lane.constants[name] for lane in lanes]) for name in first.constants}
        inputs = {
            name: every([lane.inputs[name][:1, None] for lane in lanes]) for name in first.inputs
        }
        nothing = np.zeros(shape)
        t = np.zeros((shape[0], 1))
        self.moment = Moment(first.system, theta, known, t, nothing.copy(), nothing.copy(), inputs)
        self._system: System = first.system
        self._inputs = inputs
        self._felt = _felt(self.moment)
        # Most systems have no passive force but gravity, which the engine applies by itself.
        self._more = type(first.system).passive is not System.passive
        self._driven = bool(inputs) or self._more
        # Every velocity is asked for at once, a row each: a call costs more than its rows.
        parts = [_part(effect, lanes, looks, self.moment) for effect in first.declared]
        acting = [part for part in parts if part is not None]
        self._forces = [part for part in acting if isinstance(part.effect, Force)]
        self._frictions = [part for part in acting if isinstance(part.effect, Friction)]
        self._nothing = nothing
        self.any = bool(self._forces or self._frictions or self._driven)
        self.rubs = bool(self._frictions)

    def feel(self, inputs: Mapping[str, float | Array]) -> None:
        """Set the inputs: numbers, or (looks * lanes, 1)."""
        for name, value in inputs.items():
            self._inputs[name][:] = value

    def force(self) -> Array:
        """(rows, D) generalised force at `moment`, friction apart."""
        total = self._system.drive(self.moment) if self._driven else self._nothing
        if self._more:
            # What the drive works against, less the gravity that is the engine's own.
            total = total - self._system.passive(self.moment) - self._system.weight(self.moment)
        for part in self._forces:
            assert isinstance(part.effect, Force)
            if part.rows is None:
                total = total + part.effect.force(part.c, self.moment)
            else:
                self._gather(part)
                total = total.copy()
                total[part.rows] += part.effect.force(part.c, part.moment)
        return total

    def limit(self) -> float:
        """Largest friction on the first lane."""
        return float(self.limits()[0])

    def limits(self) -> Array:
        """(lanes,) largest friction at the first of the velocities."""
        total = np.zeros(len(self.moment.x))
        for part in self._frictions:
            assert isinstance(part.effect, Friction)
            if part.rows is None:
                total = total + part.effect.limit(part.c, self.moment)[:, 0]
            else:
                self._gather(part)
                total[part.rows] += part.effect.limit(part.c, part.moment)[:, 0]
        return total[: self._count]

    def _gather(self, part: _Part) -> None:
        """Bring the rows of a part up to the whole moment's."""
        assert part.rows is not None
        # Every row is there: `clip` spares looking for one that is not.
        for values, own in zip(self._felt, part.felt, strict=True):
            values.take(part.rows, 0, own, "clip")


def _felt(moment: Moment) -> tuple[Array, ...]:
    """All that changes from step to step."""
    return moment.t, moment.x, moment.v, *moment.inputs.values()


def _part(effect: Effect, lanes: Sequence[Lane], looks: int, whole: Moment) -> _Part | None:
    """An effect on the lanes that have it; None if none has."""
    own = [_coefficients(lane, effect) for lane in lanes]
    on = [i for i, c in enumerate(own) if c is not None]
    if not on:
        return None
    c = np.tile(np.concatenate([c for c in own if c is not None], axis=1), (1, looks, 1))
    if len(on) == len(lanes):
        return _Part(effect, c, whole, None)
    rows = np.concatenate([np.array(on) + k * len(lanes) for k in range(looks)])
    known = {name: value[rows] for name, value in whole.constants.items()}
    inputs = {name: value[rows] for name, value in whole.inputs.items()}
    moment = Moment(
        whole.system, whole.theta[rows], known, whole.t[rows], whole.x[rows], whole.v[rows], inputs
    )
    return _Part(effect, c, moment, rows, _felt(moment))


def _coefficients(lane: Lane, effect: Effect) -> Array | None:
    """(K, 1, 1) of this effect; None if it does not act."""
    return next((c for acting, c in lane.effects if acting is effect), None)


def rate(velocity: float, force: float, limit: float) -> float:
    """The force that is left of `force` when dry friction has taken what it can."""
    if not limit:
        return force
    if velocity:
        return force - math.copysign(limit, velocity)  # (1)
    return force - math.copysign(limit, force) if abs(force) > limit else 0.0  # (2)


def rates(velocity: Array, force: Array, limit: Array) -> Array:
    """`rate` for many lanes (n,)."""
    taken = np.copysign(limit, velocity)  # (1)
    if not np.logical_and.reduce(velocity):
        held = np.where(np.abs(force) > limit, np.copysign(limit, force), force)  # (2)
        taken = np.where(velocity == 0.0, held, taken)
    return np.subtract(force, taken, out=taken)


def kick(velocity: float, force: float, limit: float, inverse: float, duration: float) -> float:
    """The velocity after a constant force and dry friction have acted for `duration`.

    Exact: friction opposes the motion until it stops, then holds it still if it can.

    Args:
        velocity: before.
        force: without friction.
        limit: largest friction.
        inverse: one over the inertia.
        duration: seconds.
    """
    if velocity and limit:
        slope = rate(velocity, force, limit) * inverse
        after = velocity + slope * duration
        if after * velocity >= 0:
            return after
        # It came to rest on the way, -v / slope after the beginning; the time left begins there.
        duration += velocity / slope
        velocity = 0.0
    return velocity + rate(velocity, force, limit) * inverse * duration


def kicks(
    velocity: Array, force: Array, limit: Array | None, inverse: Array, duration: Array
) -> Array:
    """`kick` for many lanes (n,); `limit` is None where no lane has friction."""
    if limit is None:
        free: Array = velocity + force * inverse * duration
        return free
    slope = rates(velocity, force, limit)
    slope *= inverse
    after = slope * duration
    after += velocity
    onward = after * velocity
    # Most often no lane turns; a lane that has failed says nothing about the others.
    if np.fmin.reduce(onward) < 0.0:
        turns = (onward < 0.0) & (limit != 0.0)
        left = duration[turns] + velocity[turns] / slope[turns]
        still = rates(np.zeros(left.size), force[turns], limit[turns])
        after[turns] = 0.0 + still * inverse[turns] * left
    return after
