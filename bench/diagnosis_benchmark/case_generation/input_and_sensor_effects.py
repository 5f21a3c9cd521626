"""True system of a case, and the laws by which hidden effects change inputs and sensor readings.

The reference simulations use these laws, which share no code with the effect library.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import copysign, exp, inf

import numpy as np

from sims.core.simulator import Array, Scenario

EffectCoefficients = Mapping[str, Sequence[float]]
"""Coefficients of effects, by the name of the effect."""

SLEW_STEP = 2e-3
"""Time for which an input with limited rate is held constant, s."""

SUBDIVISIONS = 10
"""Number of parts of an interval in which a linear command is held constant."""

NONLINEAR_INPUT_EFFECTS = (
    "input.deadband",
    "input.saturation",
    "backlash",
    "input.rate",
    "input.power",
)
"""Input effects that must act before a lag of the input."""


@dataclass(frozen=True)
class TrueSystem:
    """True system of a case, with hidden causes.

    Attributes:
        system: name of the system.
        parameters: values of the base parameters, by name.
        constants: values of the constants, by name.
        effects: coefficients of the hidden causes by name, in the order in which a signal passes
            them.
    """

    system: str
    parameters: Mapping[str, float]
    constants: Mapping[str, float]
    effects: EffectCoefficients = field(default_factory=dict)


@dataclass(frozen=True)
class InputSegment:
    """Time interval in which the applied input approaches `target` from `start`.

    With `lag` zero, the input jumps to `target` at once.
    """

    begin: float
    end: float
    start: float
    target: float
    lag: float

    def evaluate(self, t: float) -> float:
        """Return the applied input at time t."""
        return self.target + (
            (self.start - self.target) * exp((self.begin - t) / self.lag) if self.lag > 0 else 0.0
        )

    def slice(self, begin: float, end: float) -> InputSegment:
        """Return the part of this interval from `begin` to `end`."""
        return InputSegment(begin, end, self.evaluate(begin), self.target, self.lag)


def compute_applied_input(
    scenario: Scenario, effects: EffectCoefficients, end_time: float
) -> list[InputSegment]:
    """Compute the first input as applied to the plant, from time 0 to `end_time`.

    The hidden effects change the recorded command on its way to the plant. The result is divided
    into segments in which the input is constant or approaches a constant exponentially, so that a
    solver never meets a jump. Without an input, only a constant offset remains.

    Args:
        scenario: scenario of the run: times, initial state, inputs and constants.
        effects: coefficients of the hidden effects by name.
        end_time: end of the run, in seconds after its first sample.

    Raises:
        NotImplementedError: a nonlinear input effect follows a lag.
    """
    if "u" not in scenario.inputs:
        return [InputSegment(0.0, end_time, 0.0, effects.get("input.bias", [0.0])[0], 0.0)]
    levels, edges, lag = apply_input_effects(
        np.array(scenario.inputs["u"]), scenario.times - scenario.times[0], effects
    )
    # Equal neighbouring levels are one segment.
    changes = np.flatnonzero(np.diff(levels)) + 1
    starts, targets = [0.0, *edges[changes]], [levels[0], *levels[changes]]
    # With a lag, each segment begins at the level that the one before it has reached.
    segments, state = [], levels[0]
    for start, end, target in zip(starts, [*starts[1:], inf], targets, strict=True):
        if start < end_time:
            segments.append(
                InputSegment(
                    float(start), float(min(end, end_time)), float(state), float(target), lag
                )
            )
            state = segments[-1].evaluate(segments[-1].end)
    return segments


def apply_input_effects(
    levels: Array, edges: Array, effects: EffectCoefficients
) -> tuple[Array, Array, float]:
    """Apply hidden effects to a command that is held between samples, in their order.

    A lag must follow the nonlinear input effects; its exponential approach is left to the caller.

    Args:
        levels: command at each of N samples, (N,).
        edges: time of each sample, s, (N,).
        effects: coefficients of the hidden effects by name.

    Returns:
        Levels and begins of the parts in which the command is constant, and the time constant of
        the lag, s; 0 for none.

    Raises:
        NotImplementedError: a nonlinear input effect follows a lag.
    """
    lag = 0.0
    if "input.hold" in effects:
        levels, edges = _interpolate_input(levels, edges, effects["input.hold"][0])
    for name, coefficients in effects.items():
        if name in NONLINEAR_INPUT_EFFECTS and lag:
            raise NotImplementedError(f"{name} behind input.lag")
        if name == "input.delay":
            edges = edges + coefficients[0]
        elif name == "input.lag":
            lag = coefficients[0]
        elif name == "input.rate":
            levels, edges = _limit_input_rate(levels, edges, coefficients[0])
        elif name in STEPWISE_INPUT_EFFECTS:
            levels = STEPWISE_INPUT_EFFECTS[name](levels, *coefficients)
    return levels, edges, lag


def _interpolate_input(levels: Array, edges: Array, share: float) -> tuple[Array, Array]:
    """Divide each interval into parts, to approximate an input between hold and linear.

    A command is usually held until the next sample; an input that is interpolated moves on to the
    next value meanwhile. It is approximated by short constant parts.

    Args:
        levels: input at each of N samples, (N,).
        edges: time of each sample, s, (N,).
        share: 0 for a zero-order hold, 1 for linear interpolation.

    Returns:
        Levels and begins of the parts: `SUBDIVISIONS` for each interval, and the last sample.
    """
    # Relative times of the middles of the parts: each part has the level of its middle.
    parts = (np.arange(SUBDIVISIONS) + 0.5) / SUBDIVISIONS
    # One row for each interval, one column for each part.
    fine_levels = levels[:-1, None] + share * np.diff(levels)[:, None] * parts
    starts = edges[:-1, None] + np.diff(edges)[:, None] * np.arange(SUBDIVISIONS) / SUBDIVISIONS
    return np.append(fine_levels.ravel(), levels[-1]), np.append(starts.ravel(), edges[-1])


def _limit_input_rate(levels: Array, edges: Array, max_rate: float) -> tuple[Array, Array]:
    """Limit the rate of an input, in short parts of constant level.

    The output follows each level on a ramp of the largest rate. The ramp is divided into parts of
    at most `SLEW_STEP` seconds, each with its mean value.

    Args:
        levels: N levels of the input, (N,).
        edges: times at which they begin, s, (N,).
        max_rate: largest change per second, in the unit of the input.

    Returns:
        Levels and begins of the parts.
    """
    # The last level is held for another second, in which it may still be approached.
    end_times = [*edges[1:].tolist(), edges[-1] + 1.0]
    values, starts, output = [], [], float(levels[0])
    for level, start, end in zip(levels.tolist(), edges.tolist(), end_times, strict=True):
        while start < end and output != level:
            end_of_step = min(start + SLEW_STEP, end)
            deviation = level - output
            seconds_to_level = abs(deviation) / max_rate
            ramp_duration = min(seconds_to_level, end_of_step - start)
            # Exactly the level if it is reached, so that the loop ends.
            next_output = (
                level
                if ramp_duration >= seconds_to_level
                else output + copysign(max_rate * ramp_duration, deviation)
            )
            # Mean over the part, in which the ramp may end.
            ramp_share = ramp_duration / (end_of_step - start)
            mean_on_ramp = 0.5 * (output + next_output)
            values.append(mean_on_ramp * ramp_share + next_output * (1 - ramp_share))
            starts.append(start)
            output, start = next_output, end_of_step
        if start < end:  # the level is reached and held
            values.append(level)
            starts.append(start)
    return np.array(values), np.array(starts)


def _apply_backlash(levels: Array, width: float) -> Array:
    """Apply backlash to an input: the output follows only when the input leaves the gap around it.

    Args:
        levels: input at each sample, (T,).
        width: whole width of the gap, in units of the input.

    Returns:
        Output at each sample, (T,); it begins at the first level.
    """
    result, state = [], levels[0]
    for level in levels:
        if abs(level - state) > width / 2:
            state = level - copysign(width / 2, level - state)
        result.append(state)
    return np.array(result)


STEPWISE_INPUT_EFFECTS: dict[str, Callable[..., Array]] = {
    "input.gain": lambda u, c: u * (1 + c),
    "input.bias": lambda u, c: u + c,
    "input.deadband": lambda u, c: np.sign(u) * np.maximum(np.abs(u) - c, 0.0),
    "input.saturation": lambda u, c: np.minimum(np.maximum(u, -c), c),
    "input.power": lambda u, gain, power: (1 + gain) * np.sign(u) * np.abs(u) ** (1 + power),
    "backlash": _apply_backlash,
}
"""Input effects without memory, except `backlash`: functions of the levels and coefficients."""

SENSOR_EFFECTS: dict[str, Callable[[Array, Sequence[float], Array, Array], Array]] = {
    "sensor.gain": lambda y, c, elapsed, times: y * (1 + c[0]),
    "sensor.bias": lambda y, c, elapsed, times: y + c[0],
    "sensor.drift": lambda y, c, elapsed, times: y + c[0] * elapsed,
    "sensor.eccentricity": lambda y, c, elapsed, times: y + (c[0] * np.sin(y) + c[1] * np.cos(y)),
    "sensor.slip": lambda y, c, elapsed, times: y + np.where(times >= c[1], c[0], 0.0),
}
"""Sensor effects without memory: functions of readings (T,), coefficients, seconds since the first
sample, and times of the recording."""


def compute_read_times(effects: EffectCoefficients, times: Array) -> Array:
    """Compute the times at which the sensors read the motion, with a delay and a wrong clock.

    The effects act in their order. The motion is known from time 0 on: before it, a delayed sensor
    shows the initial state.

    Args:
        effects: coefficients of the hidden effects by name.
        times: sample times since the first sample, s, (T,).

    Returns:
        Times that do not decrease, at least 0, s, (T,).
    """
    instants = times
    for name, coefficients in effects.items():
        if name == "sensor.delay":
            instants = instants - coefficients[0]
        elif name == "clock.skew":
            instants = instants * (1 + coefficients[0])
    read_times: Array = np.maximum.accumulate(np.maximum(instants, 0.0))
    return read_times


def apply_sensor_lag(values: Array, grid: Array, lag: float) -> Array:
    """Apply a first-order sensor lag: solve y' = (x - y) / lag.

    The solution is exact for readings x that are linear between grid points.

    Args:
        values: readings x of C channels without lag at G grid points, (G, C).
        grid: times, s, (G,).
        lag: time constant, s.

    Returns:
        Lagging readings y, (G, C); at the first grid point y = x.
    """
    lagged, y = values.copy(), values[0].copy()
    for sample, step in enumerate(np.diff(grid).tolist()):
        slope = (values[sample + 1] - values[sample]) / step
        # On a line, the lagging reading ends up `lag` seconds behind it.
        particular_solution = values[sample] - slope * lag
        y = particular_solution + slope * step + (y - particular_solution) * exp(-step / lag)
        lagged[sample + 1] = y
    return lagged
