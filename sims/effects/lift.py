"""Lift: force across the direction of flight."""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.system import Coefficient, Force, Moment


class Magnus(Force):
    """Lift of a spinning ball: c times spin axis x velocity, about -y (backspin lifts) and z."""

    name = "lift.magnus"
    says = "spin makes it swerve, across its direction of flight"
    source = "G. Robinson, I. Robinson, Physica Scripta 88, 018101 (2013), doi:10.1088/0031-8949/88/01/018101"
    needs = "space"
    coefficients = (
        Coefficient("coefficient", ("1/s", None, None), ((-1, 1), (0, 0), (0, 0))),
        Coefficient("vertical", ("1/s", None, None), ((-1, 1), (0, 0), (0, 0))),
    )

    def force(self, c: Array, moment: Moment) -> Array:
        """Across the velocity, so that it does no work."""
        (level, upright), (vx, vy, vz) = c[:, :, 0], moment.v.T
        return np.stack([-level * vz - upright * vy, upright * vx, level * vx], axis=1)
