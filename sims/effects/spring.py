"""Springs: forces of the primary coordinate, towards its zero."""

from __future__ import annotations

from sims.base import Array
from sims.system import Coefficient, Force, Moment


class Linear(Force):
    """A spring that keeps Hooke's law: -c x."""

    name = "spring.linear"
    says = "a spring pulls back in proportion to the distance from zero"
    source = "J. R. Taylor, Classical Mechanics (2005), section 5.1"
    needs = "guide"
    coefficients = (
        Coefficient("coefficient", ("1/s^2", "N/m", "N*m/rad"), ((0, 10), (0, 50), (0, 1))),
    )

    def force(self, c: Array, moment: Moment) -> Array:
        """Towards zero."""
        return moment.along_primary(-c[0] * moment.primary)


class Cubic(Force):
    """The cubic term of a spring that hardens (or softens, c < 0): -c x^3."""

    name = "spring.cubic"
    says = "a spring pulls back in proportion to the cube of the distance from zero"
    source = (
        "I. Kovacic, M. J. Brennan (eds.), The Duffing Equation (2011), doi:10.1002/9780470977859"
    )
    needs = "guide"
    coefficients = (
        Coefficient(
            "coefficient", ("1/(m^2*s^2)", "N/m^3", "N*m/rad^3"), ((-5, 5), (-50, 50), (-0.5, 0.5))
        ),
    )

    def force(self, c: Array, moment: Moment) -> Array:
        """Towards zero where c > 0."""
        return moment.along_primary(-c[0] * moment.primary * moment.primary * moment.primary)
