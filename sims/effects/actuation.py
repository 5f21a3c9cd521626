"""What lies between the commanded input and the one the plant feels; acts on the first input.

With u the command, w what the plant feels and c the coefficient:

* (0) hold: w = u + c (v - u), with v the command that goes straight from sample to sample where
  the recording says that it holds, or holds where it is said to go straight
* (1) gain: w = (1 + c) u
* (2) bias: w = u + c
* (3) delay: w(t) = u(t - c)
* (4) lag: c dw/dt = u - w; the plant feels its mean over each step (`sims.effects.lag`)
* (5) dead band: w = u - clip(u, -c, c)
* (6) saturation: w = clip(u, -c, c)
* (7) backlash: w stays while |u - w| <= c / 2, else it is pushed along by the nearer flank
* (8) power: w = (1 + gain) sign(u) |u|^(1 + power), |u| in the input's unit
* (9) rate: dw/dt = clip((u - w) / h, -c, c) over a step h, from the first command on

A negative delay leads; a negative lag, width or limit is none.
"""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.effects.lag import before, recur, response
from sims.system import Coefficient, Input, Signal

_USUAL = ("m/s^2", "N", "N*m")
"""Units of an input that is a force, on the three kinds of system; an input may have another."""
_TIME = ("s", "s", "s")
"""Seconds, on every kind of system."""
_PURE = ("1", "1", "1")
"""A pure number, on every kind of system."""
_SHARE = ((-0.5, 0.5), (-0.5, 0.5), (-0.5, 0.5))
"""Plausible gains: half as much more or less."""
_SCALE = ((-0.9, 9), (-0.9, 9), (-0.9, 9))
"""Plausible gains beside a power: at inputs far from one unit its scale is another."""
_EXPONENT = ((-0.5, 2), (-0.5, 2), (-0.5, 2))
"""Plausible powers beyond the first."""
_LEAST = 0.01
"""The least power: of none the sign alone would act."""
_OFFSET = ((-2, 2), (-2, 2), (-0.2, 0.2))
"""Plausible biases, in the units of `_USUAL`."""
_WIDTH = ((0, 2), (0, 2), (0, 0.2))
"""Plausible widths of dead band and play, in the units of `_USUAL`."""
_LIMIT = ((0, 10), (0, 10), (0, 2))
"""Plausible limits, in the units of `_USUAL`."""
_PER_SECOND = ("m/s^3", "N/s", "N*m/s")
"""Units of `_USUAL`, per second."""
_SLEW = ((0, 50), (0, 50), (0, 10))
"""Plausible limits of the rate, in the units of `_PER_SECOND`."""
_DELAY = (-0.05, 0.2)
"""Plausible delays, s: stamps may be late by a sample or two, so that a command seems to lead."""
_FEEDBACK = "K. J. Astrom, R. M. Murray, Feedback Systems (2008)"
_NONLINEAR = "H. K. Khalil, Nonlinear Systems (2002), section 1.2"
_PLAY = "M. Nordin, P.-O. Gutman, Automatica 38(10), 1633 (2002), doi:10.1016/S0005-1098(02)00047-X"


class Hold(Input):
    """Between samples, the command as the recording does not say; mixed where c is a share."""

    name = "input.hold"
    noun = "an input read the other way between samples"
    says = "between two samples the input goes straight instead of holding, or holds instead"
    source = "K. J. Astrom, B. Wittenmark, Computer-Controlled Systems (1997), chapter 7"
    coefficients = (Coefficient("coefficient", _PURE, ((0, 1), (0, 1), (0, 1))),)
    between = True  # (0), where means over steps are taken: `sims.plan`


class Gain(Input):
    """The input times 1 + c."""

    name = "input.gain"
    noun = "an input gain"
    says = "the input acts more strongly or weakly than commanded"
    source = _FEEDBACK
    coefficients = (Coefficient("coefficient", _PURE, _SHARE),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """In proportion."""
        return signal.values * (1.0 + c[0])  # (1)


class Bias(Input):
    """The input plus c."""

    name = "input.bias"
    noun = "an input bias"
    says = "a constant is added to the input"
    source = _FEEDBACK
    coefficients = (Coefficient("coefficient", _USUAL, _OFFSET, of="input"),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """Shifted."""
        return signal.values + c[0]  # (2)


class Delay(Input):
    """The input of c seconds ago."""

    name = "input.delay"
    noun = "an input delay"
    says = "the input acts later than commanded, or its stamps are late where it is negative"
    source = _FEEDBACK
    coefficients = (Coefficient("coefficient", _TIME, (_DELAY, _DELAY, _DELAY)),)

    def times(self, c: Array, t: Array) -> Array:
        """Earlier instants."""
        return t - c[0]  # (3)


class Lag(Input):
    """The input through a first-order lag with time constant c, settled at its first value."""

    name = "input.lag"
    noun = "an input lag"
    says = "the input builds up gradually instead of at once"
    source = _FEEDBACK
    coefficients = (Coefficient("coefficient", _TIME, ((0, 0.5), (0, 0.5), (0, 0.5))),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """The lagged input's mean over each step."""
        # (4); without a lag the command itself, bit for bit
        return np.where(c[0] > 0, _lagged(signal, c[0]), signal.values)


class Deadband(Input):
    """Nothing while the input is within c of zero, the excess beyond."""

    name = "input.deadband"
    noun = "an input dead band"
    says = "small inputs have no effect"
    source = _NONLINEAR
    coefficients = (Coefficient("coefficient", _USUAL, _WIDTH, of="input"),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """What exceeds the half width."""
        half = np.abs(c[0])
        # what exceeds, not what passes a gate: felt input stays continuous at the border
        beyond = signal.values - np.clip(signal.values, -half, half)  # (5)
        return np.where(c[0] > 0, beyond, signal.values)


class Saturation(Input):
    """The input limited to c either way; a limit of zero is none."""

    name = "input.saturation"
    noun = "input saturation"
    says = "the input is cut off at a limit"
    source = _NONLINEAR
    coefficients = (Coefficient("coefficient", _USUAL, _LIMIT, of="input"),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """What stays within the limit."""
        limit = np.abs(c[0])
        limited = np.clip(signal.values, -limit, limit)  # (6)
        # a limit of zero is off, as every effect's zero: it does not cut everything
        return np.where(c[0] > 0, limited, signal.values)


class Backlash(Input):
    """Play of full width c, at its middle when the run starts."""

    name = "backlash"
    noun = "backlash"
    says = "there is play: after a reversal the input acts only once the play is used up"
    source = _PLAY
    coefficients = (Coefficient("coefficient", _USUAL, _WIDTH, of="input"),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """What the far side of the play does."""
        played = _pushed(signal, c[0] / 2)
        return np.where(c[0] > 0, played, signal.values)


class Power(Input):
    """The input to a power, as a propeller's thrust goes with the square of its speed."""

    name = "input.power"
    noun = "a power of the input"
    says = "what acts goes with a power of the input, as a propeller's thrust with its square"
    source = "R. Mahony, V. Kumar, P. Corke, IEEE Robot. Autom. Mag. 19(3), 20 (2012), equation 6"
    needs, contains = "input", ("input.gain",)
    coefficients = (Coefficient("gain", _PURE, _SCALE), Coefficient("power", _PURE, _EXPONENT))

    def feel(self, c: Array, signal: Signal) -> Array:
        """In proportion to the power of its size; an input of one unit stays, but for the gain."""
        size = np.abs(signal.values)
        bent = np.sign(signal.values) * size ** np.maximum(1.0 + c[1], _LEAST)
        return (1.0 + c[0]) * np.where(c[1] != 0, bent, signal.values)  # (8)


class Rate(Input):
    """The input follows no faster than c a second; a limit of zero is none."""

    name = "input.rate"
    noun = "a limit of the input's rate"
    says = "the input follows commands no faster than a limit"
    source = _NONLINEAR
    coefficients = (Coefficient("coefficient", _PER_SECOND, _SLEW, of="input/s"),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """The mean over each step of what is reached at the limit."""
        limit = np.where(c[0] > 0, c[0], np.inf)
        return np.where(c[0] > 0, _slewed(signal, limit), signal.values)


def _lagged(signal: Signal, lag: Array) -> Array:
    """Means (L, S) over each step of (4), `lag` (L, 1) in seconds."""
    # the command is constant over a step, so (2) of sims.effects.lag leads from end to end
    decay, mean = response(signal.steps, lag)
    ends = recur(decay, (1.0 - decay) * signal.values, signal.start)
    # engines hold the input over a step: its mean gives the momentum that the lagged one gives
    return signal.values + (before(ends, signal.start) - signal.values) * mean


def _pushed(signal: Signal, half: Array) -> Array:
    """What is pushed to and fro (L, S) by (7), `half` (L, 1) the play to either side."""
    # Step by step in rows, which lie together in memory.
    low = np.ascontiguousarray((signal.values - half).T)
    high = np.ascontiguousarray((signal.values + half).T)
    # where in its play a drive rests is not recorded: the middle favours neither direction
    state: Array = signal.start[:, 0]
    for below, above in zip(low, high, strict=True):
        # (7), without the overhead of np.clip, in place: what was low is the result
        np.maximum(state, below, out=below)
        state = np.minimum(below, above, out=below)
    return low.T


def _slewed(signal: Signal, limit: Array) -> Array:
    """Means (L, S) over each step of (9), `limit` (L, 1) of the rate, endless where there is
    none.
    """
    wanted = np.ascontiguousarray(signal.values.T)
    # An endless limit over a step of no length is none.
    reach = np.where(signal.steps > 0, limit * np.where(signal.steps > 0, signal.steps, 1.0), 0.0).T
    back = -reach
    moved = np.empty_like(wanted)
    ends = np.empty_like(wanted)
    state: Array = signal.start[:, 0]
    for row, up, down, move, end in zip(wanted, reach, back, moved, ends, strict=True):
        np.subtract(row, state, out=move)
        np.minimum(move, up, out=move)
        np.maximum(move, down, out=move)
        state = np.add(state, move, out=end)
    # It rises for as long as the limit asks, and stays for the rest of the step.
    rising = np.abs(moved) / np.where(reach > 0, reach, np.inf)
    means = ends - 0.5 * rising * moved
    return np.where(np.isfinite(reach), means, wanted).T
