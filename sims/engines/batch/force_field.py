"""Generalised forces of the batch engine, from the system and the effects on it.

Batch elements are sorted by their active effects. Each effect is evaluated for the span between the
first and the last element on which it is active. Every value of an element depends on that element
alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sims.core.simulator import Array
from sims.core.system import Effect, Force, Friction, IntegrationBatch, StateSnapshot
from sims.engines.ground_contact import Mask


@dataclass
class EffectShare:
    """One effect, on the span of batch elements where it is active.

    Attributes:
        effect: the effect.
        c: (K, n, 1) its coefficients in the span.
        span: span of elements.
        on: (n, 1) elements of the span on which the effect is active; None for all of them.
        moment: state snapshot of the span.
        whole: whether the span includes all elements.
    """

    effect: Effect
    c: Array
    span: slice
    on: Mask | None
    moment: StateSnapshot
    whole: bool

    def view_state(self, t: Array, x: Array, v: Array) -> StateSnapshot:
        """Update the snapshot of the span from the states of all elements.

        Args:
            t: (L, 1) times in seconds.
            x: (L, D) positions.
            v: (L, D) velocities.

        Returns:
            The snapshot of the span.
        """
        moment = self.moment
        span = self.span
        if self.whole:
            moment.t = t
            moment.x = x
            moment.v = v
        else:
            moment.t = t[span]
            moment.x = x[span]
            moment.v = v[span]
        return moment

    def add_to(self, total: Array, values: Array) -> Array:
        """Add the values of the span to a total.

        Args:
            total: (L, D) total of all elements.
            values: (n, D) values of the span.

        Returns:
            The new total (L, D).
        """
        if self.on is not None:
            values = np.where(self.on, values, 0.0)
        if self.whole:
            return total + values
        # A copy, since `total` may be the constant force itself; it keeps the memory order.
        total = np.copy(total, order="K")
        total[self.span] += values
        return total


class ForceField:
    """Generalised forces of a system and its effects on a batch.

    Attributes:
        mass: (L, 1) generalised inertia.
        guided: number of coordinates, counted from the first, on which dry friction acts.
        rubs: (L, 1) elements on which dry friction acts.
        pushed: (L, 1) elements on which other forces act that may be strongly nonlinear.
    """

    def __init__(self, lanes: IntegrationBatch) -> None:
        self._system = lanes.system
        start_time = np.zeros((1, 1))
        self._moment = StateSnapshot(
            lanes.system, lanes.theta, lanes.constants, start_time, lanes.x, lanes.v
        )
        self.mass = lanes.system.mass(lanes.theta, lanes.constants)
        self.guided = lanes.system.guided or lanes.x.shape[1]
        self._none = np.zeros_like(self.mass)
        shares = _shares(lanes)
        # Each part is stored with its effect, so that type checkers know the effect's class.
        self._forces = [(s, s.effect) for s in shares if isinstance(s.effect, Force)]
        self._frictions = [(s, s.effect) for s in shares if isinstance(s.effect, Friction)]
        self.pushed = _where(self._forces, len(lanes.x)) | lanes.system.bends
        self.rubs = _where(self._frictions, len(lanes.x))
        self.set_inputs({name: values[:, :1] for name, values in lanes.inputs.items()})
        # A constant force is evaluated once, not at every step.
        start = self._at(self._moment.t, lanes.x, lanes.v)
        self._constant = _by_coordinate(lanes.system.force(start)) if lanes.system.uniform else None

    @property
    def is_constant_force(self) -> bool:
        """Whether only a constant force acts, the same at all times and states."""
        return self._constant is not None and not self._forces and not self._frictions

    @property
    def has_dry_friction(self) -> bool:
        """Whether dry friction acts on any element."""
        return bool(self._frictions)

    def set_inputs(self, inputs: Mapping[str, Array]) -> None:
        """Set the inputs, (L, 1) by name."""
        self._moment.inputs = inputs
        for share, _ in (*self._forces, *self._frictions):
            share.moment.inputs = {name: values[share.span] for name, values in inputs.items()}

    def compute_force(self, t: Array, x: Array, v: Array) -> Array:
        """Return the generalised force (L, D) without dry friction.

        Args:
            t: (L, 1) times in seconds.
            x: (L, D) positions.
            v: (L, D) velocities.
        """
        total = self._constant
        if total is None:
            total = _by_coordinate(self._system.force(self._at(t, x, v)))
        for share, effect in self._forces:
            force = effect.force(share.c, share.view_state(t, x, v))
            total = share.add_to(total, force)
        return total

    def compute_friction_limit(self, t: Array, x: Array, v: Array) -> Array:
        """Return the limit of dry friction (L, 1).

        Args:
            t: (L, 1) times in seconds.
            x: (L, D) positions.
            v: (L, D) velocities.
        """
        total = self._none
        for share, effect in self._frictions:
            limit = effect.limit(share.c, share.view_state(t, x, v))
            total = share.add_to(total, limit)
        return total

    def _at(self, t: Array, x: Array, v: Array) -> StateSnapshot:
        # One snapshot serves the whole run: making a new one costs as much as a small system's
        # force.
        self._moment.t = t
        self._moment.x = x
        self._moment.v = v
        return self._moment


def is_active(c: Array) -> Mask:
    """Return whether an effect with coefficients (K, L, 1) is active on each element (L,)."""
    result: Mask = (c != 0).any(axis=(0, 2))
    return result


def _by_coordinate(values: Array) -> Array:
    """Return values (L, D) in the memory order of the state, so that operations need no strides."""
    return values if values.shape[1] == 1 else np.asfortranarray(values)


def _where(shares: Sequence[tuple[EffectShare, Effect]], count: int) -> Mask:
    """Return on which elements (L, 1) any of the effects is active."""
    result = np.zeros((count, 1), dtype=bool)
    for share, _ in shares:
        result[share.span] |= True if share.on is None else share.on
    return result


def _shares(lanes: IntegrationBatch) -> list[EffectShare]:
    result = []
    for effect, c in lanes.effects:
        on = is_active(c)
        if not isinstance(effect, (Force, Friction)) or not on.any():
            continue
        # The span is contiguous, because a slice is a view, while a selection would be a copy.
        there = np.flatnonzero(on)
        first = int(there[0])
        last = int(there[-1])
        span = slice(first, last + 1)
        constants = {name: values[span] for name, values in lanes.constants.items()}
        start = np.zeros((1, 1))
        moment = StateSnapshot(
            lanes.system, lanes.theta[span], constants, start, lanes.x[span], lanes.v[span]
        )
        everywhere = bool(on[span].all())
        mask = None if everywhere else on[span, None]
        whole = first == 0 and last == len(on) - 1
        result.append(EffectShare(effect, c[:, span], span, mask, moment, whole))
    return result
