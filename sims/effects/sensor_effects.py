"""Sensor effects: differences between the true values and their recording.

With y the true value, r the recorded value, t the time stamp and c the coefficient:

* (1) gain: r = (1 + c) y
* (2) bias: r = y + c
* (3) delay: r(t) = y(t - c)
* (4) lag: c dr/dt = y - r (`sims.effects.input_effects`)
* (5) drift: r(t) = y(t) + c t
* (6) clock: r(t) = y((1 + c) t)
* (7) eccentricity: r = y + a sin y + b cos y, y an angle
* (8) slip: r(t) = y(t) + c from a time s on, on the clock of the stamps

The time of a slip between two samples is unknown: over an interval h before a sample, (8) is linear
from s = t - h / 2, where it has happened, to s = t + h / 2, where it has not.

Gain, bias, drift, eccentricity and slip act on one channel, the system's first observed one; a
delay, a lag and a skewed clock act on all. A negative delay is a lead; a negative lag counts as
zero.
"""

from __future__ import annotations

import numpy as np

from sims.core.effect import ActiveEffects, Coefficient, Effect, Sensor, Signal
from sims.core.simulator import Array
from sims.effects.compiled_recursions import LINEAR, run_recursion
from sims.effects.input_effects import compute_lag_response, shift_by_one_step
from sims.engines.time_grid import is_active

_SECONDS = ("s", "s", "s")
"""Seconds, on every kind of system."""
_SHIFT_COEFFICIENT = Coefficient(
    "coefficient", _SECONDS, ((0, 0.2), (0, 0.2), (0, 0.2)), of="shift"
)
"""Coefficient of an effect by which a reading comes later, s."""
_DIMENSIONLESS = ("1", "1", "1")
"""Units of a dimensionless coefficient on every kind of system."""
_GAIN_RANGES = ((-0.2, 0.2), (-0.2, 0.2), (-0.2, 0.2))
"""Plausible gains: up to a fifth too much or too little."""
_MIN_GAIN = -0.8
"""Smallest gain: a sensor shows at least a fifth of the true value.

A reading that hardly depends on the measured quantity would agree with any constant signal.
"""
_MAX_GAIN = 4.0
"""Largest gain: a sensor shows at most five times the true value."""
_POSITION_UNITS = ("m", "m", "rad")
"""Units of a reading that is a position; a reading may have another unit."""
_BIAS_RANGES = ((-1, 1), (-0.2, 0.2), (-0.2, 0.2))
"""Plausible biases, in the units of `_POSITION_UNITS`."""
_BIAS_COEFFICIENT = Coefficient("coefficient", _POSITION_UNITS, _BIAS_RANGES, of="reading")
"""Coefficient for a constant error of a reading."""
_SPEED_UNITS = ("m/s", "m/s", "rad/s")
"""Units of `_POSITION_UNITS`, per second."""
_DRIFT_RANGES = ((-0.2, 0.2), (-0.05, 0.05), (-0.1, 0.1))
"""Plausible drifts, in the units of `_SPEED_UNITS`."""
_CLOCK_ERROR_RANGES = ((-0.05, 0.05), (-0.05, 0.05), (-0.05, 0.05))
"""Plausible clock errors in seconds per second."""
_ANGLE_UNITS = (None, None, "rad")
"""Units of the reading of an angle encoder."""
_OFF_AXIS = ((0, 0), (0, 0), (-0.1, 0.1))
"""Plausible errors of an eccentric encoder, in the units of `_ANGLE_UNITS`."""
_TIME_RANGES = ((0.01, 10), (0.01, 10), (0.01, 10))
"""Plausible times in seconds on a recording's clock; a fit searches the duration of the runs."""
_MIN_SAMPLE_INTERVAL = 1e-12
"""Smallest time in seconds between two different samples."""
_VOCABULARY = "International Vocabulary of Metrology, JCGM 200:2012"


class SensorGain(Sensor):
    """Reading times 1 + c."""

    name = "sensor.gain"
    noun = "a sensor gain"
    says = "the sensor reading is too large or too small by a constant factor"
    source = _VOCABULARY + ", 4.12"
    coefficients = (
        Coefficient("coefficient", _DIMENSIONLESS, _GAIN_RANGES, least=_MIN_GAIN, most=_MAX_GAIN),
    )

    def read(self, c: Array, signal: Signal) -> Array:
        """Return the scaled reading (L, S).

        Args:
            c: (1, L, 1) relative change of the gain.
            signal: signal (L, S) over the steps.
        """
        return signal.values * (1.0 + c[0])  # (1)


class SensorBias(Sensor):
    """Reading plus c."""

    name = "sensor.bias"
    noun = "a sensor bias"
    says = "the sensor has a constant offset"
    source = _VOCABULARY + ", 4.20"
    coefficients = (_BIAS_COEFFICIENT,)

    def read(self, c: Array, signal: Signal) -> Array:
        """Return the shifted reading (L, S).

        Args:
            c: (1, L, 1) bias.
            signal: signal (L, S) over the steps.
        """
        return signal.values + c[0]  # (2)


class SensorDelay(Sensor):
    """Reading delayed by c seconds; before the start, the initial state."""

    name = "sensor.delay"
    noun = "a sensor delay"
    says = "the sensor reading is late by a constant time"
    source = "K. J. Astrom, R. M. Murray, Feedback Systems (2008)"
    coefficients = (_SHIFT_COEFFICIENT,)

    def times(self, c: Array, t: Array) -> Array:
        """Return the earlier times (L, S) of the recorded values.

        Args:
            c: (1, L, 1) delay, s.
            t: (L, S) times in seconds.
        """
        return t - c[0]  # (3)


class SensorLag(Sensor):
    """Reading through a first-order lag with time constant c, settled at its first value."""

    name = "sensor.lag"
    noun = "a sensor lag"
    says = "the sensor reading follows with a first-order lag"
    source = _VOCABULARY + ", 4.23"
    filters = True  # the lag evolves between samples, so every step is needed
    coefficients = (_SHIFT_COEFFICIENT,)

    def read(self, c: Array, signal: Signal) -> Array:
        """Return the lagged reading (L, S), exact for a reading that is linear over each step.

        Shapes: L batch elements, S steps.

        The reading r follows the true value y by c dr/dt = y - r (4).

        Args:
            c: (1, L, 1) time constant c, s; no lag if not above zero.
            signal: signal (L, S) over the steps.
        """
        # (4); without a lag the reading itself, bit for bit
        return np.where(c[0] > 0, _apply_lag(signal, c[0]), signal.values)


class SensorDrift(Sensor):
    """Reading plus c for each second since the start of the run."""

    name = "sensor.drift"
    noun = "a sensor drift"
    says = "the sensor's offset changes linearly with time"
    source = _VOCABULARY + ", 4.21"
    coefficients = (Coefficient("coefficient", _SPEED_UNITS, _DRIFT_RANGES, of="reading/s"),)

    def read(self, c: Array, signal: Signal) -> Array:
        """Return the reading (L, S) with an error proportional to time.

        Args:
            c: (1, L, 1) drift per second.
            signal: signal (L, S) over the steps.
        """
        return signal.values + c[0] * signal.times  # (5)


class EncoderEccentricity(Sensor):
    """Eccentric disc or magnet of an encoder: an error with the period of one turn."""

    name = "sensor.eccentricity"
    noun = "an eccentric encoder"
    says = "the encoder is eccentric, so its error repeats once per turn"
    source = "X.-D. Lu et al., CIRP Annals 59(1), 529 (2010), introduction"
    needs = "guide"
    coefficients = tuple(Coefficient(of, _ANGLE_UNITS, _OFF_AXIS) for of in ("sine", "cosine"))

    def read(self, c: Array, signal: Signal) -> Array:
        """Return the reading (L, S) with an error periodic in the angle.

        Shapes: L batch elements, S steps.

        r = y + a sin y + b cos y, with the angle y in rad (7).

        Args:
            c: (2, L, 1) coefficients a and b, rad.
            signal: signal (L, S) over the steps.
        """
        y = signal.values
        return y + c[0] * np.sin(y) + c[1] * np.cos(y)  # (7)


class EncoderSlip(Sensor):
    """Single slip of an encoder: reading plus c from a point in time on."""

    name = "sensor.slip"
    noun = "an encoder that slipped"
    says = "the encoder slipped once during the recording and has a constant offset from then on"
    source = "M. Basseville, I. V. Nikiforov, Detection of Abrupt Changes (1993), chapter 2"
    needs = "guide"
    contains = ("sensor.bias",)
    coefficients = (_BIAS_COEFFICIENT, Coefficient("instant", _SECONDS, _TIME_RANGES))

    def read(self, c: Array, signal: Signal) -> Array:
        """Return the reading (L, S) with a constant error after the slip.

        Args:
            c: (2, L, 1) error after the slip, and time of the slip on the clock of the stamps, s.
            signal: signal (L, S) over the steps.
        """
        return signal.values + c[0] * _smooth_step(c[1], signal.clock + signal.times)  # (8)


class ClockSkew(Sensor):
    """Recorder clock that is slow by c: 1 + c seconds pass between stamps one second apart."""

    name = "clock.skew"
    noun = "a clock skew"
    says = "the recorder's clock runs slow or fast"
    source = "V. Paxson et al., Framework for IP Performance Metrics, RFC 2330 (1998), section 10.1"
    at = "world"
    coefficients = (Coefficient("coefficient", _DIMENSIONLESS, _CLOCK_ERROR_RANGES),)

    def times(self, c: Array, t: Array) -> Array:
        """Return the times (L, S) on the true clock.

        Args:
            c: (1, L, 1) relative slowness of the clock.
            t: (L, S) times in seconds.
        """
        return t * (1.0 + c[0])  # (6)


def _smooth_step(instant: Array, times: Array) -> Array:
    """Return the progress (L, S) of the slip at time stamps: 0 before, 1 after, linear between.

    Shapes: L batch elements, S steps.

    The time s of the slip within an interval h between samples is not known exactly. For a sample
    at t after this interval, the progress is 1 for s <= t - h / 2, and 0 for s >= t + h / 2 (8).

    Args:
        instant: (L, 1) time of the slip, s.
        times: (L, S) time stamps, s.
    """
    intervals = np.maximum(np.diff(times, axis=1, prepend=times[:, :1]), _MIN_SAMPLE_INTERVAL)
    share: Array = np.clip((times - instant) / intervals + 0.5, 0.0, 1.0)
    return share


def _apply_lag(signal: Signal, lag: Array) -> Array:
    """Return a signal (L, S) after a first-order lag, at the end of each step.

    The result r obeys lag dr/dt = y - r (4), with the signal y linear within a step.

    Shapes: L batch elements, S steps.

    Args:
        signal: signal before the lag.
        lag: (L, 1) time constants in seconds.
    """
    decay, mean_weight = compute_lag_response(signal.steps, lag)
    old = shift_by_one_step(signal.values, signal.start)
    # A signal that goes from `old` to `values` in a step gives r(end) = decay r(start) + increment.
    increments = signal.values - decay * old - mean_weight * (signal.values - old)
    return run_recursion(LINEAR, decay, increments, signal.start)


def apply_sensor_effects(
    sensors: ActiveEffects, values: Array, steps: Array, times: Array, clock: Array | float = 0.0
) -> Array:
    """Apply sensor effects one after another to a channel.

    Each effect gets the output of the previous one. So does the value at the start of the run, as
    a signal of one step without length: effects with a memory begin with it.

    Shapes: L batch elements, R values.

    Args:
        sensors: Sensor effects with their coefficients.
        values: (L, R) values of the channel.
        steps: (L, R) lengths of the steps before the values, s.
        times: (L, R) times of the values since the start, s.
        clock: (L, 1) first time stamp of each run, s.

    Returns:
        Readings (L, R).
    """
    values = values.copy()
    start = values[:, :1].copy()
    clock = np.broadcast_to(clock, start.shape)
    for effect, c in sensors:
        assert isinstance(effect, Sensor)
        # An effect may be active in few of the batch elements; evaluate only these.
        elements = np.flatnonzero(is_active(c))
        coefficients, start_values = c[:, elements], start[elements]
        zeros, first = np.zeros_like(start_values), clock[elements]
        signal = Signal(values[elements], steps[elements], start_values, times[elements], first)
        start_signal = Signal(start_values, zeros, start_values, zeros, first)
        values[elements] = effect.read(coefficients, signal)
        start[elements] = effect.read(coefficients, start_signal)
    return values


def needs_every_step(effect: Effect) -> bool:
    """Return whether an effect is a sensor effect that needs every step."""
    return isinstance(effect, Sensor) and effect.filters
