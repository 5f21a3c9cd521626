"""Gravity that is not what the simulator takes it for."""

from __future__ import annotations

from sims.base import Array
from sims.system import Coefficient, Force, Moment


class Scale(Force):
    """Gravity g (1 + c)."""

    name = "gravity.scale"
    says = "gravity acts more strongly or weakly than its stated value"
    source = "J. R. Taylor, Classical Mechanics (2005), section 1.4"
    needs = "gravity"
    coefficients = (
        Coefficient("coefficient", ("1", "1", "1"), ((-0.2, 0.2), (-0.2, 0.2), (-0.2, 0.2))),
    )

    def force(self, c: Array, moment: Moment) -> Array:
        """A share of the weight."""
        return c[0] * moment.weight


class Tilt(Force):
    """Gravity that leans: accelerations of x g and y g along the horizontal axes."""

    name = "gravity.tilt"
    says = "the ground is not level: gravity also pulls sideways"
    source = "J. R. Taylor, Classical Mechanics (2005), section 1.4"
    needs = "push"
    coefficients = (
        Coefficient("x", ("1", "1", "1"), ((-0.2, 0.2), (-0.2, 0.2), (-0.2, 0.2))),
        Coefficient("y", ("1", None, None), ((-0.2, 0.2), (0, 0), (0, 0))),
    )

    def force(self, c: Array, moment: Moment) -> Array:
        """Gravity's size, along the horizontal."""
        return moment.gravity * (c[0] * moment.push("x") + c[1] * moment.push("y"))
