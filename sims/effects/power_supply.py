"""Power-supply effects: reduction of a drive's force by its supply.

With U the force that the drive would exert and V the voltage of its supply: the drive exerts a
force proportional to V, and draws a current proportional to its actual force F; the internal
resistance of the supply reduces V in proportion to the current:

* F = U (1 - c |F|), so that F = U / (1 + c |U|), and U c |U| / (1 + c |U|) is lost        (1)

c is the fraction of the voltage lost per unit of force; 1 / c is a force that is never reached. A
negative coefficient counts as zero. If several drives share the supply, all their forces count:

* F_i = U_i (1 - c S), S = |F_1| + |F_2| + ..., so that S = D / (1 + c D), D = |U_1| + |U_2| + ...,
  and U_i c D / (1 + c D) is lost                                                        (2)

The current is that of a drive at standstill: the back electromotive force is not included.

A drive that brakes takes energy out of the motion, and needs a sink for it. A bridge that does not
reverse, a supply that cannot absorb energy, or a limit of the braking current reduces a force
against the motion to a fraction. With v the velocity and c the fraction that is lost:

* F = U where U v >= 0, and (1 - c) U where U v < 0                                       (3)

At c = 1 the drive accelerates and never brakes; c is limited to the range from 0 to 1.
"""

from __future__ import annotations

import numpy as np

from sims.core.effect import Coefficient, Force
from sims.core.simulator import Array
from sims.core.system import StateSnapshot

_VOLTAGE_LOSS_RANGES = ((0, 0), (0, 0.2), (0, 2))
"""Plausible voltage losses per unit of force, in 1/N and 1/(N m)."""
_LOST_FRACTION_RANGES = ((0, 0), (0, 1), (0, 1))
"""Plausible lost fractions of a braking force."""


class SupplySag(Force):
    """Reduction of the drive's force by the voltage drop of the supply."""

    name = "supply.sag"
    noun = "a supply voltage drop"
    says = "the supply voltage drops with the current, which reduces large forces"
    source = "R. Krishnan, Electric Motor Drives (2001), chapter 2: a source with resistance"
    at = "actuator"
    needs = "input"
    coefficients = (Coefficient("coefficient", (None, "1/N", "1/(N*m)"), _VOLTAGE_LOSS_RANGES),)

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), opposite to the drive.

        Args:
            c: (K, L, 1) coefficients.
            moment: state snapshot of L batch elements.
        """
        drive, _ = moment.sides
        relative_drop = np.maximum(c[0], 0.0) * moment.drawn
        return moment.along_primary(-drive * relative_drop / (1.0 + relative_drop))  # (1), (2)


class SupplyBrakingLoss(Force):
    """Reduction of the drive's force where it acts against the motion."""

    name = "supply.braking"
    noun = "a drive with weak braking"
    says = "the drive exerts less than its commanded force when it brakes the motion"
    source = "R. Krishnan, Electric Motor Drives (2001), chapter 4: choppers of one quadrant"
    at = "actuator"
    needs = "input"
    coefficients = (Coefficient("coefficient", (None, "1", "1"), _LOST_FRACTION_RANGES),)

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), in the direction of motion.

        Args:
            c: (K, L, 1) coefficients.
            moment: state snapshot of L batch elements.
        """
        drive, _ = moment.sides
        braking_force = np.where(drive * moment.primary_rate < 0.0, drive, 0.0)
        return moment.along_primary(-np.clip(c[0], 0.0, 1.0) * braking_force)  # (3)
