"""What lies between the world and its recording.

Gain, bias and drift act on one channel, the system's first observed; a delay, a lag and a skewed
clock on all. A negative delay leads; a negative lag is none.
"""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.effects.lag import before, recur, response
from sims.system import Coefficient, Sensor, Signal

_TIME = ("s", "s", "s")
_VOCABULARY = "International Vocabulary of Metrology, JCGM 200:2012"


class Gain(Sensor):
    """The reading times 1 + c."""

    name = "sensor.gain"
    says = "the sensor shows too much or too little, in proportion"
    source = _VOCABULARY + ", 4.12"
    coefficients = (
        Coefficient("coefficient", ("1", "1", "1"), ((-0.2, 0.2), (-0.2, 0.2), (-0.2, 0.2))),
    )

    def read(self, c: Array, signal: Signal) -> Array:
        """In proportion."""
        return signal.values * (1.0 + c[0])


class Bias(Sensor):
    """The reading plus c."""

    name = "sensor.bias"
    says = "the sensor's zero is off"
    source = _VOCABULARY + ", 4.20"
    coefficients = (
        Coefficient(
            "coefficient", ("m", "m", "rad"), ((-1, 1), (-0.2, 0.2), (-0.2, 0.2)), of="reading"
        ),
    )

    def read(self, c: Array, signal: Signal) -> Array:
        """Shifted."""
        return signal.values + c[0]


class Delay(Sensor):
    """What was the case c seconds before the time stamp; before the start, the initial state."""

    name = "sensor.delay"
    says = "the sensor shows what was the case a while ago"
    source = "K. J. Astrom, R. M. Murray, Feedback Systems (2008)"
    coefficients = (Coefficient("coefficient", _TIME, ((0, 0.2), (0, 0.2), (0, 0.2))),)

    def times(self, c: Array, t: Array) -> Array:
        """Earlier instants."""
        return t - c[0]


class Lag(Sensor):
    """The reading through a first-order lag with time constant c, settled at its first value."""

    name = "sensor.lag"
    says = "the sensor follows gradually instead of at once"
    source = _VOCABULARY + ", 4.23"
    filters = True
    coefficients = (Coefficient("coefficient", _TIME, ((0, 0.2), (0, 0.2), (0, 0.2))),)

    def read(self, c: Array, signal: Signal) -> Array:
        """Exact for a reading that is linear over each step."""
        decay, mean = response(signal.steps, c[0])
        old = before(signal.values, signal.start)
        lagged = recur(
            decay, signal.values - decay * old - mean * (signal.values - old), signal.start
        )
        return np.where(c[0] > 0, lagged, signal.values)


class Drift(Sensor):
    """The reading plus c for each second since the start of the run."""

    name = "sensor.drift"
    says = "the sensor's zero drifts steadily"
    source = _VOCABULARY + ", 4.21"
    coefficients = (
        Coefficient(
            "coefficient",
            ("m/s", "m/s", "rad/s"),
            ((-0.2, 0.2), (-0.05, 0.05), (-0.1, 0.1)),
            of="reading/s",
        ),
    )

    def read(self, c: Array, signal: Signal) -> Array:
        """Further off as time goes on."""
        return signal.values + c[0] * signal.times


class Skew(Sensor):
    """A recorder's clock that is slow by c: 1 + c seconds pass between stamps one second apart."""

    name = "clock.skew"
    says = "the recorder's clock runs slow or fast"
    source = "V. Paxson et al., Framework for IP Performance Metrics, RFC 2330 (1998), section 10.1"
    coefficients = (
        Coefficient("coefficient", ("1", "1", "1"), ((-0.05, 0.05), (-0.05, 0.05), (-0.05, 0.05))),
    )

    def times(self, c: Array, t: Array) -> Array:
        """Instants on the true clock."""
        return t * (1.0 + c[0])
