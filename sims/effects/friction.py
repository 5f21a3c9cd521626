"""Dry friction: opposes motion, and holds still at rest what pulls less than its limit.

Each law gives its limit; the engine adds the limits up and applies one force, so that sticking
sticks. With v the velocity, limits are

* (1) Coulomb: c
* (2) Stribeck: coulomb + extra exp(-(v / speed)^2)
* (3) load: c |drive - load|, each counted as it pushes the joint

A negative limit is none. And one that is no limit but a force, since it vanishes at rest:

* (4) direction: -viscous+ v where v > 0, -viscous- v where v < 0

Dry friction that differs by direction needs no law of its own: with limits d+ and d- it is, at rest
as in motion, Coulomb friction of (d+ + d-) / 2 and a constant force of -(d+ - d-) / 2.
"""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.system import Coefficient, Force, Friction, Moment

_SURVEY = (
    "B. Armstrong-Helouvry et al., Automatica 30(7), 1083 (1994), doi:10.1016/0005-1098(94)90209-7"
)
_SMALLEST = 1e-9
"""m/s or rad/s; the Stribeck speed that stands for zero, so that 0 / 0 never comes up."""
_USUAL = ("m/s^2", "N", "N*m")
"""Units of a force on the three kinds of system."""
_VISCOUS = (None, "N*s/m", "N*m*s/rad")
"""Units of a viscous friction, where motion has two ways."""
_DAMPED = ((0, 0), (0, 5), (0, 0.05))
"""Plausible ones, in the units of `_VISCOUS`."""


class Coulomb(Friction):
    """Friction that does not depend on speed: c sign(v)."""

    name = "friction.coulomb"
    noun = "Coulomb friction"
    says = "a constant friction opposes motion, and holds still what pulls less"
    source = _SURVEY
    needs = "guide"
    coefficients = (Coefficient("coefficient", _USUAL, ((0, 5), (0, 5), (0, 0.5))),)

    def limit(self, c: Array, moment: Moment) -> Array:  # noqa: ARG002
        """The coefficient."""
        return np.maximum(c[0], 0.0)  # (1)


class Stribeck(Friction):
    """Friction that falls as motion picks up: coulomb + extra exp(-(v / speed)^2)."""

    name = "friction.stribeck"
    noun = "Stribeck friction"
    says = "friction is greatest at rest and falls as motion picks up"
    needs, contains, source = "guide", ("friction.coulomb",), _SURVEY
    coefficients = (
        Coefficient("coulomb", _USUAL, ((0, 5), (0, 5), (0, 0.5))),
        Coefficient("extra", _USUAL, ((0, 5), (0, 5), (0, 0.5))),
        Coefficient("speed", ("m/s", "m/s", "rad/s"), ((0.005, 0.5), (0.005, 0.5), (0.02, 2))),
    )

    def limit(self, c: Array, moment: Moment) -> Array:
        """`coulomb` in fast motion, `coulomb` + `extra` at rest."""
        return np.maximum(c[0] + c[1] * _falling(moment.speed, c[2]), 0.0)  # (2)


class Load(Friction):
    """Friction of a loaded transmission: c times the drive from one side plus the load from the
    other.
    """

    name = "friction.load"
    noun = "load-dependent friction"
    says = "friction grows with the load that the drive carries"
    source = "M. Duclusaud et al. (2024), arXiv:2410.08650, model M3"
    needs = "input"
    coefficients = (Coefficient("coefficient", (None, "1", "1"), ((0, 0), (0, 0.5), (0, 0.5))),)

    def limit(self, c: Array, moment: Moment) -> Array:
        """In proportion to the load."""
        return np.maximum(c[0], 0.0) * moment.load  # (3)


class Direction(Force):
    """Viscous friction that differs by the way of the motion."""

    name = "friction.direction"
    noun = "friction that differs by direction"
    says = "motion is resisted more one way than the other"
    source = "A. Janot, M. Gautier, M. Brunot, Nonlinear System Identification Benchmarks (2019)"
    needs, contains = "guide", ("drag.linear",)
    coefficients = tuple(Coefficient(f"viscous{way}", _VISCOUS, _DAMPED) for way in "+-")

    def force(self, c: Array, moment: Moment) -> Array:
        """In proportion to speed, by that of the way in which it moves."""
        ahead, back = np.maximum(moment.v, 0.0), np.minimum(moment.v, 0.0)
        return -c[0] * ahead - c[1] * back  # (4)


def _falling(speed: Array, scale: Array) -> Array:
    """(L, 1) share of the extra friction of (2) that is left at a speed."""
    ratio = speed / np.maximum(scale, _SMALLEST)
    left: Array = np.exp(-np.square(ratio))
    return left
