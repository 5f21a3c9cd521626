"""Largest recorded values of the quantities that effects limit: inputs, rates, errors, levels."""

from __future__ import annotations

import numpy as np

from bench.diagnosis.evaluation.initial_state_guesses import RunData
from bench.diagnosis.evaluation.parameter_bounds import list_coefficients
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.core.effect import Effect, members_of
from sims.core.simulator import Array

MIN_PROFILE_SECONDS = 0.05
"""Duration in seconds below which the motion profile of a servo is hardly visible."""


def compute_reachable_levels(evaluator: RunEvaluator, name: str) -> Array:
    """Return the largest values that the limited quantity of an effect reaches in the runs.

    A limit above such a value changes nothing, so the search tries fractions of it. The quantity
    follows from the kind of the first coefficient (`Coefficient.of`):

    1. a compliance ("give"), the force of a drive, or a level that is not recorded: the largest
       plausible coefficient, because the range of the quantity is not recorded;
    2. the travel of a joint, for backlash: its largest recorded range;
    3. an input, its rate or acceleration, the error of a servo, or a level: the largest one in the
       recorded runs.

    Args:
        evaluator: evaluator with the recorded runs.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.

    Returns:
        One value for each member of the effect (a family has several). Compliances and backlash are
        no families, and a limit of a drive has one coefficient, so these have one value each.
    """
    effect = evaluator.available_effects[name]
    # An effect that is no family is its own only member.
    members = members_of(effect)
    kind = effect.coefficients[0].of
    # 1. A compliance.
    if kind == "give":
        # The coefficients after the first one are shape parameters.
        return np.array([list_coefficients(evaluator, name)[0].bounds[1]])
    # A force, or a level that is not recorded.
    if kind == "drive" or (kind == "level" and not _get_limited_channel(evaluator, effect)):
        return np.array([p.bounds[1] for p in list_coefficients(evaluator, name)])
    # 2. Backlash.
    if kind == "travel":
        return np.array([evaluator.get_effect_travel(name)])
    level_functions = {
        "input/s": _compute_max_input_rate,
        "input/s^2": _compute_max_input_acceleration,
        "error": _compute_max_servo_error,
        "level": _compute_max_level,
    }
    # 3. All kinds that are not listed are limits of the input itself.
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
    # Input signals (T,) of the run by name.
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

    Half of the time t = `MIN_PROFILE_SECONDS` is acceleration, half braking. A faster motion is
    hardly visible, so that this is the largest acceleration limit that is tried.

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

    It is zero if the position is not recorded. The position of the joint is multiplied by the gear
    ratio first, because the command is in units of the motor's travel.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        run_data: recorded run, prepared for fitting: scenario and observed samples.
        effect: effect on the command of the servo.
    """
    system = evaluator.simulator.system
    # Index of the coordinate on which the effect acts.
    place = system.primary if effect.coordinate is None else effect.coordinate
    name = system.coordinates[place]
    if name not in evaluator.channels:
        return 0.0
    motor_position = system.gear(place) * run_data.observed[:, evaluator.channels.index(name)]
    error = _get_command(run_data, effect) - motor_position
    return float(np.nanmax(np.abs(error), initial=0.0))
