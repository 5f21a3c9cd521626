"""Lift: force perpendicular to the direction of flight.

(1) F = s x v with s = c (0, -1, 0) + vertical (0, 0, 1), x the vector product.
"""

from __future__ import annotations

import numpy as np

from sims.core.effect import Coefficient, Force
from sims.core.simulator import Array
from sims.core.system import StateSnapshot

_SPINNING = "G. Robinson, I. Robinson, Physica Scripta 88, 018101 (2013), "
_SPINNING += "doi:10.1088/0031-8949/88/01/018101"
_LIFT_UNITS = ("1/s", None, None)
"""Units of the lift coefficient; it exists only for bodies in free flight."""
_LIFT_RANGES = ((-1, 1), (0, 0), (0, 0))
"""Plausible lift in 1/s; spin has two directions."""


class MagnusLift(Force):
    """Lift of a spinning ball: c times spin axis x velocity, about -y (backspin lifts) and z."""

    name = "lift.magnus"
    noun = "Magnus lift"
    says = "spin causes a force perpendicular to the direction of flight"
    needs, source = "space", _SPINNING
    coefficients = (
        Coefficient("coefficient", _LIFT_UNITS, _LIFT_RANGES),
        Coefficient("vertical", _LIFT_UNITS, _LIFT_RANGES),
    )

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), perpendicular to the velocity, so that it does no work.

        Args:
            c: (K, L, 1) coefficients.
            moment: state snapshot of L batch elements.
        """
        (level, upright), (vx, vy, vz) = c[:, :, 0], moment.v.T
        return np.stack([-level * vz - upright * vy, upright * vx, level * vx], axis=1)  # (1)
