"""Where a state cannot go on: the level of a tank at its rim, a joint at its end stop.

With h what is stored and c the rim, x a position with velocity v, k the stiffness, p the place and
a the loss of a stop:

* (1) overflow: h <= c; what would rise beyond the rim is lost
* (2) stop: F = -k d (d / D)^(1/2) (1 + a s v) where that is away from it, else nothing, with s the
  sign of k and d = max(s (x - p), 0) how deep it is in; k > 0 stops what moves up, k < 0 what moves
  down; k is the stiffness at the depth D, 1 cm or 0.01 rad

A rim of zero is none. (2) is the law of Hunt and Crossley on Hertz's contact; what meets it with a
small speed w comes back with (1 - 2 a w / 3) w, however stiff it is.
"""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.system import Coefficient, Force, Level, Moment

_LEVEL = ("m", "m", "m")
"""Units of a level; it may have another."""
_TYPICAL = ((0, 4), (0, 4), (0, 4))
"""Plausible rims, in typical sizes of what is stored."""
_DEEP = 0.01
"""m or rad; the depth at which the stiffness of a stop is stated."""
_STIFF = (None, "N/m", "N*m/rad")
"""Units of a stop's stiffness; what flies freely meets the ground instead."""
_STIFFNESS = ((0, 0), (-5000, 5000), (-20, 20))
"""Plausible ones, in the units of `_STIFF`."""
_PLACE = ((0, 0), (-0.5, 0.5), (-0.5, 0.5))
"""Plausible places of a stop, m or rad; a fit looks for them where the motion has been."""
_LOSS = ((0, 0), (0, 2), (0, 1))
"""Plausible losses of a stop, s/m or s/rad."""
_STOP = (
    Coefficient("stiffness", _STIFF, _STIFFNESS, of="stop"),
    Coefficient("place", (None, "m", "rad"), _PLACE),
    Coefficient("loss", (None, "s/m", "s/rad"), _LOSS),
)
"""What an end stop is made of."""
_CONTACT = "K. H. Hunt, F. R. E. Crossley, J. Appl. Mech. 42(2), 440 (1975), doi:10.1115/1.3423596"


class Overflow(Level):
    """What is stored spills over at c; a rim of zero is none."""

    name = "state.overflow"
    noun = "an overflow"
    says = "a level cannot rise above a rim, what is too much spills over and is lost"
    source = "M. Schoukens, J. P. Noel, IFAC-PapersOnLine 50(1), 446 (2017)"
    coefficients = (Coefficient("coefficient", _LEVEL, _TYPICAL, of="level"),)

    def keep(self, c: Array, level: Array) -> Array:
        """As much as there is room for."""
        return np.where(c[0] > 0, np.minimum(level, c[0]), level)  # (1)


class Limit(Force):
    """An end stop, stiff and lossy: above where the stiffness is positive, else below."""

    name = "state.limit"
    noun = "an end stop"
    says = "it meets a stop, which lets it go no further and takes some of its speed"
    needs, source, sharp = "guide", _CONTACT, True
    coefficients = _STOP

    def force(self, c: Array, moment: Moment) -> Array:
        """Away from it, and never towards it."""
        side = np.sign(c[0])
        depth = np.maximum(side * (moment.primary - c[1]), 0.0)
        losing = np.maximum(1.0 + c[2] * side * moment.v, 0.0)
        return moment.along_primary(-c[0] * depth * np.sqrt(depth / _DEEP) * losing)  # (2)
