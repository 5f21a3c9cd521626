"""Gravity effects: errors of size and direction, and weights that are carried.

* (1) scale: the weight times 1 + c
* (2) tilt: accelerations x g and y g along the horizontal axes
* (3) compensation: a force of -c times the weight of a body at its centre of mass (MuJoCo's
  ``gravcomp``), such as a counterweight, a spring, or a controller that carries it
"""

from __future__ import annotations

from sims.core.effect import Coefficient, Force, ModelValueEffect
from sims.core.simulator import Array
from sims.core.system import StateSnapshot

_DIMENSIONLESS = ("1", "1", "1")
"""Units of a dimensionless coefficient on every kind of system."""
_SCALE_RANGES = ((-0.2, 0.2), (-0.2, 0.2), (-0.2, 0.2))
"""Plausible relative changes of gravity: up to a fifth."""


class GravityScale(Force):
    """Gravity g (1 + c)."""

    name = "gravity.scale"
    noun = "a correction of gravity"
    says = "gravity is stronger or weaker than the stated value"
    source = "J. R. Taylor, Classical Mechanics (2005), section 1.4"
    needs, at = "gravity", "world"
    coefficients = (Coefficient("coefficient", _DIMENSIONLESS, _SCALE_RANGES),)

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), a fraction of the weight.

        Args:
            c: (K, L, 1) coefficients.
            moment: state snapshot of L batch elements.
        """
        return c[0] * moment.weight  # (1): the system's own force already contains the weight


class GravityTilt(Force):
    """Tilted gravity: accelerations of x g and y g along the horizontal axes."""

    name = "gravity.tilt"
    noun = "a tilt of gravity"
    says = "the ground is not level: gravity has a horizontal component"
    source = "J. R. Taylor, Classical Mechanics (2005), section 1.4"
    needs, at = "push", "world"
    coefficients = (
        Coefficient("x", _DIMENSIONLESS, _SCALE_RANGES),
        Coefficient("y", ("1", None, None), ((-0.2, 0.2), (0, 0), (0, 0))),
    )

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D) of gravity along the horizontal axes.

        Args:
            c: (K, L, 1) coefficients.
            moment: state snapshot of L batch elements.
        """
        return moment.gravity * (c[0] * moment.push("x") + c[1] * moment.push("y"))  # (2)


class GravityCompensation(ModelValueEffect):
    """Share c of the weight of a body that is carried, in addition to the file's ``gravcomp``."""

    name = "gravity.compensation"
    noun = "gravity compensation"
    says = "part of the body's weight is compensated, such as by a counterweight or the controller"
    source = "V. Arakelian, Gravity compensation in robotics, Advanced Robotics 30(2), 79 (2016)"
    at = "body"
    coefficients = (Coefficient("coefficient", _DIMENSIONLESS, ((0, 1), (0, 1), (0, 1))),)  # (3)
