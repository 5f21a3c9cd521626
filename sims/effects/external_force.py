"""External forces: constant, periodic, of springs, and of gravity.

The primary coordinate of a ball is its height.

With x the primary coordinate and t the time since the start of the run:

* (1) bias: F = c
* (2) ripple: F = a sin(2 pi x / period) + b cos(2 pi x / period)
* (3) periodic: F = a sin(2 pi frequency t) + b cos(2 pi frequency t)

Periodic forces have sine and cosine coefficients instead of amplitude and phase: the motion is
linear in both while they are small, and no phase is undetermined where the amplitude is zero.

* (1) linear: F = -c x
* (2) cubic: F = -c x^3

* (1) scale: the weight times 1 + c
* (2) tilt: accelerations x g and y g along the horizontal axes
* (3) compensation: a force of -c times the weight of a body at its centre of mass (MuJoCo's
  ``gravcomp``), such as a counterweight, a spring, or a controller that carries it
"""

from __future__ import annotations

import numpy as np

from sims.core.effect import Coefficient, Force, ModelValueEffect
from sims.core.simulator import Array
from sims.core.system import StateSnapshot

_MIN_PERIOD = 1e-9
"""Smallest period in m or rad, which replaces zero to avoid division by zero."""
_FORCE_UNITS = ("m/s^2", "N", "N*m")
"""Units of a force on the three kinds of system."""
_COGGING = (
    "T. M. Jahns, W. L. Soong, IEEE Trans. Ind. Electron. 43(2), 321 (1996), doi:10.1109/41.491356"
)
_RIPPLE_RANGES = ((-2, 2), (-2, 2), (-0.2, 0.2))
"""Plausible amplitudes of ripple, in the units of a force."""
_PERIOD_RANGES = ((0.01, 1), (0.01, 1), (0.05, 3.1416))
"""Plausible periods in m or rad.

The longest is half a turn, because a force with the period of one turn is equivalent to gravity.
"""


class ForceBias(Force):
    """Constant force c."""

    name = "force.bias"
    noun = "a constant force"
    says = "a constant force acts in one direction"
    source = "J. R. Taylor, Classical Mechanics (2005), section 1.4"
    coefficients = (Coefficient("coefficient", _FORCE_UNITS, ((-2, 2), (-5, 5), (-0.5, 0.5))),)

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), equal to the coefficient along the primary coordinate.

        Args:
            c: (1, L, 1) force.
            moment: state snapshot of L batch elements.
        """
        return moment.along_primary(c[0])  # (1)


class ForceRipple(Force):
    """Force that is periodic in position, as a motor's cogging."""

    name = "force.ripple"
    noun = "a force periodic in position"
    says = "a force varies periodically with position, such as motor cogging"
    needs, source = "guide", _COGGING
    coefficients = (
        Coefficient("sine", _FORCE_UNITS, _RIPPLE_RANGES),
        Coefficient("cosine", _FORCE_UNITS, _RIPPLE_RANGES),
        Coefficient("period", ("m", "m", "rad"), _PERIOD_RANGES),
    )

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), periodic in the primary coordinate.

        F = a sin(2 pi x / period) + b cos(2 pi x / period) (2), with the primary coordinate x.

        Args:
            c: (3, L, 1) coefficients: a, b and the period in m or rad.
            moment: state snapshot of L batch elements with D coordinates; `along_primary` turns a
                force (L, 1) on the primary coordinate into one (L, D) on all.
        """
        cycles = moment.primary / np.maximum(c[2], _MIN_PERIOD)
        return moment.along_primary(_compute_wave(c, cycles))  # (2)


class PeriodicForce(Force):
    """Force that is periodic in the time since the start of the run."""

    name = "force.periodic"
    noun = "a force periodic in time"
    says = "a force varies periodically with time, such as from a vibration"
    source = "L. D. Landau, E. M. Lifshitz, Mechanics (1976), section 22"
    coefficients = (
        Coefficient("sine", _FORCE_UNITS, ((-2, 2), (-5, 5), (-0.5, 0.5))),
        Coefficient("cosine", _FORCE_UNITS, ((-2, 2), (-5, 5), (-0.5, 0.5))),
        Coefficient("frequency", ("Hz", "Hz", "Hz"), ((0.1, 10), (0.1, 10), (0.1, 10))),
    )

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D) along the primary coordinate, periodic in the time t of the run.

        F = a sin(2 pi frequency t) + b cos(2 pi frequency t) (3).

        Args:
            c: (3, L, 1) coefficients: a, b and the frequency in Hz.
            moment: state snapshot of L batch elements with D coordinates; `along_primary` turns a
                force (L, 1) on the primary coordinate into one (L, D) on all.
        """
        return moment.along_primary(_compute_wave(c, moment.t * c[2]))  # (3)


def _compute_wave(c: Array, cycles: Array) -> Array:
    """Return c[0] sin + c[1] cos (L, 1) at a phase given in cycles."""
    angle = 2 * np.pi * cycles
    wave: Array = c[0] * np.sin(angle) + c[1] * np.cos(angle)
    return wave


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
        """Return the force (L, D) along the primary coordinate x, towards zero: F = -c x (1).

        Args:
            c: (1, L, 1) stiffness c.
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

        Shapes: D coordinates.

        F = -c x^3 (2), with the primary coordinate x.

        Args:
            c: (1, L, 1) cubic stiffness c.
            moment: state snapshot of L batch elements; `along_primary` turns a force (L, 1) on the
                primary coordinate into one (L, D) on all.
        """
        x = moment.primary
        return moment.along_primary(-c[0] * x * x * x)  # (2); a power would be slower


_DIMENSIONLESS = ("1", "1", "1")
"""Units of a dimensionless coefficient on every kind of system."""
_SCALE_RANGES = ((-0.2, 0.2), (-0.2, 0.2), (-0.2, 0.2))
"""Plausible relative changes of gravity: up to a fifth."""


class GravityScale(Force):
    """Gravity g (1 + c)."""

    name = "gravity.scale"
    noun = "a correction of gravity"
    says = "gravity is stronger or weaker than the stated value"
    source = "J. R. Taylor, Classical Mechanics (2005), section 1.4"
    needs, at = "gravity", "world"
    coefficients = (Coefficient("coefficient", _DIMENSIONLESS, _SCALE_RANGES),)

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), a fraction of the weight.

        Args:
            c: (1, L, 1) relative change of gravity.
            moment: state snapshot of L batch elements.
        """
        return c[0] * moment.weight  # (1): the system's own force already contains the weight


class GravityTilt(Force):
    """Tilted gravity: accelerations of x g and y g along the horizontal axes."""

    name = "gravity.tilt"
    noun = "a tilt of gravity"
    says = "the ground is not level: gravity has a horizontal component"
    source = "J. R. Taylor, Classical Mechanics (2005), section 1.4"
    needs, at = "push", "world"
    coefficients = (
        Coefficient("x", _DIMENSIONLESS, _SCALE_RANGES),
        Coefficient("y", ("1", None, None), ((-0.2, 0.2), (0, 0), (0, 0))),
    )

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D) of gravity along the horizontal axes, on tilted ground.

        Args:
            c: (2, L, 1) horizontal gravity along x and along y, as shares of g.
            moment: state snapshot of L batch elements.
        """
        return moment.gravity * (c[0] * moment.push("x") + c[1] * moment.push("y"))  # (2)


class GravityCompensation(ModelValueEffect):
    """Share c of the weight of a body that is carried, in addition to the file's ``gravcomp``."""

    name = "gravity.compensation"
    noun = "gravity compensation"
    says = "part of the body's weight is compensated, such as by a counterweight or the controller"
    source = "V. Arakelian, Gravity compensation in robotics, Advanced Robotics 30(2), 79 (2016)"
    at = "body"
    coefficients = (Coefficient("coefficient", _DIMENSIONLESS, ((0, 1), (0, 1), (0, 1))),)  # (3)
