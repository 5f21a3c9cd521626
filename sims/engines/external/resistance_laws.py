"""Closed-form laws of the most common effects, for engines that step one element at a time.

Evaluating an effect's force with NumPy takes some microseconds, as long as the engine's own step.
Therefore the laws below are implemented a second time in plain numbers; they are used only for the
effects of the library itself. Tests compare both implementations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sims.core.simulator import Array
from sims.core.system import Contact, Effect
from sims.engines.external.external_engine import ElementWork

ResistanceLaw = Callable[[Any, Any], tuple[Any, Any]]
"""Law of a resistance as a function of coefficient and speed (numbers or equal-shaped arrays).

It returns the resistance r in force = -r v, and the derivative of r times speed with respect to
speed.
"""

_LAWS: Mapping[str, ResistanceLaw] = {
    "drag.linear": lambda c, speed: (c, c),  # noqa: ARG005 - the same at every speed
    "drag.quadratic": lambda c, speed: (c * speed, 2.0 * c * speed),
}


@dataclass(frozen=True)
class Resistance:
    """Forces that oppose the motion and depend on the speed alone.

    Attributes:
        laws: active laws with their coefficients.
        limit: limit of dry friction.
    """

    laws: tuple[tuple[ResistanceLaw, float], ...]
    limit: float

    def compute(self, speed: float) -> tuple[float, float]:
        """Return the sums of resistance and slope over all laws at this speed.

        See `ResistanceLaw`.
        """
        resistance = slope = 0.0
        for law, c in self.laws:
            more, steeper = law(c, speed)
            resistance += more
            slope += steeper
        return resistance, slope


@dataclass(frozen=True)
class ResistanceBatch:
    """`Resistance` of many batch elements.

    Attributes:
        laws: laws active on at least one element, with coefficients (n,).
        limit: (n,) limits of dry friction; None where no element has any.
    """

    laws: tuple[tuple[ResistanceLaw, Array], ...]
    limit: Array | None

    def compute(self, speed: Array) -> tuple[Array, Array]:
        """Return the sums (n,) of resistance and slope over all laws at speeds (n,).

        See `ResistanceLaw`.
        """
        if not self.laws:
            return np.zeros(speed.size), np.zeros(speed.size)
        (law, c), *others = self.laws
        resistance, slope = law(c, speed)
        for law, c in others:
            more, steeper = law(c, speed)
            resistance = resistance + more
            slope = slope + steeper
        return resistance, slope

    def truncate(self, count: int) -> ResistanceBatch:
        """Return the laws of the first `count` elements."""
        laws = tuple((law, c[:count]) for law, c in self.laws)
        return ResistanceBatch(laws, None if self.limit is None else self.limit[:count])


def make_resistance_batch(lanes: Sequence[ElementWork]) -> ResistanceBatch:
    """Return the laws of batch elements; `make_resistance` must not return None for any of them."""
    found = [make_resistance(lane) for lane in lanes]
    limits = np.array([one.limit if one else 0.0 for one in found])
    laws = []
    for effect in lanes[0].declared:
        law = _LAWS.get(effect.name)
        if law is not None:
            own = [dict(one.laws).get(law, 0.0) if one else 0.0 for one in found]
            if any(own):
                laws.append((law, np.array(own)))
    return ResistanceBatch(tuple(laws), limits if limits.any() else None)


def make_resistance(lane: ElementWork) -> Resistance | None:
    """Return the closed-form laws of all effects of an element, except contact effects.

    Returns:
        The laws; None if an effect has no closed-form law here.
    """
    laws: list[tuple[ResistanceLaw, float]] = []
    limit = 0.0
    for effect, c in lane.effects:
        number = float(c[0, 0, 0])
        if isinstance(effect, Contact):
            continue  # it acts only at impacts, where it is evaluated separately
        if is_builtin_effect(effect, "friction.coulomb"):
            limit += max(number, 0.0)  # as in the effect: friction is never negative
        elif effect.name in _LAWS and is_builtin_effect(effect, effect.name):
            laws.append((_LAWS[effect.name], number))
        else:
            return None  # one effect without a closed form: all are evaluated as effects
    return Resistance(tuple(laws), limit)


def is_builtin_effect(effect: Effect, name: str) -> bool:
    """Return whether an effect is the library's own effect of this name."""
    # A plugin may replace an effect of this name with another law, which must be evaluated.
    return effect.name == name and type(effect).__module__.startswith("sims.effects.")
