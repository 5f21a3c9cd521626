"""The commonest effects in plain numbers, for engines that go lane by lane and step by step.

Asking an effect for its force takes NumPy some microseconds, as long as the engine's own step. For
the laws below, and only as the library has them, it is worth writing them once more; tests compare
both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sims.base import Array
from sims.engines.external import Lane
from sims.system import Contact, Effect

Law = Callable[[Any, Any], tuple[Any, Any]]
"""Coefficient and speed (numbers, or arrays alike) -> resistance r in force = -r v, and by how much
r times speed grows with speed.
"""

_LAWS: Mapping[str, Law] = {
    "drag.linear": lambda c, speed: (c, c),  # noqa: ARG005 - the same at every speed
    "drag.quadratic": lambda c, speed: (c * speed, 2.0 * c * speed),
}


@dataclass(frozen=True)
class Resistance:
    """What opposes the motion and depends on nothing but speed.

    Attributes:
        laws: those that act, with their coefficients.
        limit: of dry friction.
    """

    laws: tuple[tuple[Law, float], ...]
    limit: float

    def at(self, speed: float) -> tuple[float, float]:
        """The sum of all laws at this speed; see `Law`."""
        resistance = slope = 0.0
        for law, c in self.laws:
            more, steeper = law(c, speed)
            resistance += more
            slope += steeper
        return resistance, slope


@dataclass(frozen=True)
class Resistances:
    """`Resistance` of many lanes.

    Attributes:
        laws: those that act on any lane, with their coefficients (n,).
        limit: (n,) of dry friction; None where no lane has any.
    """

    laws: tuple[tuple[Law, Array], ...]
    limit: Array | None

    def at(self, speed: Array) -> tuple[Array, Array]:
        """The sums of all laws at these speeds (n,); see `Law`."""
        if not self.laws:
            return np.zeros(speed.size), np.zeros(speed.size)
        (law, c), *others = self.laws
        resistance, slope = law(c, speed)
        for law, c in others:
            more, steeper = law(c, speed)
            resistance = resistance + more
            slope = slope + steeper
        return resistance, slope

    def first(self, count: int) -> Resistances:
        """Of the first lanes."""
        laws = tuple((law, c[:count]) for law, c in self.laws)
        return Resistances(laws, None if self.limit is None else self.limit[:count])


def resistances(lanes: Sequence[Lane]) -> Resistances:
    """All effects of lanes for each of which `resistance` is not None."""
    found = [resistance(lane) for lane in lanes]
    limits = np.array([one.limit if one else 0.0 for one in found])
    laws = []
    for effect in lanes[0].declared:
        law = _LAWS.get(effect.name)
        if law is not None:
            own = [dict(one.laws).get(law, 0.0) if one else 0.0 for one in found]
            if any(own):
                laws.append((law, np.array(own)))
    return Resistances(tuple(laws), limits if limits.any() else None)


def resistance(lane: Lane) -> Resistance | None:
    """All effects of the lane but those on contact; None if some are not of this kind."""
    laws: list[tuple[Law, float]] = []
    limit = 0.0
    for effect, c in lane.effects:
        number = float(c[0, 0, 0])
        if isinstance(effect, Contact):
            continue  # it acts at impacts alone, where it is asked by itself
        if is_library(effect, "friction.coulomb"):
            limit += max(number, 0.0)  # as in the effect: friction is never negative
        elif effect.name in _LAWS and is_library(effect, effect.name):
            laws.append((_LAWS[effect.name], number))
        else:
            return None  # where one must be asked, all are asked together
    return Resistance(tuple(laws), limit)


def is_library(effect: Effect, name: str) -> bool:
    """Whether this is the library's own effect of this name."""
    # A plugin may take over a name with a law of its own, which must be asked for.
    return effect.name == name and type(effect).__module__.startswith("sims.effects.")
