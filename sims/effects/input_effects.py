"""Input effects: transformations from the commanded to the applied first input.

With u the command, w the applied input and c the coefficient:

* (0) hold: w = u + c (v - u), with v the command interpolated linearly between samples if the
  recording specifies a zero-order hold, or held if it specifies linear interpolation
* (1) gain: w = (1 + c) u
* (2) bias: w = u + c
* (3) delay: w(t) = u(t - c)
* (4) lag: c dw/dt = u - w; the plant receives its mean over each step (`effects.input_effects`)
* (5) dead band: w = u - clip(u, -c, c)
* (6) saturation: w = clip(u, -c, c)
* (7) backlash: w is constant while |u - w| <= c / 2, otherwise the nearer flank pushes it
* (8) power: w = (1 + gain) sign(u) |u|^(1 + power), |u| in the input's unit
* (9) rate: dw/dt = clip((u - w) / h, -c, c) over a step h, from the first command on

A negative delay is a lead; a negative lag, width or limit counts as zero.
"""

from __future__ import annotations

import numpy as np

from sims.core.effect import Coefficient, Input, Signal
from sims.core.simulator import Array
from sims.effects.compiled_recursions import CLAMP, LINEAR, RATE_LIMIT, run_recursion

_MIN_TIME_CONSTANT = 1e-12
"""Smallest time constant in seconds; such a lag has no effect on any step."""


def compute_lag_response(steps: Array, lag: Array) -> tuple[Array, Array]:
    """Return the remaining weight of an old value at the end of each step and in its mean.

    A first-order lag lets a value decay in a step: to exp(-h / T) at its end, and to
    m = (1 - exp(-h / T)) T / h in the mean over it.

    Shapes: L batch elements, S steps.

    Args:
        steps: (L, S) lengths h in seconds.
        lag: (L, 1) time constants T in seconds.

    Returns:
        Weights (L, S) at the end and in the mean, both 1 for a step of zero length.
    """
    ratio = steps / np.maximum(lag, _MIN_TIME_CONSTANT)
    # a step of zero length, where an element waits, keeps the old value: the limit of m is 1
    divisor = np.where(ratio > 0, ratio, 1.0)
    # expm1, since 1 - exp has cancellation if steps are much shorter than the lag
    mean = np.where(ratio > 0, -np.expm1(-ratio) / divisor, 1.0)
    return np.exp(-ratio), mean


def shift_by_one_step(values: Array, start: Array) -> Array:
    """Return the value (L, S) before each step.

    Args:
        values: (L, S) values at the end of each step.
        start: (L, 1) value before the first step.
    """
    return np.concatenate([start, values[:, :-1]], axis=1)


_FORCE_UNITS = ("m/s^2", "N", "N*m")
"""Units of an input that is a force, on the three kinds of system; an input may have another."""
_SECONDS = ("s", "s", "s")
"""Seconds, on every kind of system."""
_DIMENSIONLESS = ("1", "1", "1")
"""Units of a dimensionless coefficient on every kind of system."""
_GAIN_RANGES = ((-0.5, 0.5), (-0.5, 0.5), (-0.5, 0.5))
"""Plausible gains: up to 50 % more or less."""
_WIDE_GAIN_RANGES = ((-0.9, 9), (-0.9, 9), (-0.9, 9))
"""Plausible gains combined with a power, which changes the scale far from one unit."""
_EXPONENT_RANGES = ((-0.5, 2), (-0.5, 2), (-0.5, 2))
"""Plausible additions to the exponent one."""
_MIN_EXPONENT = 0.01
"""Smallest exponent; with zero, only the sign of the input would act."""
_BIAS_RANGES = ((-2, 2), (-2, 2), (-0.2, 0.2))
"""Plausible biases, in the units of `_FORCE_UNITS`."""
_WIDTH_RANGES = ((0, 2), (0, 2), (0, 0.2))
"""Plausible widths of dead band and backlash, in the units of `_FORCE_UNITS`."""
_LIMIT_RANGES = ((0, 10), (0, 10), (0, 2))
"""Plausible limits, in the units of `_FORCE_UNITS`."""
_FORCE_RATE_UNITS = ("m/s^3", "N/s", "N*m/s")
"""Units of `_FORCE_UNITS`, per second."""
_RATE_LIMIT_RANGES = ((0, 50), (0, 50), (0, 10))
"""Plausible limits of the rate, in the units of `_FORCE_RATE_UNITS`."""
_DELAY = (-0.05, 0.2)
"""Plausible delays in s.

Time stamps may be late by one or two samples, so that a command seems to lead.
"""
_FEEDBACK = "K. J. Astrom, R. M. Murray, Feedback Systems (2008)"
_NONLINEAR = "H. K. Khalil, Nonlinear Systems (2002), section 1.2"
_PLAY = "M. Nordin, P.-O. Gutman, Automatica 38(10), 1633 (2002), doi:10.1016/S0005-1098(02)00047-X"


class InputHold(Input):
    """Command held instead of interpolated between samples, or vice versa; a mixture for c < 1."""

    name = "input.hold"
    noun = "a different interpolation of the input"
    says = (
        "between samples, the input is interpolated instead of held, or held instead of "
        "interpolated"
    )
    source = "K. J. Astrom, B. Wittenmark, Computer-Controlled Systems (1997), chapter 7"
    coefficients = (Coefficient("coefficient", _DIMENSIONLESS, ((0, 1), (0, 1), (0, 1)), most=1.5),)
    between = True  # (0), applied where means over steps are computed: `sims.engines.step_inputs`


class InputGain(Input):
    """Input times 1 + c."""

    name = "input.gain"
    noun = "an input gain"
    says = "the input is larger or smaller than commanded"
    source = _FEEDBACK
    coefficients = (Coefficient("coefficient", _DIMENSIONLESS, _GAIN_RANGES),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """Return the scaled input (L, S).

        Args:
            c: (1, L, 1) relative change of the gain.
            signal: signal (L, S) over the steps.
        """
        return signal.values * (1.0 + c[0])  # (1)


class InputBias(Input):
    """Input plus c."""

    name = "input.bias"
    noun = "an input bias"
    says = "a constant is added to the input"
    source = _FEEDBACK
    coefficients = (Coefficient("coefficient", _FORCE_UNITS, _BIAS_RANGES, of="input"),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """Return the shifted input (L, S).

        Args:
            c: (1, L, 1) bias.
            signal: signal (L, S) over the steps.
        """
        return signal.values + c[0]  # (2)


class InputDelay(Input):
    """Input delayed by c seconds."""

    name = "input.delay"
    noun = "an input delay"
    says = (
        "the input acts later than commanded; a negative value means that its time stamps are late"
    )
    source = _FEEDBACK
    coefficients = (Coefficient("coefficient", _SECONDS, (_DELAY, _DELAY, _DELAY), of="shift"),)

    def times(self, c: Array, t: Array) -> Array:
        """Return the earlier times (L, S) whose command is applied.

        Args:
            c: (1, L, 1) delay, s; negative for a lead.
            t: (L, S) times in seconds.
        """
        return t - c[0]  # (3)


class InputLag(Input):
    """Input through a first-order lag with time constant c, settled at its first value."""

    name = "input.lag"
    noun = "an input lag"
    says = "the input follows its command with a first-order lag"
    source = _FEEDBACK
    coefficients = (
        Coefficient("coefficient", _SECONDS, ((0, 0.5), (0, 0.5), (0, 0.5)), of="shift"),
    )

    def feel(self, c: Array, signal: Signal) -> Array:
        """Return the mean (L, S) of the lagged input over each step.

        Shapes: L batch elements, S steps.

        The applied input w follows the command u by c dw/dt = u - w (4).

        Args:
            c: (1, L, 1) time constant c, s; no lag if not above zero.
            signal: signal (L, S) over the steps.
        """
        # (4); without a lag the command itself, bit for bit
        return np.where(c[0] > 0, _apply_lag(signal, c[0]), signal.values)


class InputDeadBand(Input):
    """Input with dead band: zero while it is within c of zero, otherwise the excess."""

    name = "input.deadband"
    noun = "an input dead band"
    says = "small inputs have no effect"
    source = _NONLINEAR
    coefficients = (Coefficient("coefficient", _FORCE_UNITS, _WIDTH_RANGES, of="input"),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """Return the excess (L, S) over the half width.

        Shapes: L batch elements, S steps.

        With the command u and the coefficient c, the applied input is w = u - clip(u, -c, c) (5).

        Args:
            c: (1, L, 1) half width c; no dead band if not above zero.
            signal: signal (L, S) over the steps.
        """
        half_width = np.abs(c[0])  # np.clip needs a positive width also where it is not used
        # the excess, not the whole value: the applied input is continuous at the border
        excess = signal.values - np.clip(signal.values, -half_width, half_width)  # (5)
        return np.where(c[0] > 0, excess, signal.values)


class InputSaturation(Input):
    """Input limited to c in both directions; a limit of zero is no limit."""

    name = "input.saturation"
    noun = "input saturation"
    says = "the input is clipped at a limit"
    source = _NONLINEAR
    coefficients = (Coefficient("coefficient", _FORCE_UNITS, _LIMIT_RANGES, of="input"),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """Return the limited input (L, S).

        Shapes: L batch elements, S steps.

        With the command u and the coefficient c, the applied input is w = clip(u, -c, c) (6).

        Args:
            c: (1, L, 1) limit c; none if not above zero.
            signal: signal (L, S) over the steps.
        """
        limit = np.abs(c[0])  # np.clip needs a positive limit also where it is not used
        limited = np.clip(signal.values, -limit, limit)  # (6)
        # a limit of zero is off, as the zero of every effect, and does not set the input to zero
        return np.where(c[0] > 0, limited, signal.values)


class InputBacklash(Input):
    """Backlash of full width c, centred when the run starts."""

    name = "backlash"
    noun = "backlash"
    says = "after a reversal, the input acts only when the backlash is crossed"
    source = _PLAY
    coefficients = (Coefficient("coefficient", _FORCE_UNITS, _WIDTH_RANGES, of="input"),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """Return the input (L, S) on the load side of the backlash.

        Shapes: L batch elements, S steps.

        Args:
            c: (1, L, 1) full width; no backlash if not above zero.
            signal: signal (L, S) over the steps.
        """
        load_side_input = _apply_play(signal, c[0] / 2)
        return np.where(c[0] > 0, load_side_input, signal.values)


class InputPower(Input):
    """Input to a power, as a propeller's thrust is quadratic in its speed."""

    name = "input.power"
    noun = "a power of the input"
    says = "the force is proportional to a power of the input, such as a propeller's thrust"
    source = "R. Mahony, V. Kumar, P. Corke, IEEE Robot. Autom. Mag. 19(3), 20 (2012), equation 6"
    needs, contains = "input", ("input.gain",)
    coefficients = (
        Coefficient("gain", _DIMENSIONLESS, _WIDE_GAIN_RANGES),
        Coefficient("power", _DIMENSIONLESS, _EXPONENT_RANGES),
    )

    def feel(self, c: Array, signal: Signal) -> Array:
        """Return the input (L, S) to a power; an input of one unit changes only by the gain.

        Shapes: L batch elements, S steps.

        With the command u, the applied input is w = (1 + gain) sign(u) |u|^(1 + power) (8).

        Args:
            c: (2, L, 1) coefficients: gain and power.
            signal: signal (L, S) over the steps.
        """
        size = np.abs(signal.values)
        power = np.sign(signal.values) * size ** np.maximum(1.0 + c[1], _MIN_EXPONENT)
        # without a power the input itself, bit for bit
        return (1.0 + c[0]) * np.where(c[1] != 0, power, signal.values)  # (8)


class InputRateLimit(Input):
    """Input with a rate of at most c per second; a limit of zero is no limit."""

    name = "input.rate"
    noun = "a rate limit of the input"
    says = "the rate of change of the input is limited"
    source = _NONLINEAR
    coefficients = (
        Coefficient("coefficient", _FORCE_RATE_UNITS, _RATE_LIMIT_RANGES, of="input/s"),
    )

    def feel(self, c: Array, signal: Signal) -> Array:
        """Return the mean (L, S) of the rate-limited input over each step.

        Shapes: L batch elements, S steps.

        Args:
            c: (1, L, 1) limit per second; none if not above zero.
            signal: signal (L, S) over the steps.
        """
        limit = np.where(c[0] > 0, c[0], np.inf)
        return np.where(c[0] > 0, _apply_rate_limit(signal, limit), signal.values)


def _apply_lag(signal: Signal, lag: Array) -> Array:
    """Return means (L, S) of the lagged input (4) over each step.

    Shapes: L batch elements, S steps.

    The lag is c dw/dt = u - w (4), for a command u that is constant over each step.

    Args:
        signal: input before the effect: values (L, S) and times of the steps.
        lag: (L, 1) time constants in seconds.
    """
    # For a constant command, w(end) = decay w(start) + (1 - decay) u.
    decay, mean_weight = compute_lag_response(signal.steps, lag)
    additions = (1.0 - decay) * signal.values
    step_end_values = run_recursion(LINEAR, decay, additions, signal.start)
    # Engines hold the input over a step. The mean of w, u + (w(start) - u) mean_weight, transfers
    # the same momentum as the lagged input.
    step_start_values = shift_by_one_step(step_end_values, signal.start)
    return signal.values + (step_start_values - signal.values) * mean_weight


def _apply_play(signal: Signal, half_width: Array) -> Array:
    """Return the input (L, S) after backlash (7).

    The output is constant while it is within the clearance of the input; otherwise the nearer flank
    pushes it.

    Shapes: L batch elements, S steps.

    Args:
        signal: input before the effect: values (L, S) and times of the steps.
        half_width: (L, 1) clearance to either side, in the unit of the input.
    """
    # The position within the backlash is not recorded: the centre favours neither direction.
    low, high = signal.values - half_width, signal.values + half_width
    return run_recursion(CLAMP, low, high, signal.start)  # (7)


def _apply_rate_limit(signal: Signal, limit: Array) -> Array:
    """Return means (L, S) over each step of an input w whose rate is limited (9).

    With the command u and a step h, dw/dt = clip((u - w) / h, -limit, limit).

    Shapes: L batch elements, S steps.

    Args:
        signal: input before the effect: values (L, S) and times of the steps.
        limit: (L, 1) largest rate, infinite for no limit.
    """
    # Largest change in each step; an infinite limit times a step of zero length counts as zero.
    has_length = signal.steps > 0
    max_changes = np.where(has_length, limit * np.where(has_length, signal.steps, 1.0), 0.0)
    step_end_values = run_recursion(RATE_LIMIT, signal.values, max_changes, signal.start)
    changes = step_end_values - shift_by_one_step(step_end_values, signal.start)
    # w changes linearly until it reaches the command, and is constant for the rest of the step. Its
    # mean is below the end value by half the change, over the share of the step in which it moves.
    moving_share = np.abs(changes) / np.where(max_changes > 0, max_changes, np.inf)
    mean_values = step_end_values - 0.5 * moving_share * changes
    return np.where(np.isfinite(max_changes), mean_values, signal.values)


def average_earlier_signal(signal: Signal, delay: Array) -> Array:
    """Return means (L, S) over each step of the signal `delay` (L, 1) seconds earlier.

    Before the first step, the signal has its initial value. A mean is the difference of the
    integral of the signal at both ends of the delayed step, divided by the step. Values remain
    unchanged where the delay is not above zero, and in steps without length.

    Shapes: L batch elements, S steps.

    Args:
        signal: signal over the steps.
        delay: (L, 1) delays in seconds.
    """
    step_ends = signal.times
    step_starts = step_ends - signal.steps
    cumulative_integral = np.cumsum(signal.values * signal.steps, axis=1)
    averages = signal.values.copy()
    for batch_index in np.flatnonzero(delay[:, 0] > 0):
        # The integral is linear between the ends of steps, and zero where the first step starts. It
        # begins 1 s before that with minus the initial value, as the signal is constant there;
        # `_integrate_signal` extends it to earlier times.
        knots = np.concatenate(
            [
                [step_starts[batch_index, 0] - 1.0, step_starts[batch_index, 0]],
                step_ends[batch_index],
            ]
        )
        integral = np.concatenate(
            [[-signal.start[batch_index, 0], 0.0], cumulative_integral[batch_index]]
        )
        first, last = (
            _integrate_signal(knots, integral, t[batch_index] - delay[batch_index])
            for t in (step_starts, step_ends)
        )
        steps = signal.steps[batch_index]
        has_length = steps > 0
        averages[batch_index, has_length] = (last - first)[has_length] / steps[has_length]
    return averages


def _integrate_signal(knots: Array, integral: Array, t: Array) -> Array:
    """Return the integral at times t, extrapolated linearly before the first knot."""
    interpolated: Array = np.interp(t, knots, integral)
    slope = (integral[1] - integral[0]) / (knots[1] - knots[0])
    return interpolated + slope * np.minimum(t - knots[0], 0.0)
