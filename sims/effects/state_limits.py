"""Limits of a state: overflow of a tank at its rim, and end stop of a joint.

With h the stored level and c the rim, x a position with velocity v, k the stiffness, p the place
and a the loss of a stop:

* (1) overflow: h <= c; the excess over the rim is lost
* (2) stop: F = -k d (d / D)^(1/2) (1 + a s v) if this pushes away from the stop, else zero, with s
  the sign of k and d = max(s (x - p), 0) the penetration; k > 0 limits upward motion, k < 0
  downward motion; k is the stiffness at the depth D, 1 cm or 0.01 rad

A rim of zero is no rim. (2) is the law of Hunt and Crossley with Hertz's contact; the rebound speed
after contact at a small speed w is (1 - 2 a w / 3) w for any stiffness.
"""

from __future__ import annotations

import numpy as np

from sims.core.effect import Coefficient, Force, Level
from sims.core.simulator import Array
from sims.core.system import StateSnapshot

_LEVEL_UNITS = ("m", "m", "m")
"""Units of a level; a level may have another unit."""
_RIM_RANGES = ((0, 4), (0, 4), (0, 4))
"""Plausible rims, relative to the typical size of the level."""
_REFERENCE_PENETRATION = 0.01
"""Penetration in m or rad at which the stiffness of a stop is specified."""
_STIFFNESS_UNITS = (None, "N/m", "N*m/rad")
"""Units of a stop's stiffness; a body in free flight meets the ground instead."""
_STIFFNESS_RANGES = ((0, 0), (-5000, 5000), (-20, 20))
"""Plausible stiffnesses of a stop, in the units of `_STIFFNESS_UNITS`."""
_STOP_POSITION_RANGES = ((0, 0), (-0.5, 0.5), (-0.5, 0.5))
"""Plausible places of a stop in m or rad; a fit searches the range of the recorded motion."""
_LOSS_RANGES = ((0, 0), (0, 2), (0, 1))
"""Plausible losses of a stop in s/m or s/rad."""
_STOP_COEFFICIENTS = (
    Coefficient("stiffness", _STIFFNESS_UNITS, _STIFFNESS_RANGES, of="stop"),
    Coefficient("place", (None, "m", "rad"), _STOP_POSITION_RANGES),
    Coefficient("loss", (None, "s/m", "s/rad"), _LOSS_RANGES),
)
"""Coefficients of an end stop."""
_CONTACT = "K. H. Hunt, F. R. E. Crossley, J. Appl. Mech. 42(2), 440 (1975), doi:10.1115/1.3423596"


class LevelOverflow(Level):
    """Overflow of a level at c; a rim of zero is no rim."""

    name = "state.overflow"
    noun = "an overflow"
    says = "a level cannot rise above a rim; the excess overflows and is lost"
    source = "M. Schoukens, J. P. Noel, IFAC-PapersOnLine 50(1), 446 (2017)"
    coefficients = (Coefficient("coefficient", _LEVEL_UNITS, _RIM_RANGES, of="level"),)

    def keep(self, c: Array, level: Array) -> Array:
        """Return the level (L, 1), limited by the rim.

        Args:
            c: (K, L, 1) coefficients.
            level: (L, 1) level before the overflow.
        """
        return np.where(c[0] > 0, np.minimum(level, c[0]), level)  # (1)


class EndStop(Force):
    """End stop with stiffness and loss: an upper stop for positive stiffness, else a lower one."""

    name = "state.limit"
    noun = "an end stop"
    says = "it hits an end stop, which limits its position and absorbs some of its speed"
    needs, source, sharp = "guide", _CONTACT, True
    coefficients = _STOP_COEFFICIENTS

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), which pushes away from the stop and never towards it.

        Args:
            c: (K, L, 1) coefficients.
            moment: state snapshot of L batch elements.
        """
        side = np.sign(c[0])
        depth = np.maximum(side * (moment.primary - c[1]), 0.0)
        damping_factor = np.maximum(1.0 + c[2] * side * moment.v, 0.0)
        return moment.along_primary(
            -c[0] * depth * np.sqrt(depth / _REFERENCE_PENETRATION) * damping_factor
        )  # (2)
