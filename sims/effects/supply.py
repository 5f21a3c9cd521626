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
"""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.system import Coefficient, Force, Moment

_SHARE = ((0, 0), (0, 0.2), (0, 2))
"""Plausible shares of the voltage by force, in 1/N and 1/(N m)."""


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
