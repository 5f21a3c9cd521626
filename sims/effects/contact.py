"""What happens at an impact with the ground.

With e0 the simulator's restitution, vn the normal speed before the impact and c the coefficient:

* (1) e = e0 |vn|^c, vn in m/s
* (2) tangential speed lost: c (1 + e) |vn|, Coulomb's law for the impulse, never more than there is
"""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.system import Coefficient, Contact

_SMALLEST = 1e-9
"""m/s; a slower impact counts as one of this speed, so that a negative power of it is finite."""
_POWER = ((-0.4, 0.2), (-0.4, 0.2), (0, 0))
"""Plausible powers of the impact speed: yielding bodies have about -1/4, viscoelastic ones less."""


class Speed(Contact):
    """Restitution that depends on the impact speed; at most 1, so that no energy is made."""

    name = "restitution.speed"
    noun = "speed-dependent restitution"
    says = "how well it bounces depends on the speed of the impact"
    source = "K. L. Johnson, Contact Mechanics (1985), chapter 11, doi:10.1017/CBO9781139171731"
    needs = "ground"
    coefficients = (Coefficient("coefficient", ("1", "1", None), _POWER),)

    def restitution(self, c: Array, restitution: Array, speed: Array) -> Array:
        """As much as it would be at 1 m/s, times a power of the speed."""
        scaled = restitution * np.maximum(speed, _SMALLEST) ** c[0]  # (1)
        # a restitution that was above 1 without it stays: c = 0 is off
        return np.minimum(scaled, np.maximum(restitution, 1.0))


class Friction(Contact):
    """Friction in the impact: tangential speed lost is c (1 + e) |vn|, never more than there is."""

    name = "contact.friction"
    noun = "friction at impacts"
    says = "the ground slows it along its surface at each impact"
    source = "R. M. Brach, Mechanical Impact Dynamics: Rigid Body Collisions (1991)"
    needs = "ground"
    coefficients = (Coefficient("coefficient", ("1", None, None), ((0, 1), (0, 0), (0, 0))),)

    def friction(self, c: Array) -> Array:
        """The coefficient of friction; a negative one is none."""
        # the engine applies (2): it alone knows the tangential speed there is
        return np.maximum(c[0], 0.0)
