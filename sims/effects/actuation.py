"""What lies between the commanded input and the one the plant feels; acts on the first input.

A negative delay leads; a negative lag, width or limit is none.
"""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.effects.lag import before, recur, response
from sims.system import Coefficient, Input, Signal

_USUAL = ("m/s^2", "N", "N*m")
_TIME = ("s", "s", "s")
_FEEDBACK = "K. J. Astrom, R. M. Murray, Feedback Systems (2008)"
_NONLINEAR = "H. K. Khalil, Nonlinear Systems (2002), section 1.2"


class Gain(Input):
    """The input times 1 + c."""

    name = "input.gain"
    says = "the input acts more strongly or weakly than commanded"
    source = _FEEDBACK
    coefficients = (
        Coefficient("coefficient", ("1", "1", "1"), ((-0.5, 0.5), (-0.5, 0.5), (-0.5, 0.5))),
    )

    def feel(self, c: Array, signal: Signal) -> Array:
        """In proportion."""
        return signal.values * (1.0 + c[0])


class Bias(Input):
    """The input plus c."""

    name = "input.bias"
    says = "a constant is added to the input"
    source = _FEEDBACK
    coefficients = (
        Coefficient("coefficient", _USUAL, ((-2, 2), (-2, 2), (-0.2, 0.2)), of="input"),
    )

    def feel(self, c: Array, signal: Signal) -> Array:
        """Shifted."""
        return signal.values + c[0]


class Delay(Input):
    """The input of c seconds ago."""

    name = "input.delay"
    says = "the input acts later than commanded"
    source = _FEEDBACK
    coefficients = (Coefficient("coefficient", _TIME, ((0, 0.2), (0, 0.2), (0, 0.2))),)

    def times(self, c: Array, t: Array) -> Array:
        """Earlier instants."""
        return t - c[0]


class Lag(Input):
    """The input through a first-order lag with time constant c, settled at its first value."""

    name = "input.lag"
    says = "the input builds up gradually instead of at once"
    source = _FEEDBACK
    coefficients = (Coefficient("coefficient", _TIME, ((0, 0.5), (0, 0.5), (0, 0.5))),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """The lagged input's mean over each step."""
        decay, mean = response(signal.steps, c[0])
        ends = recur(decay, (1.0 - decay) * signal.values, signal.start)
        lagged = signal.values + (before(ends, signal.start) - signal.values) * mean
        return np.where(c[0] > 0, lagged, signal.values)


class Deadband(Input):
    """Nothing while the input is within c of zero, the excess beyond."""

    name = "input.deadband"
    says = "small inputs have no effect"
    source = _NONLINEAR
    coefficients = (Coefficient("coefficient", _USUAL, ((0, 2), (0, 2), (0, 0.2)), of="input"),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """What exceeds the half width."""
        return np.where(
            c[0] > 0,
            signal.values - np.clip(signal.values, -np.abs(c[0]), np.abs(c[0])),
            signal.values,
        )


class Saturation(Input):
    """The input limited to c either way; a limit of zero is none."""

    name = "input.saturation"
    says = "the input is cut off at a limit"
    source = _NONLINEAR
    coefficients = (Coefficient("coefficient", _USUAL, ((0, 10), (0, 10), (0, 2)), of="input"),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """What stays within the limit."""
        return np.where(
            c[0] > 0, np.clip(signal.values, -np.abs(c[0]), np.abs(c[0])), signal.values
        )


class Backlash(Input):
    """Play of full width c, at its middle when the run starts."""

    name = "backlash"
    says = "there is play: after a reversal the input acts only once the play is used up"
    source = (
        "M. Nordin, P.-O. Gutman, Automatica 38(10), 1633 (2002), doi:10.1016/S0005-1098(02)00047-X"
    )
    coefficients = (Coefficient("coefficient", _USUAL, ((0, 2), (0, 2), (0, 0.2)), of="input"),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """What the far side of the play does."""
        low, high = signal.values - c[0] / 2, signal.values + c[0] / 2
        result, state = np.empty_like(low), signal.start[:, 0]
        for k in range(low.shape[1]):
            state = result[:, k] = np.clip(state, low[:, k], high[:, k])
        return np.where(c[0] > 0, result, signal.values)
