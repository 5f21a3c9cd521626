"""External forces along the primary coordinate: constant, periodic in position or in time.

The primary coordinate of a ball is its height.

With x the primary coordinate and t the time since the start of the run:

* (1) bias: F = c
* (2) ripple: F = a sin(2 pi x / period) + b cos(2 pi x / period)
* (3) periodic: F = a sin(2 pi frequency t) + b cos(2 pi frequency t)

Periodic forces have sine and cosine coefficients instead of amplitude and phase: the motion is
linear in both while they are small, and no phase is undetermined where the amplitude is zero.
"""

from __future__ import annotations

import numpy as np

from sims.core.effect import Coefficient, Force
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
            c: (K, L, 1) coefficients.
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

        Args:
            c: (K, L, 1) coefficients.
            moment: state snapshot of L batch elements.
        """
        return moment.along_primary(
            _compute_wave(c, moment.primary / np.maximum(c[2], _MIN_PERIOD))
        )  # (2)


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
        """Return the force (L, D), periodic in time.

        Args:
            c: (K, L, 1) coefficients.
            moment: state snapshot of L batch elements.
        """
        return moment.along_primary(_compute_wave(c, moment.t * c[2]))  # (3)


def _compute_wave(c: Array, cycles: Array) -> Array:
    """Return c[0] sin + c[1] cos (L, 1) at a phase given in cycles."""
    angle = 2 * np.pi * cycles
    wave: Array = c[0] * np.sin(angle) + c[1] * np.cos(angle)
    return wave
