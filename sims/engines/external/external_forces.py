"""Forces of system and effects that are applied from outside an engine, and dry friction.

Functions exist for numbers and for arrays: an engine that integrates one batch element at a time
uses `subtract_dry_friction` and `integrate_velocity`, one that steps many elements together uses
`subtract_dry_friction_batch` and `integrate_velocity_batch`. Both give
the same results bit for bit, which tests check.

Dry friction with limit L changes a force F at velocity v to

    F - L sign(v)                      where v is not 0                    (1)
    F - L sign(F), or 0 if |F| <= L    where v is 0                        (2)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sims.core.simulator import Array
from sims.core.system import Effect, Force, Friction, StateSnapshot, System
from sims.engines.external.external_engine import ElementWork, Indices


@dataclass(frozen=True)
class _Part:
    """Effect on the batch elements where it is active.

    Attributes:
        effect: effect of class `Force` or `Friction`.
        c: (K, r, 1) its coefficients.
        moment: state snapshot of its r rows.
        rows: (r,) indices of these rows in the whole snapshot; None for all.
        felt: arrays of `moment` that change from step to step.
    """

    effect: Effect
    c: Array
    moment: StateSnapshot
    rows: Indices | None
    felt: tuple[Array, ...] = ()


class ExternalForces:
    """Forces on batch elements that the engine does not apply itself: all except gravity.

    They are the forces of the effects and of the system.

    Args:
        lanes: batch elements of one system with the same names of constants.
        looks: number of velocities evaluated in one call. The rows of the snapshot are those of the
            first velocity, one per element, then those of the second.
    """

    def __init__(self, lanes: Sequence[ElementWork], looks: int) -> None:
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
        self.moment = StateSnapshot(
            first.system, theta, known, t, nothing.copy(), nothing.copy(), inputs
        )
        self._system: System = first.system
        self._inputs = inputs
        self._felt = _felt(self.moment)
        # Most systems have no passive force except gravity, which the engine applies itself.
        self._more = type(first.system).passive is not System.passive
        self._driven = bool(inputs) or self._more
        # All velocities are evaluated in one call, one row each: a call costs more than its rows.
        parts = [_part(effect, lanes, looks, self.moment) for effect in first.declared]
        acting = [part for part in parts if part is not None]
        self._forces = [part for part in acting if isinstance(part.effect, Force)]
        self._frictions = [part for part in acting if isinstance(part.effect, Friction)]
        self._nothing = nothing
        self.any = bool(self._forces or self._frictions or self._driven)
        self.rubs = bool(self._frictions)

    def set_inputs(self, inputs: Mapping[str, float | Array]) -> None:
        """Set the inputs: numbers, or arrays (looks * lanes, 1)."""
        for name, value in inputs.items():
            self._inputs[name][:] = value

    def compute_force(self) -> Array:
        """Return the generalised force (rows, D) at `moment`, without dry friction."""
        total = self._system.drive(self.moment) if self._driven else self._nothing
        if self._more:
            # Passive forces of the system, without the gravity that the engine applies.
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

    def compute_friction_limit(self) -> float:
        """Return the friction limit of the first batch element."""
        return float(self.compute_friction_limits()[0])

    def compute_friction_limits(self) -> Array:
        """Return the friction limits (lanes,) at the first of the velocities."""
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
        """Copy the rows of an effect from the whole state snapshot."""
        assert part.rows is not None
        # All indices are valid: `clip` skips the bounds check.
        for values, own in zip(self._felt, part.felt, strict=True):
            values.take(part.rows, 0, own, "clip")


def _felt(moment: StateSnapshot) -> tuple[Array, ...]:
    """Return the arrays of a snapshot that change from step to step."""
    return moment.t, moment.x, moment.v, *moment.inputs.values()


def _part(
    effect: Effect, lanes: Sequence[ElementWork], looks: int, whole: StateSnapshot
) -> _Part | None:
    """Return an effect on the elements where it is active; None if it is active nowhere."""
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
    moment = StateSnapshot(
        whole.system, whole.theta[rows], known, whole.t[rows], whole.x[rows], whole.v[rows], inputs
    )
    return _Part(effect, c, moment, rows, _felt(moment))


def _coefficients(lane: ElementWork, effect: Effect) -> Array | None:
    """Return the coefficients (K, 1, 1) of this effect; None if it is not active."""
    return next((c for acting, c in lane.effects if acting is effect), None)


def subtract_dry_friction(velocity: float, force: float, limit: float) -> float:
    """Return a force minus dry friction, equations (1) and (2).

    Args:
        velocity: velocity of the body.
        force: force without dry friction.
        limit: limit of dry friction.
    """
    if not limit:
        return force
    if velocity:
        return force - math.copysign(limit, velocity)  # (1)
    return force - math.copysign(limit, force) if abs(force) > limit else 0.0  # (2)


def subtract_dry_friction_batch(velocity: Array, force: Array, limit: Array) -> Array:
    """Return forces minus dry friction: `subtract_dry_friction` for many batch elements (n,).

    Args:
        velocity: (n,) velocities.
        force: (n,) forces without dry friction.
        limit: (n,) limits of dry friction.
    """
    taken = np.copysign(limit, velocity)  # (1)
    if not np.logical_and.reduce(velocity):
        held = np.where(np.abs(force) > limit, np.copysign(limit, force), force)  # (2)
        taken = np.where(velocity == 0.0, held, taken)
    return np.subtract(force, taken, out=taken)


def integrate_velocity(
    velocity: float, force: float, limit: float, inverse: float, duration: float
) -> float:
    """Return the velocity after a constant force and dry friction have acted for `duration`.

    The result is exact: friction opposes the motion until the body stops, and then holds it if the
    force is within the limit.

    Args:
        velocity: velocity before.
        force: force without dry friction.
        limit: limit of dry friction.
        inverse: inverse of the inertia.
        duration: time in seconds.
    """
    if velocity and limit:
        slope = subtract_dry_friction(velocity, force, limit) * inverse
        after = velocity + slope * duration
        if after * velocity >= 0:
            return after
        # The body stops at time -v / slope; the remaining time begins there.
        duration += velocity / slope
        velocity = 0.0
    return velocity + subtract_dry_friction(velocity, force, limit) * inverse * duration


def integrate_velocity_batch(
    velocity: Array, force: Array, limit: Array | None, inverse: Array, duration: Array
) -> Array:
    """Return velocities after constant forces: `integrate_velocity` for many batch elements (n,).

    Args:
        velocity: (n,) velocities before.
        force: (n,) forces without dry friction.
        limit: (n,) limits of dry friction; None where no element has friction.
        inverse: (n,) inverse inertias.
        duration: (n,) times in seconds.
    """
    if limit is None:
        free: Array = velocity + force * inverse * duration
        return free
    slope = subtract_dry_friction_batch(velocity, force, limit)
    slope *= inverse
    after = slope * duration
    after += velocity
    onward = after * velocity
    # In most steps no element reverses. `fmin` ignores the NaN of failed elements.
    if np.fmin.reduce(onward) < 0.0:
        turns = (onward < 0.0) & (limit != 0.0)
        left = duration[turns] + velocity[turns] / slope[turns]
        still = subtract_dry_friction_batch(np.zeros(left.size), force[turns], limit[turns])
        after[turns] = 0.0 + still * inverse[turns] * left
    return after
