"""Gravity that is not what the simulator takes it for.

* (1) scale: the weight times 1 + c
* (2) tilt: accelerations x g and y g along the horizontal axes
"""

from __future__ import annotations

from sims.base import Array
from sims.system import Coefficient, Force, Moment

_PURE = ("1", "1", "1")
"""A pure number, on every kind of system."""
_FIFTH = ((-0.2, 0.2), (-0.2, 0.2), (-0.2, 0.2))
"""Plausible changes of gravity, as shares of it: a fifth."""


class Scale(Force):
    """Gravity g (1 + c)."""

    name = "gravity.scale"
    noun = "a correction of gravity"
    says = "gravity acts more strongly or weakly than its stated value"
    source = "J. R. Taylor, Classical Mechanics (2005), section 1.4"
    needs, at = "gravity", "world"
    coefficients = (Coefficient("coefficient", _PURE, _FIFTH),)

    def force(self, c: Array, moment: Moment) -> Array:
        """A share of the weight."""
        return c[0] * moment.weight  # (1): the system's own force has the weight itself


class Tilt(Force):
    """Gravity that leans: accelerations of x g and y g along the horizontal axes."""

    name = "gravity.tilt"
    noun = "a tilt of gravity"
    says = "the ground is not level: gravity also pulls sideways"
    source = "J. R. Taylor, Classical Mechanics (2005), section 1.4"
    needs, at = "push", "world"
    coefficients = (
        Coefficient("x", _PURE, _FIFTH),
        Coefficient("y", ("1", None, None), ((-0.2, 0.2), (0, 0), (0, 0))),
    )

    def force(self, c: Array, moment: Moment) -> Array:
        """Gravity's size, along the horizontal."""
        return moment.gravity * (c[0] * moment.push("x") + c[1] * moment.push("y"))  # (2)
