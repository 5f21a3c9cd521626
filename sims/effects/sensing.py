"""What lies between the world and its recording.

With y what there is, r what is recorded, t the time stamp and c the coefficient:

* (1) gain: r = (1 + c) y
* (2) bias: r = y + c
* (3) delay: r(t) = y(t - c)
* (4) lag: c dr/dt = y - r (`sims.effects.lag`)
* (5) drift: r(t) = y(t) + c t
* (6) clock: r(t) = y((1 + c) t)
* (7) eccentricity: r = y + a sin y + b cos y, y an angle

Gain, bias, drift and eccentricity act on one channel, the system's first observed; a delay, a lag
and a skewed clock on all. A negative delay leads; a negative lag is none.
"""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.effects.lag import before, recur, response
from sims.system import Coefficient, Sensor, Signal

_TIME = ("s", "s", "s")
"""Seconds, on every kind of system."""
_PURE = ("1", "1", "1")
"""A pure number, on every kind of system."""
_FIFTH = ((-0.2, 0.2), (-0.2, 0.2), (-0.2, 0.2))
"""Plausible gains: a fifth too much or too little."""
_LENGTH = ("m", "m", "rad")
"""Units of a reading that is a position; it may be another."""
_OFFSET = ((-1, 1), (-0.2, 0.2), (-0.2, 0.2))
"""Plausible biases, in the units of `_LENGTH`."""
_SPEED = ("m/s", "m/s", "rad/s")
"""Units of `_LENGTH`, per second."""
_DRIFT = ((-0.2, 0.2), (-0.05, 0.05), (-0.1, 0.1))
"""Plausible drifts, in the units of `_SPEED`."""
_SLOW = ((-0.05, 0.05), (-0.05, 0.05), (-0.05, 0.05))
"""Plausible errors of a clock, seconds a second."""
_ANGLE = (None, None, "rad")
"""Of what an encoder of angles shows."""
_OFF_AXIS = ((0, 0), (0, 0), (-0.1, 0.1))
"""Plausible errors of an encoder that is off its axis, in the units of `_ANGLE`."""
_VOCABULARY = "International Vocabulary of Metrology, JCGM 200:2012"


class Gain(Sensor):
    """The reading times 1 + c."""

    name = "sensor.gain"
    noun = "a sensor gain"
    says = "the sensor shows too much or too little, in proportion"
    source = _VOCABULARY + ", 4.12"
    coefficients = (Coefficient("coefficient", _PURE, _FIFTH),)

    def read(self, c: Array, signal: Signal) -> Array:
        """In proportion."""
        return signal.values * (1.0 + c[0])  # (1)


class Bias(Sensor):
    """The reading plus c."""

    name = "sensor.bias"
    noun = "a sensor bias"
    says = "the sensor's zero is off"
    source = _VOCABULARY + ", 4.20"
    coefficients = (Coefficient("coefficient", _LENGTH, _OFFSET, of="reading"),)

    def read(self, c: Array, signal: Signal) -> Array:
        """Shifted."""
        return signal.values + c[0]  # (2)


class Delay(Sensor):
    """What was the case c seconds before the time stamp; before the start, the initial state."""

    name = "sensor.delay"
    noun = "a sensor delay"
    says = "the sensor shows what was the case a while ago"
    source = "K. J. Astrom, R. M. Murray, Feedback Systems (2008)"
    coefficients = (Coefficient("coefficient", _TIME, ((0, 0.2), (0, 0.2), (0, 0.2))),)

    def times(self, c: Array, t: Array) -> Array:
        """Earlier instants."""
        return t - c[0]  # (3)


class Lag(Sensor):
    """The reading through a first-order lag with time constant c, settled at its first value."""

    name = "sensor.lag"
    noun = "a sensor lag"
    says = "the sensor follows gradually instead of at once"
    source = _VOCABULARY + ", 4.23"
    filters = True  # between two samples the reading goes on, so every step counts
    coefficients = (Coefficient("coefficient", _TIME, ((0, 0.2), (0, 0.2), (0, 0.2))),)

    def read(self, c: Array, signal: Signal) -> Array:
        """Exact for a reading that is linear over each step."""
        # (4); without a lag the reading itself, bit for bit
        return np.where(c[0] > 0, _lagged(signal, c[0]), signal.values)


class Drift(Sensor):
    """The reading plus c for each second since the start of the run."""

    name = "sensor.drift"
    noun = "a sensor drift"
    says = "the sensor's zero drifts steadily"
    source = _VOCABULARY + ", 4.21"
    coefficients = (Coefficient("coefficient", _SPEED, _DRIFT, of="reading/s"),)

    def read(self, c: Array, signal: Signal) -> Array:
        """Further off as time goes on."""
        return signal.values + c[0] * signal.times  # (5)


class Eccentricity(Sensor):
    """An encoder's disc or magnet that is off its axis: an error that comes once a turn."""

    name = "sensor.eccentricity"
    noun = "an eccentric encoder"
    says = "the encoder is off its axis, so that its error comes once a turn"
    source = "X.-D. Lu et al., CIRP Annals 59(1), 529 (2010), introduction"
    needs = "guide"
    coefficients = tuple(Coefficient(of, _ANGLE, _OFF_AXIS) for of in ("sine", "cosine"))

    def read(self, c: Array, signal: Signal) -> Array:
        """As far off as the angle says."""
        y = signal.values
        return y + c[0] * np.sin(y) + c[1] * np.cos(y)  # (7)


class Skew(Sensor):
    """A recorder's clock that is slow by c: 1 + c seconds pass between stamps one second apart."""

    name = "clock.skew"
    noun = "a clock skew"
    says = "the recorder's clock runs slow or fast"
    source = "V. Paxson et al., Framework for IP Performance Metrics, RFC 2330 (1998), section 10.1"
    at = "world"
    coefficients = (Coefficient("coefficient", _PURE, _SLOW),)

    def times(self, c: Array, t: Array) -> Array:
        """Instants on the true clock."""
        return t * (1.0 + c[0])  # (6)


def _lagged(signal: Signal, lag: Array) -> Array:
    """Ends (L, S) of each step of (4), `lag` (L, 1) in seconds."""
    decay, mean = response(signal.steps, lag)
    old = before(signal.values, signal.start)
    # (4) of sims.effects.lag, all but its first term, which goes from step to step
    gained = signal.values - decay * old - mean * (signal.values - old)
    return recur(decay, gained, signal.start)
