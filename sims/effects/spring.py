"""Spring effects: forces on the primary coordinate x, towards its zero.

* (1) linear: F = -c x
* (2) cubic: F = -c x^3
"""

from __future__ import annotations

from sims.core.effect import Coefficient, Force
from sims.core.simulator import Array
from sims.core.system import StateSnapshot

_DUFFING = (
    "I. Kovacic, M. J. Brennan (eds.), The Duffing Equation (2011), doi:10.1002/9780470977859"
)
_CUBIC_STIFFNESS_UNITS = ("1/(m^2*s^2)", "N/m^3", "N*m/rad^3")
"""Units of a force per cube of position."""
_CUBIC_STIFFNESS_RANGES = ((-5, 5), (-50, 50), (-0.5, 0.5))
"""Plausible cubic terms, in the units of `_CUBIC_STIFFNESS_UNITS`: springs harden or soften."""


class LinearSpring(Force):
    """Linear spring (Hooke's law): -c x."""

    name = "spring.linear"
    noun = "a linear spring"
    says = "a spring pulls back in proportion to the distance from zero"
    source = "J. R. Taylor, Classical Mechanics (2005), section 5.1"
    needs = "guide"
    coefficients = (
        Coefficient("coefficient", ("1/s^2", "N/m", "N*m/rad"), ((0, 10), (0, 50), (0, 1))),
    )

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), towards zero.

        Args:
            c: (K, L, 1) coefficients.
            moment: state snapshot of L batch elements.
        """
        return moment.along_primary(-c[0] * moment.primary)  # (1)


class CubicSpring(Force):
    """Cubic term of a spring that hardens (or softens, c < 0): -c x^3."""

    name = "spring.cubic"
    noun = "a cubic spring"
    says = "a spring pulls back in proportion to the cube of the distance from zero"
    source = _DUFFING
    needs = "guide"
    coefficients = (Coefficient("coefficient", _CUBIC_STIFFNESS_UNITS, _CUBIC_STIFFNESS_RANGES),)

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), towards zero for c > 0.

        Args:
            c: (K, L, 1) coefficients.
            moment: state snapshot of L batch elements.
        """
        x = moment.primary
        return moment.along_primary(-c[0] * x * x * x)  # (2); a power would be slower
