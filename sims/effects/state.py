"""What a system stores, such as the level of a tank, where it cannot go on growing.

With h what is stored and c the coefficient:

* (1) overflow: h <= c; what would rise beyond the rim is lost

A rim of zero is none.
"""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.system import Coefficient, Level

_LEVEL = ("m", "m", "m")
"""Units of a level; it may have another."""
_TYPICAL = ((0, 4), (0, 4), (0, 4))
"""Plausible rims, in typical sizes of what is stored."""


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
