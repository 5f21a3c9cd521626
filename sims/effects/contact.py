"""What happens at an impact with the ground."""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.system import Coefficient, Contact

_SMALLEST = 1e-9  # m/s: keeps the power of an impact at no speed finite


class Speed(Contact):
    """Restitution that depends on the impact speed: e0 |vn|^c, vn in m/s; at most 1, so that no
    energy is made.

    Yielding bodies have c near -1/4, viscoelastic ones a weaker dependence.
    """

    name = "restitution.speed"
    says = "how well it bounces depends on the speed of the impact"
    source = "K. L. Johnson, Contact Mechanics (1985), chapter 11, doi:10.1017/CBO9781139171731"
    needs = "ground"
    coefficients = (
        Coefficient("coefficient", ("1", "1", None), ((-0.4, 0.2), (-0.4, 0.2), (0, 0))),
    )

    def restitution(self, c: Array, restitution: Array, speed: Array) -> Array:
        """As much as it would be at 1 m/s, times a power of the speed."""
        scaled = restitution * np.maximum(speed, _SMALLEST) ** c[0]
        return np.minimum(scaled, np.maximum(restitution, 1.0))


class Friction(Contact):
    """Friction in the impact: tangential speed lost is c (1 + e) |vn|, never more than there is."""

    name = "contact.friction"
    says = "the ground slows it along its surface at each impact"
    source = "R. M. Brach, Mechanical Impact Dynamics: Rigid Body Collisions (1991)"
    needs = "ground"
    coefficients = (Coefficient("coefficient", ("1", None, None), ((0, 1), (0, 0), (0, 0))),)

    def friction(self, c: Array) -> Array:
        """The coefficient of friction; a negative one is none."""
        return np.maximum(c[0], 0.0)
