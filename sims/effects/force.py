"""Forces from outside, along the primary coordinate (a ball's height): constant, periodic in
position or in time.

With x the primary coordinate and t the time since the start of the run:

* (1) bias: F = c
* (2) ripple: F = a sin(2 pi x / period) + b cos(2 pi x / period)
* (3) periodic: F = a sin(2 pi frequency t) + b cos(2 pi frequency t)

What repeats is a sine and a cosine rather than an amplitude and a phase: the motion answers to both
in proportion while they are small, and no phase is left undetermined where the amplitude is zero.
"""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.system import Coefficient, Force, Moment

_SMALLEST = 1e-9
"""m or rad; the period that stands for zero, by which nothing can be divided."""
_USUAL = ("m/s^2", "N", "N*m")
"""Units of a force on the three kinds of system."""
_COGGING = (
    "T. M. Jahns, W. L. Soong, IEEE Trans. Ind. Electron. 43(2), 321 (1996), doi:10.1109/41.491356"
)
_RIPPLE = ((-2, 2), (-2, 2), (-0.2, 0.2))
"""Plausible ripples, in the units of `_USUAL`."""
_PERIOD = ((0.01, 1), (0.01, 1), (0.05, 3.1416))
"""Plausible periods, m or rad; twice a turn at least: what repeats once a turn is gravity."""


class Bias(Force):
    """A constant force c."""

    name = "force.bias"
    noun = "a constant force"
    says = "a constant force pushes one way"
    source = "J. R. Taylor, Classical Mechanics (2005), section 1.4"
    coefficients = (Coefficient("coefficient", _USUAL, ((-2, 2), (-5, 5), (-0.5, 0.5))),)

    def force(self, c: Array, moment: Moment) -> Array:
        """The coefficient."""
        return moment.along_primary(c[0])  # (1)


class Ripple(Force):
    """A force that repeats with position, as a motor's cogging."""

    name = "force.ripple"
    noun = "a force periodic in position"
    says = "a force comes and goes with position, as the cogging of a motor"
    needs, source = "guide", _COGGING
    coefficients = (
        Coefficient("sine", _USUAL, _RIPPLE),
        Coefficient("cosine", _USUAL, _RIPPLE),
        Coefficient("period", ("m", "m", "rad"), _PERIOD),
    )

    def force(self, c: Array, moment: Moment) -> Array:
        """Periodic in the primary coordinate."""
        return moment.along_primary(_wave(c, moment.primary / np.maximum(c[2], _SMALLEST)))  # (2)


class Periodic(Force):
    """A force that repeats with time since the start of the run."""

    name = "force.periodic"
    noun = "a force periodic in time"
    says = "a force comes and goes with time, as of something that vibrates nearby"
    source = "L. D. Landau, E. M. Lifshitz, Mechanics (1976), section 22"
    coefficients = (
        Coefficient("sine", _USUAL, ((-2, 2), (-5, 5), (-0.5, 0.5))),
        Coefficient("cosine", _USUAL, ((-2, 2), (-5, 5), (-0.5, 0.5))),
        Coefficient("frequency", ("Hz", "Hz", "Hz"), ((0.1, 10), (0.1, 10), (0.1, 10))),
    )

    def force(self, c: Array, moment: Moment) -> Array:
        """Periodic in time."""
        return moment.along_primary(_wave(c, moment.t * c[2]))  # (3)


def _wave(c: Array, cycles: Array) -> Array:
    """(L, 1) c[0] sin + c[1] cos, after so many cycles."""
    angle = 2 * np.pi * cycles
    wave: Array = c[0] * np.sin(angle) + c[1] * np.cos(angle)
    return wave
