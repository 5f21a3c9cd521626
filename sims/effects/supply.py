"""What a drive's supply does to its force.

With U the force that the drive would exert and V the voltage of its supply: the drive makes U in
proportion to V, and draws a current in proportion to the force F that it makes; the supply's own
resistance takes that much of V away:

* F = U (1 - c |F|), so that F = U / (1 + c |U|), and U c |U| / (1 + c |U|) is lost        (1)

c is the share of the voltage that a unit of force costs; 1 / c is a force that is never reached. A
negative share is none. Where several drives share the supply all of their forces count:

* F_i = U_i (1 - c S), S = |F_1| + |F_2| + ..., so that S = D / (1 + c D), D = |U_1| + |U_2| + ...,
  and U_i c D / (1 + c D) is lost                                                        (2)

The current is that of a drive at standstill: what its own motion induces is not in it.

A drive that brakes takes energy out of the motion, and needs somewhere to put it: a bridge that
does not reverse, a supply that takes nothing back or a limit of the braking current leaves of a
force against the motion a share only. With v the velocity and c the share that is lost:

* F = U where U v >= 0, and (1 - c) U where U v < 0                                       (3)

At c = 1 the drive speeds up and never slows down; less than none and more than all there is not.
"""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.system import Coefficient, Force, Moment

_SHARE = ((0, 0), (0, 0.2), (0, 2))
"""Plausible shares of the voltage by force, in 1/N and 1/(N m)."""
_LOST = ((0, 0), (0, 1), (0, 1))
"""Plausible shares of a braking force that are lost."""


class Sag(Force):
    """The drive falls short of its force by what current takes of the supply's voltage."""

    name = "supply.sag"
    noun = "a supply that sags"
    says = "the supply's voltage falls with what the drive draws, so that large forces fall short"
    source = "R. Krishnan, Electric Motor Drives (2001), chapter 2: a source with resistance"
    at = "actuator"
    needs = "input"
    coefficients = (Coefficient("coefficient", (None, "1/N", "1/(N*m)"), _SHARE),)

    def force(self, c: Array, moment: Moment) -> Array:
        """Against the drive."""
        drive, _ = moment.sides
        lost = np.maximum(c[0], 0.0) * moment.drawn
        return moment.along_primary(-drive * lost / (1.0 + lost))  # (1), (2)


class Braking(Force):
    """The drive falls short of its force where that is against the motion."""

    name = "supply.braking"
    noun = "a drive that hardly brakes"
    says = "the drive falls short of its force where it acts against the motion"
    source = "R. Krishnan, Electric Motor Drives (2001), chapter 4: choppers of one quadrant"
    at = "actuator"
    needs = "input"
    coefficients = (Coefficient("coefficient", (None, "1", "1"), _LOST),)

    def force(self, c: Array, moment: Moment) -> Array:
        """Along the motion."""
        drive, _ = moment.sides
        against = np.where(drive * moment.primary_rate < 0.0, drive, 0.0)
        return moment.along_primary(-np.clip(c[0], 0.0, 1.0) * against)  # (3)
