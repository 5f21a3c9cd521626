"""Contact effects: changes of the impact with the ground, and of contacts of a robot.

With e0 the simulator's restitution, vn the normal speed before the impact and c the coefficient:

* (1) e = e0 |vn|^c, vn in m/s
* (2) tangential speed lost: c (1 + e) |vn|, Coulomb's law for the impulse, never more than there is

With the parameters of a contact of two geoms in a robot's model file:

* (3) sliding friction coefficient plus c
* (4) time constant of `solref` times 1 + c; without the mass of the bodies, a contact is a spring
  and a damper with stiffness 1 / (t^2 z^2) and damping 2 / t per unit mass, with the time constant
  t and the damping ratio z
* (5) damping ratio of `solref` times 1 + c
"""

from __future__ import annotations

import numpy as np

from sims.core.effect import Coefficient, Contact, ModelValueEffect
from sims.core.simulator import Array

_MIN_IMPACT_SPEED = 1e-9
"""Minimum impact speed in m/s for the power law, so that a negative power is finite."""
_POWER_RANGES = ((-0.4, 0.2), (-0.4, 0.2), (0, 0))
"""Plausible powers of the impact speed: yielding bodies have about -1/4, viscoelastic ones less."""
_DIMENSIONLESS = ("1", "1", "1")
_RELATIVE_ERROR_RANGES = ((-0.8, 4.0), (-0.8, 4.0), (-0.8, 4.0))
"""Plausible relative errors of the solver parameters of a contact."""


class SpeedDependentRestitution(Contact):
    """Restitution that depends on the impact speed; at most 1, so that no energy is created."""

    name = "restitution.speed"
    noun = "speed-dependent restitution"
    says = "the restitution depends on the speed of the impact"
    source = "K. L. Johnson, Contact Mechanics (1985), chapter 11, doi:10.1017/CBO9781139171731"
    needs = "ground"
    coefficients = (Coefficient("coefficient", ("1", "1", None), _POWER_RANGES),)

    def restitution(self, c: Array, restitution: Array, speed: Array) -> Array:
        """Return the restitution (L, 1): its value at 1 m/s, times a power of the speed.

        Args:
            c: (K, L, 1) coefficients.
            restitution: (L, 1) restitution without the effect.
            speed: (L, 1) impact speed in m/s.
        """
        scaled = restitution * np.maximum(speed, _MIN_IMPACT_SPEED) ** c[0]  # (1)
        # a restitution above 1 without the effect stays: c = 0 is off
        return np.minimum(scaled, np.maximum(restitution, 1.0))


class ContactFriction(Contact):
    """Friction in the impact: tangential speed lost is c (1 + e) |vn|, never more than there is.

    At a contact of two geoms of a robot it is (3).
    """

    name = "contact.friction"
    noun = "friction at impacts"
    says = "at each impact, friction reduces the speed along the surface"
    noun_at_place = "a wrong friction"
    says_at_place = "the friction coefficient of the contact is not that of the model file"
    source = "R. M. Brach, Mechanical Impact Dynamics: Rigid Body Collisions (1991)"
    needs = "ground"
    at = "contact"
    coefficients = (Coefficient("coefficient", ("1", None, None), ((0, 1), (0, 0), (0, 0))),)

    def friction(self, c: Array) -> Array:
        """Return the friction coefficient (L, 1); a negative one counts as zero."""
        # the engine applies (2), because only the engine knows the tangential speed
        return np.maximum(c[0], 0.0)


class ContactSoftness(ModelValueEffect):
    """Time constant of a contact times 1 + c (4): a harder contact has a negative c."""

    name = "contact.softness"
    noun = "a wrong softness"
    says = "the contact yields or bounces in another way than the model file states"
    source = "MuJoCo documentation, Modeling, solver parameters"
    at = "contact"
    coefficients = (
        Coefficient("coefficient", _DIMENSIONLESS, _RELATIVE_ERROR_RANGES, least=-0.99),
    )


class ContactDamping(ContactSoftness):
    """Damping ratio of a contact times 1 + c (5): a contact that bounces less has a positive c."""

    name = "contact.damping"
    noun = "a wrong damping"
