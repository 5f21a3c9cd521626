"""What lies between the world and its recording.

With y what there is, r what is recorded, t the time stamp and c the coefficient:

* (1) gain: r = (1 + c) y
* (2) bias: r = y + c
* (3) delay: r(t) = y(t - c)
* (4) lag: c dr/dt = y - r (`sims.effects.lag`)
* (5) drift: r(t) = y(t) + c t
* (6) clock: r(t) = y((1 + c) t)
* (7) eccentricity: r = y + a sin y + b cos y, y an angle
* (8) slip: r(t) = y(t) + c from an instant s on, on the clock of the stamps

Of a slip between two samples nobody knows when it was: over an interval h before a sample, (8) is
straight from s = t - h / 2, where it has happened, to s = t + h / 2, where it has not.

Gain, bias, drift, eccentricity and slip act on one channel, the system's first observed; a delay,
a lag and a skewed clock on all. A negative delay leads; a negative lag is none.
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
_LEAST_GAIN = -0.8
"""A sensor shows at least a fifth of the true value: a reading that hardly depends on what is
measured would agree with any constant signal.
"""
_MOST_GAIN = 4.0
"""And at most five times the true value."""
_LENGTH = ("m", "m", "rad")
"""Units of a reading that is a position; it may be another."""
_OFFSET = ((-1, 1), (-0.2, 0.2), (-0.2, 0.2))
"""Plausible biases, in the units of `_LENGTH`."""
_OFF = Coefficient("coefficient", _LENGTH, _OFFSET, of="reading")
"""By how much a reading is off."""
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
_INSTANT = ((0.01, 10), (0.01, 10), (0.01, 10))
"""Plausible instants on a recording's clock, seconds; a fit looks for them as long as runs are."""
_SHORTEST = 1e-12
"""Seconds; samples this close are one."""
_VOCABULARY = "International Vocabulary of Metrology, JCGM 200:2012"


class Gain(Sensor):
    """The reading times 1 + c."""

    name = "sensor.gain"
    noun = "a sensor gain"
    says = "the sensor shows too much or too little, in proportion"
    source = _VOCABULARY + ", 4.12"
    coefficients = (Coefficient("coefficient", _PURE, _FIFTH, least=_LEAST_GAIN, most=_MOST_GAIN),)

    def read(self, c: Array, signal: Signal) -> Array:
        """In proportion."""
        return signal.values * (1.0 + c[0])  # (1)


class Bias(Sensor):
    """The reading plus c."""

    name = "sensor.bias"
    noun = "a sensor bias"
    says = "the sensor's zero is off"
    source = _VOCABULARY + ", 4.20"
    coefficients = (_OFF,)

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


class Slip(Sensor):
    """An encoder that slips once: the reading plus c from an instant on."""

    name = "sensor.slip"
    noun = "an encoder that slipped"
    says = "the encoder slipped at an instant, and is off by the same amount from then on"
    source = "M. Basseville, I. V. Nikiforov, Detection of Abrupt Changes (1993), chapter 2"
    needs = "guide"
    contains = ("sensor.bias",)
    coefficients = (_OFF, Coefficient("instant", _TIME, _INSTANT))

    def read(self, c: Array, signal: Signal) -> Array:
        """As far off as it has slipped."""
        return signal.values + c[0] * _since(c[1], signal.clock + signal.times)  # (8)


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


def _since(instant: Array, now: Array) -> Array:
    """(L, S) of stamps `now`: 0 before an instant (L, 1), 1 after it, (8) about it."""
    apart = np.maximum(np.diff(now, axis=1, prepend=now[:, :1]), _SHORTEST)
    share: Array = np.clip((now - instant) / apart + 0.5, 0.0, 1.0)
    return share


def _lagged(signal: Signal, lag: Array) -> Array:
    """Ends (L, S) of each step of (4), `lag` (L, 1) in seconds."""
    decay, mean = response(signal.steps, lag)
    old = before(signal.values, signal.start)
    # (4) of sims.effects.lag, all but its first term, which goes from step to step
    gained = signal.values - decay * old - mean * (signal.values - old)
    return recur(decay, gained, signal.start)
