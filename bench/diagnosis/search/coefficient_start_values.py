"""Initial values of effect coefficients: levels of signals, end stops, frequencies, event times."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np

from bench.diagnosis.evaluation.coefficient_bounds import compute_coefficient_bounds
from bench.diagnosis.evaluation.run_data import RunData, is_instant
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart, TrajectoryFit
from sims.core.effect import Effect, members_of
from sims.core.simulator import Array, Parameter

END_STOP_STIFFNESS_FACTORS = (0.3, 1.0, 3.0)
"""Stiffness factors of end stops that a fit starts from, relative to the best-scoring one."""
END_STOP_DEPTH_SHARES = tuple(np.geomspace(0.002, 0.4, 10).tolist())
"""Depths of end stops within the range of a coordinate, as shares of the range."""
REFIT_STIFFNESS_FACTORS = (0.25, 0.5, 2.0, 4.0)
"""Stiffness factors of alternative end stops with the same turning point as the fitted one."""
EVENT_TIME_COUNT = 24
"""Number of times tried for a single event."""
MIN_PROFILE_SECONDS = 0.05
"""Duration in seconds below which the motion profile of a servo is hardly visible."""
MAX_EVENT_TIME_SUBDIVISIONS = 16
"""Maximum number of times between two tried event times at which a fit starts."""


EVENT_TIME_SHIFTS_SAMPLES = (-8, -4, -2, -1, 1, 2, 4, 8)
"""Shifts of the time of a single event that are tried, in samples."""
FREQUENCY_SHIFTS_CYCLES = (-1.0, -0.5, 0.5, 1.0)
"""Shifts of a frequency or period that are tried, in cycles over the longest run."""
CONTACT_DEPTH_EXPONENT = -0.4
"""Exponent of the stiffness in the depth of contact of a motion with given energy."""


def list_coefficients(evaluator: RunEvaluator, name: str) -> Sequence[Parameter]:
    """Return the coefficients of an effect as parameters, with units and plausible ranges.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
    """
    return evaluator.parameters[evaluator.coefficient_slices[name]]


def compute_reachable_levels(evaluator: RunEvaluator, name: str) -> Array:
    """Return the largest values that the limited quantity of an effect reaches in the runs.

    A limit above such a value changes nothing, so the search tries fractions of it. The quantity
    is, for example, the input, its rate, or the error of a servo.

    Args:
        evaluator: evaluator with the recorded runs.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.

    Returns:
        One value for each member of the effect (a family has several).
    """
    effect = evaluator.available_effects[name]
    members = members_of(effect)
    kind = effect.coefficients[0].of
    if kind == "give":
        # The coefficients after the first one are shape parameters.
        return np.array([list_coefficients(evaluator, name)[0].bounds[1]])
    if kind == "drive" or (kind == "level" and not _get_limited_channel(evaluator, effect)):
        # The range of the quantity is not recorded, so the plausible range is used.
        return np.array([p.bounds[1] for p in list_coefficients(evaluator, name)])
    if kind == "travel":
        return np.array([evaluator.get_effect_travel(name)])
    level_functions = {
        "input/s": _compute_max_input_rate,
        "input/s^2": _compute_max_input_acceleration,
        "error": _compute_max_servo_error,
        "level": _compute_max_level,
    }
    level_function = level_functions.get(kind, _get_largest_input)
    return np.array(
        [
            max(level_function(evaluator, run_data, member) for run_data in evaluator.prepared_runs)
            for member in members
        ]
    )


def _get_command(run_data: RunData, effect: Effect) -> Array:
    """Return the input signal (T,) of a run on which an effect acts.

    It is the first input if the effect names none, and zero if the run has no such input.

    Args:
        run_data: recorded run, prepared for fitting: scenario and observed samples.
        effect: effect on an input.
    """
    signals = run_data.scenario.inputs
    zero_signal = np.zeros(run_data.scenario.times.size)
    first_signal = next(iter(signals.values()), zero_signal)
    return signals.get(effect.signal, zero_signal) if effect.signal else first_signal


def _get_largest_input(evaluator: RunEvaluator, run_data: RunData, effect: Effect) -> float:  # noqa: ARG001
    """Return the largest magnitude of the input of an effect in a run.

    Args:
        evaluator: unused; all level functions have the same arguments.
        run_data: recorded run, prepared for fitting: scenario and observed samples.
        effect: effect on an input.
    """
    return float(np.abs(_get_command(run_data, effect)).max())


def _compute_max_input_rate(evaluator: RunEvaluator, run_data: RunData, effect: Effect) -> float:  # noqa: ARG001
    """Return the largest rate of change of an effect's input in a run, in its unit per second.

    Args:
        evaluator: unused; all level functions have the same arguments.
        run_data: recorded run, prepared for fitting: scenario and observed samples.
        effect: effect on an input.
    """
    changes = np.abs(np.diff(_get_command(run_data, effect)))
    return float((changes / np.diff(run_data.scenario.times)).max(initial=0.0))


def _compute_max_input_acceleration(
    evaluator: RunEvaluator,  # noqa: ARG001
    run_data: RunData,
    effect: Effect,
) -> float:
    """Return the acceleration 4 d / t² that moves the input over its range d from rest to rest.

    Half of t = `MIN_PROFILE_SECONDS` is acceleration, half braking. It is the largest acceleration
    limit that is tried.

    Args:
        evaluator: unused; all level functions have the same arguments.
        run_data: recorded run, prepared for fitting: scenario and observed samples.
        effect: effect on an input.
    """
    return 4.0 * float(np.ptp(_get_command(run_data, effect))) / MIN_PROFILE_SECONDS**2


def _get_limited_channel(evaluator: RunEvaluator, effect: Effect) -> str:
    """Return the channel of the stored quantity, such as a tank's level, that an effect limits.

    It is empty if the quantity is not recorded.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        effect: effect that limits a stored quantity.
    """
    name = effect.place or evaluator.simulator.system.levels[0]
    return name if name in evaluator.channels else ""


def _compute_max_level(evaluator: RunEvaluator, run_data: RunData, effect: Effect) -> float:
    """Return the maximum of the stored quantity, such as a tank's level, recorded in a run.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        run_data: recorded run, prepared for fitting: scenario and observed samples.
        effect: effect that limits the quantity.
    """
    levels = run_data.observed[:, evaluator.channels.index(_get_limited_channel(evaluator, effect))]
    return float(np.nanmax(levels, initial=0.0))


def _compute_max_servo_error(evaluator: RunEvaluator, run_data: RunData, effect: Effect) -> float:
    """Return the largest difference of command and position of a servo in a run.

    It is zero if the position is not recorded. The position is multiplied by the gear ratio first.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        run_data: recorded run, prepared for fitting: scenario and observed samples.
        effect: effect on the command of the servo.
    """
    system = evaluator.simulator.system
    place = system.primary if effect.coordinate is None else effect.coordinate
    name = system.coordinates[place]
    if name not in evaluator.channels:
        return 0.0
    motor_position = system.gear(place) * run_data.observed[:, evaluator.channels.index(name)]
    error = _get_command(run_data, effect) - motor_position
    return float(np.nanmax(np.abs(error), initial=0.0))


def generate_end_stops(
    evaluator: RunEvaluator,
    name: str,
    side: float,
    stiffness_shares: Sequence[float],
    depth_shares: Sequence[float],
) -> Iterator[Array]:
    """Yield coefficients (k,) of end stops at one end of a coordinate's range.

    All combinations of stiffness and depth are tried, because the response to an end stop is not
    linear. There are none if the range of the coordinate is not recorded.

    Args:
        evaluator: evaluator with the recorded runs.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        side: 1 for the upper end, -1 for the lower end.
        stiffness_shares: stiffnesses, as fractions of the largest plausible one.
        depth_shares: depths within the range of the coordinate, as fractions of the range.
    """
    low, high = evaluator.get_coordinate_range(name)
    parameters = list_coefficients(evaluator, name)
    max_stiffness = parameters[0].bounds[1]
    for stiffness_share, depth_share in (
        product(stiffness_shares, depth_shares) if low < high else ()
    ):
        coefficients = np.zeros(len(parameters))
        coefficients[0] = side * stiffness_share * max_stiffness
        coefficients[1] = (high if side > 0 else low) - side * depth_share * (high - low)
        yield coefficients


def generate_neighbouring_end_stops(
    evaluator: RunEvaluator, name: str, c: Array
) -> Iterator[Array]:
    """Yield end stops (k,) on the same side as a given one; nothing for other effects.

    They are starts of a fit near an end stop with a good score. All depths are tried, because the
    stiffness determines the depth of contact.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        c: (k,) coefficients of the given end stop.
    """
    if evaluator.available_effects[name].coefficients[0].of == "stop":
        bound_share = abs(c[0]) / list_coefficients(evaluator, name)[0].bounds[1]
        # Simulating a robot costs a hundred times as much, so fewer stops are tried.
        stiffness_factors, depth_shares = (
            ((1.0,), END_STOP_DEPTH_SHARES[::2])
            if evaluator.has_linearisation
            else (END_STOP_STIFFNESS_FACTORS, END_STOP_DEPTH_SHARES)
        )
        yield from generate_end_stops(
            evaluator,
            name,
            side=np.sign(c[0]),
            stiffness_shares=[bound_share * factor for factor in stiffness_factors],
            depth_shares=depth_shares,
        )


def generate_equal_travel_end_stops(
    evaluator: RunEvaluator, name: str, c: Array
) -> Iterator[Array]:
    """Yield softer and harder end stops (k,) with the same turning point as a given one.

    They are starts for a fit, since stiffness and position of a stop are nearly interchangeable.
    The depth of contact for a motion of equal energy is proportional to k^(-2/5), with the
    stiffness k, by eq. (2) of `sims.effects.state_limits`.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        c: (k,) coefficients of the given end stop.
    """
    low, high = evaluator.get_coordinate_range(name)
    if evaluator.available_effects[name].coefficients[0].of != "stop" or not c[0]:
        return
    end = high if c[0] > 0 else low
    for factor in REFIT_STIFFNESS_FACTORS:
        end_stop = c.copy()
        end_stop[0] = factor * c[0]
        end_stop[1] = end - (end - c[1]) * factor**CONTACT_DEPTH_EXPONENT
        yield end_stop


def generate_event_times(evaluator: RunEvaluator, name: str, c: Array) -> Iterator[Array]:
    """Yield coefficients (k,) with other event times near a given one, between the time stamps.

    A fit cannot move an event time over a sample, because the cost has a step there. The times
    cover the interval to the next event times that scores have tried. Nothing is generated for
    effects without an event time.

    Args:
        evaluator: evaluator with the recorded runs.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        c: (k,) given coefficients.
    """
    for i, parameter in enumerate(list_coefficients(evaluator, name)):
        if not is_instant(parameter):
            continue
        clock_start, clock_end = evaluator.time_span
        stamps = np.unique(
            np.concatenate([run_data.scenario.times for run_data in evaluator.prepared_runs])
        )
        midpoints = (stamps[1:] + stamps[:-1]) / 2.0
        near_midpoints = midpoints[
            np.abs(midpoints - c[i]) <= (clock_end - clock_start) / (EVENT_TIME_COUNT + 1)
        ]
        # At most MAX_EVENT_TIME_SUBDIVISIONS of them, equally spaced.
        stride = -(-near_midpoints.size // MAX_EVENT_TIME_SUBDIVISIONS) or 1
        for instant in near_midpoints[::stride].tolist():
            coefficients = c.copy()
            coefficients[i] = instant
            yield coefficients


def generate_shifted_starts(evaluator: RunEvaluator, fit: TrajectoryFit) -> Iterator[FitStart]:
    """Yield starts with shifted frequencies, periods, event times and end stops.

    Least squares stops at the nearest of the many local minima that such effects have, so fits
    start from several of them.

    Args:
        evaluator: evaluator with the recorded runs.
        fit: fit whose effects are shifted.
    """
    for name in fit.effects:
        for coefficients in generate_equal_travel_end_stops(
            evaluator, name, fit.theta[evaluator.coefficient_slices[name]]
        ):
            theta = fit.theta.copy()
            theta[evaluator.coefficient_slices[name]] = coefficients
            yield FitStart(fit.effects, theta, fit.initial_states)
        bounds = compute_coefficient_bounds(evaluator, name)
        for i, index in enumerate(evaluator.get_coefficient_indices(name)):
            parameter = evaluator.parameters[index]
            fitted_value = float(fit.theta[index])
            for shifted_value in _shift_frequency_or_time(
                evaluator, parameter, fitted_value, evaluator.get_effect_travel(name)
            ):
                theta = fit.theta.copy()
                theta[index] = np.clip(shifted_value, *bounds[i])
                yield FitStart(fit.effects, theta, fit.initial_states)


def _shift_frequency_or_time(
    evaluator: RunEvaluator, parameter: Parameter, value: float, travel: float
) -> Iterator[float]:
    """Yield shifted values of a frequency, a period or an event time.

    The shifts are about the distance of neighbouring local minima: event times are shifted by
    samples, frequencies by fractions of a cycle over the longest run, and periods, which are
    lengths of travel of a joint, by fractions of a cycle over its largest travel.

    Args:
        evaluator: evaluator, whose longest run determines how far a frequency is shifted.
        parameter: coefficient, with its unit and plausible range.
        value: value to shift, in the unit of the coefficient.
        travel: largest range of the position within one run, in m or rad, for periods over
            position.
    """
    if is_instant(parameter):
        for samples in EVENT_TIME_SHIFTS_SAMPLES:
            yield value + samples * evaluator.sample_interval
        return
    for cycles in FREQUENCY_SHIFTS_CYCLES:
        if parameter.unit == "Hz":
            yield value + cycles / evaluator.longest_duration
        elif is_period(parameter, travel) and value > 0:
            frequency = 1.0 / value + cycles / travel
            # Beyond the longest period, the frequency might become negative.
            lowest = 1.0 / parameter.bounds[1]
            yield 1.0 / max(frequency, lowest)


def is_period(parameter: Parameter, travel: float) -> bool:
    """Return whether a coefficient is a period over position (in m or rad), and the position moves.

    Args:
        parameter: the coefficient.
        travel: largest range of the position within one run, in m or rad.
    """
    return parameter.name.endswith(".period") and travel > 0
