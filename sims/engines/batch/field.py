"""Forces of the batch engine: what accelerates every lane at one instant.

Lanes come sorted by the effects that act in them, so that each effect is asked for the span of
lanes between the first and the last one it acts in. Whatever is computed for a lane is computed
from that lane alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sims.base import Array
from sims.engines.ground import Mask
from sims.system import Effect, Force, Friction, Lanes, Moment


@dataclass
class Share:
    """One effect, in the span of lanes where it acts.

    Attributes:
        effect: the effect.
        c: (K, n, 1) its coefficients in the span.
        span: the lanes.
        on: (n, 1) the lanes of the span in which it acts; None if it acts in all of them.
        moment: what it sees.
        whole: whether the span is all lanes.
    """

    effect: Effect
    c: Array
    span: slice
    on: Mask | None
    moment: Moment
    whole: bool

    def look(self, t: Array, x: Array, v: Array) -> Moment:
        """The span's part of an instant of all lanes."""
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

    def added(self, total: Array, values: Array) -> Array:
        """`total` of all lanes plus the span's values (n, D)."""
        if self.on is not None:
            values = np.where(self.on, values, 0.0)
        if self.whole:
            return total + values
        # A copy, since `total` may be the constant force itself; in its own order of storage.
        total = np.copy(total, order="K")
        total[self.span] += values
        return total


class Field:
    """Generalised forces of a system and the effects on it, over lanes.

    Attributes:
        mass: (L, 1) generalised inertia.
        guided: how many coordinates, the first ones, dry friction acts on.
        rubs: (L, 1) in which lanes dry friction acts.
        pushed: (L, 1) in which lanes other forces act that may bend sharply.
    """

    def __init__(self, lanes: Lanes) -> None:
        self._system = lanes.system
        start_time = np.zeros((1, 1))
        self._moment = Moment(
            lanes.system, lanes.theta, lanes.constants, start_time, lanes.x, lanes.v
        )
        self.mass = lanes.system.mass(lanes.theta, lanes.constants)
        self.guided = lanes.system.guided or lanes.x.shape[1]
        self._none = np.zeros_like(self.mass)
        shares = _shares(lanes)
        # With the effect beside its share: so much is known of which hook it has.
        self._forces = [(s, s.effect) for s in shares if isinstance(s.effect, Force)]
        self._frictions = [(s, s.effect) for s in shares if isinstance(s.effect, Friction)]
        self.pushed = _where(self._forces, len(lanes.x)) | lanes.system.bends
        self.rubs = _where(self._frictions, len(lanes.x))
        self.feel({name: values[:, :1] for name, values in lanes.inputs.items()})
        # What is the same everywhere and always is asked for once and not at every instant.
        start = self._at(self._moment.t, lanes.x, lanes.v)
        self._constant = _by_coordinate(lanes.system.force(start)) if lanes.system.uniform else None

    @property
    def free(self) -> bool:
        """Whether nothing acts but a force that is the same everywhere and always."""
        return self._constant is not None and not self._forces and not self._frictions

    @property
    def dry(self) -> bool:
        """Whether any dry friction acts."""
        return bool(self._frictions)

    def feel(self, inputs: Mapping[str, Array]) -> None:
        """Set the inputs, (L, 1) by name."""
        self._moment.inputs = inputs
        for share, _ in (*self._forces, *self._frictions):
            share.moment.inputs = {name: values[share.span] for name, values in inputs.items()}

    def force(self, t: Array, x: Array, v: Array) -> Array:
        """(L, D) generalised force but for dry friction."""
        total = self._constant
        if total is None:
            total = _by_coordinate(self._system.force(self._at(t, x, v)))
        for share, effect in self._forces:
            force = effect.force(share.c, share.look(t, x, v))
            total = share.added(total, force)
        return total

    def limit(self, t: Array, x: Array, v: Array) -> Array:
        """(L, 1) largest dry friction."""
        total = self._none
        for share, effect in self._frictions:
            limit = effect.limit(share.c, share.look(t, x, v))
            total = share.added(total, limit)
        return total

    def _at(self, t: Array, x: Array, v: Array) -> Moment:
        # One moment for the whole run: making one anew costs as much as a small system's force.
        self._moment.t = t
        self._moment.x = x
        self._moment.v = v
        return self._moment


def acts(c: Array) -> Mask:
    """(L,) in which lanes an effect with coefficients (K, L, 1) is not off."""
    result: Mask = (c != 0).any(axis=(0, 2))
    return result


def _by_coordinate(values: Array) -> Array:
    """The same values (L, D) stored as the state is, so that they combine without strides."""
    return values if values.shape[1] == 1 else np.asfortranarray(values)


def _where(shares: Sequence[tuple[Share, Effect]], count: int) -> Mask:
    """(L, 1) the lanes in which any of the effects acts."""
    result = np.zeros((count, 1), dtype=bool)
    for share, _ in shares:
        result[share.span] |= True if share.on is None else share.on
    return result


def _shares(lanes: Lanes) -> list[Share]:
    result = []
    for effect, c in lanes.effects:
        on = acts(c)
        if not isinstance(effect, (Force, Friction)) or not on.any():
            continue
        # From the first lane to the last: a slice is a view, a choice of lanes would be a copy.
        there = np.flatnonzero(on)
        first = int(there[0])
        last = int(there[-1])
        span = slice(first, last + 1)
        constants = {name: values[span] for name, values in lanes.constants.items()}
        start = np.zeros((1, 1))
        moment = Moment(
            lanes.system, lanes.theta[span], constants, start, lanes.x[span], lanes.v[span]
        )
        everywhere = bool(on[span].all())
        mask = None if everywhere else on[span, None]
        whole = first == 0 and last == len(on) - 1
        result.append(Share(effect, c[:, span], span, mask, moment, whole))
    return result
