"""Applied inputs of many batch elements: mean of each command over each step, changed by effects.

Effects on the input change the signal before the integration starts, since it does not depend on
the plant. Therefore every engine supports them.

A command u is held from one sample to the next (zero-order hold). Over a step from a to b its mean
is applied to the plant; its integral A is piecewise linear:

    (A(b) - A(a)) / (b - a),    A(t) = sum of u_i (t_{i+1} - t_i) up to t  (1)

Where a scenario states linear interpolation between samples, A is piecewise quadratic instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sims.core.effect import ActiveEffects, Effect, Input, Signal
from sims.core.simulator import Array, Indices, Scenario
from sims.engines.scenario_groups import ScenarioGroups
from sims.engines.time_grid import (
    Commands,
    TimeGrid,
    divide_intervals,
    get_command_times,
    get_history_times,
    is_active,
    pad_with_last,
    shifts_time,
)

MAX_LEAD_IN_STEP_SECONDS = 2e-3
"""Maximum step before the run in seconds, unless a step within the run is longer."""


def _get_command_values(scenario: Scenario, name: str, values: Array) -> Array:
    """Return the values (K + T,) of an input: K of its known history, and T in the run.

    Args:
        scenario: Scenario with the history.
        name: Name of the input.
        values: (T,) values in the run.
    """
    if name not in scenario.before:
        return values
    _, history = scenario.before[name]  # times and values
    return np.concatenate([history, values])


def compute_applied_inputs(
    plan: TimeGrid, runs: ScenarioGroups, commands: Commands, acting: ActiveEffects
) -> dict[str, Array]:
    """Return the applied inputs: the mean of each command over each step, changed by the effects.

    A command is held between recorded samples, and had its first value before the first sample,
    unless its history is known. Effects act on the first input; effects with memory begin at the
    start of the known history.

    Shapes: L batch elements, S steps, K coefficients of an effect.

    Args:
        plan: Time grid: steps of each batch element and their ends.
        runs: Scenarios of the batch elements.
        commands: Commanded inputs of each distinct scenario by name, each (T,) at T samples.
        acting: Input effects with their coefficients (K, L, 1), in the order in which the signal
            passes them.

    Returns:
        Applied inputs (L, S) by name.
    """
    # Effects whose coefficients are zero in all batch elements do nothing.
    effects = tuple((effect, c, is_active(c)) for effect, c in acting if c.any())
    starts, ends, steps = _step_begins(plan.ends), plan.ends, plan.steps
    # All scenarios have the same inputs; effects act on the first of them.
    input_name, *other_names = commands[0]
    # Inputs without effects: their means over the steps.
    applied = {}
    for name in other_names if effects else (input_name, *other_names):
        applied[name] = _average_command(runs, name, commands, starts, ends, plan.has_uniform_steps)
    if not effects:
        return applied
    # Effects with a memory need the steps before the run, too.
    largest_step = max(float(steps.max(initial=0.0)), MAX_LEAD_IN_STEP_SECONDS)
    lead_in = _build_lead_in_steps(runs, input_name, largest_step)
    _, lead_in_count = lead_in.steps.shape
    if lead_in_count:  # the steps before the run are put in front of those of the run
        starts, ends, steps = (
            np.hstack([lead_part[runs.scenario_index], run_part])
            for lead_part, run_part in zip(lead_in, (starts, ends, steps), strict=True)
        )
    step_ends = ends  # `ends` is shifted below
    # Backwards from the plant to the command: from the times at which a value is applied, find the
    # times at which it was commanded.
    for effect, c, is_acting in reversed(effects):
        assert isinstance(effect, Input)
        # Most effects do not shift time; skip them.
        if not shifts_time(effect):
            continue
        starts = np.where(is_acting, effect.times(c, starts), starts)
        ends = np.where(is_acting, effect.times(c, ends), ends)
    # Forwards with the values. Rows that share their memory (stride zero) are equal.
    has_uniform_steps = plan.has_uniform_steps or ends.strides[0] == 0
    means = _average_command(runs, input_name, commands, starts, ends, has_uniform_steps)
    for effect, c, is_acting in effects:
        # The first coefficient of such an effect is the share of the other interpolation: linear
        # for an input that is held between samples, and held for a linear one.
        if isinstance(effect, Input) and effect.between:
            other_means = _average_command(
                runs,
                input_name,
                commands,
                starts,
                ends,
                has_uniform_steps,
                is_other_interpolation=True,
            )
            means = np.where(is_acting, means + c[0] * (other_means - means), means)
    pairs = zip(runs.unique_scenarios, commands, strict=True)
    # The first value of the command, or of its history, also acts before it.
    initial_values = np.array(
        [_get_command_values(s, input_name, u[input_name])[0] for s, u in pairs]
    )
    result = _apply_input_effects(
        effects, steps, step_ends, means, initial_values[runs.scenario_index, None]
    )
    # The steps before the run only served the effects' memory.
    return {input_name: result[:, lead_in_count:], **applied}


class _LeadInSteps(NamedTuple):
    """Beginnings, ends and lengths (N, K) of the steps before the runs of N scenarios, s."""

    starts: Array
    ends: Array
    steps: Array


def _build_lead_in_steps(runs: ScenarioGroups, name: str, largest: float) -> _LeadInSteps:
    """Build the steps before the runs in which the history of an input is known.

    Effects with a memory, such as delay and lag, begin a run in the state that earlier commands
    caused, so they are evaluated in these steps, too. Nothing is simulated in them.

    Args:
        runs: Scenarios of the batch elements.
        name: Name of the input.
        largest: Maximum length of a step, s.

    Returns:
        Steps of each distinct scenario; their length is zero where the history is unknown, and
        there are none if no history is known.
    """
    history_times = [get_history_times(s, name) for s in runs.unique_scenarios]
    # The steps end at the beginning of the run.
    event_times = [np.append(times[times < 0], 0.0) for times in history_times]
    size = max(times.size for times in event_times)
    if size == 1:
        no_steps = np.empty((len(event_times), 0))
        return _LeadInSteps(no_steps, no_steps, no_steps)
    # Steps are divided from time zero on, so that times are counted from the first one.
    first = np.array([[times[0]] for times in event_times])
    steps, step_ends, _, _ = divide_intervals(
        np.stack([pad_with_last(times, size) for times in event_times]) - first, largest
    )
    step_ends = step_ends + first
    # A step begins where the previous one ends.
    return _LeadInSteps(np.hstack([first, step_ends[:, :-1]]), step_ends, steps)


def _apply_input_effects(
    effects: Sequence[tuple[Effect, Array, NDArray[np.bool_]]],
    steps: Array,
    ends: Array,
    means: Array,
    start: Array,
) -> Array:
    """Pass the means of the command through the effects on the input, one after the other.

    `Input.feel` computes the values that leave an effect from those that enter it. Steps of length
    zero only fill up rows of batch elements with fewer steps; they repeat the value of the step
    before them. The first value passes through the effects, too, since it is what the next effect
    has received before the first step.

    Shapes: L batch elements, S steps.

    Args:
        effects: Effects with their coefficients, and masks (L, 1) of the batch elements in which
            they are active.
        steps: (L, S) lengths of the steps, s.
        ends: (L, S) ends of the steps, s.
        means: (L, S) mean of the command over each step.
        start: (L, 1) first value of the command, which it also had before the first step.

    Returns:
        Applied values (L, S).
    """
    # Rows that share their memory (stride zero) are equal, so that one is enough.
    distinct_steps = steps[:1] if steps.strides[0] == 0 else steps
    # Index (L, S) of the step whose value holds in each step; None if no step has length zero.
    last_steps = None if (distinct_steps > 0).all() else _find_last_nonzero_step(steps)
    values = means.copy() if last_steps is None else np.take_along_axis(means, last_steps, axis=1)
    start = start.copy()
    for effect, c, is_acting in effects:
        assert isinstance(effect, Input)
        # An effect may be active in few of the batch elements; evaluate only these.
        elements = np.flatnonzero(is_acting)
        coefficients, begin = c[:, elements], start[elements]
        zeros = np.zeros_like(begin)  # lengths and ends of one step before the run
        signal = Signal(values[elements], steps[elements], begin, ends[elements])
        result = effect.feel(coefficients, signal)
        if last_steps is not None:
            result = np.take_along_axis(result, last_steps[elements], axis=1)
        values[elements] = result
        start[elements] = effect.feel(coefficients, Signal(begin, zeros, begin, zeros))
    return values


def _step_begins(ends: Array) -> Array:
    """Return the beginnings (L, S) of steps from their ends; memory is shared as in `ends`."""
    distinct_ends = ends[:1] if ends.strides[0] == 0 else ends
    start = np.zeros((len(distinct_ends), 1))
    starts = np.concatenate([start, distinct_ends[:, :-1]], axis=1)
    return np.broadcast_to(starts, ends.shape)


def _find_last_nonzero_step(steps: Array) -> Indices:
    """Return the index (L, S) of each step, or of the last step before it with nonzero length.

    The input does not change in steps of zero length, in which a batch element waits for others.

    Shapes: L batch elements, S steps.
    """
    step_numbers = np.arange(steps.shape[1])
    last_steps = np.where(steps > 0, step_numbers, 0)
    last: Indices = np.maximum.accumulate(last_steps, axis=1)
    return last


def _average_command(
    runs: ScenarioGroups,
    name: str,
    commands: Commands,
    starts: Array,
    ends: Array,
    has_uniform_steps: bool,
    is_other_interpolation: bool = False,
) -> Array:
    """Return the mean of each batch element's signal over each step.

    Between the times of commands, a signal is held or linear; see `Scenario.linear`.

    Shapes: L batch elements, S steps.

    Args:
        runs: Scenarios of the batch elements.
        name: Name of the input.
        commands: Inputs of each distinct scenario.
        starts: (L, S) beginnings of the steps, s.
        ends: (L, S) ends of the steps, s.
        has_uniform_steps: Whether batch elements with the same scenario have the same steps, so
            that only the first of them is evaluated.
        is_other_interpolation: Whether to interpolate held signals linearly, and to hold linear
            ones.

    Returns:
        Means (L, S).
    """
    count = len(commands) if has_uniform_steps else len(starts)
    averages = np.empty((count, starts.shape[1]))
    # Process all batch elements with the same scenario in one call. Sorting brings them together,
    # and the borders are where the next scenario begins.
    sorted_elements = np.argsort(runs.scenario_index, kind="stable")
    borders = np.flatnonzero(np.diff(runs.scenario_index[sorted_elements])) + 1
    for elements in np.split(sorted_elements, borders):
        run = runs.scenario_index[elements[0]]  # the same for all of these elements
        scenario = runs.unique_scenarios[run]
        is_linear = (name in scenario.linear) != is_other_interpolation
        average_signal = _average_linear_signal if is_linear else _average_held_signal
        target_rows, source_rows = elements, elements
        if has_uniform_steps:  # one row for the scenario, from its first element
            target_rows, source_rows = np.array([run]), elements[:1]
        instants = np.concatenate([get_history_times(scenario, name), get_command_times(scenario)])
        signal = _get_command_values(scenario, name, commands[run][name])
        averages[target_rows] = average_signal(
            instants, signal, starts[source_rows], ends[source_rows]
        )
    return runs.expand_rows(averages) if has_uniform_steps else averages


def _average_held_signal(times: Array, values: Array, starts: Array, end: Array) -> Array:
    """Return the means of a held signal over intervals; its value where an interval has no length.

    Shapes: T samples.

    The mean over (a, b) is (A(b) - A(a)) / (b - a) (1), with the integral A of the signal. The
    signal has its first value before the first sample, and its last value after the last one.

    Args:
        times: (T,) times from which the values hold, s.
        values: (T,) values.
        starts: Beginnings of the intervals, s, of any shape.
        end: Ends of the intervals, s, of the same shape.
    """
    # Indices of the samples that hold at the beginning of each interval, and just before its end.
    first = np.searchsorted(times, starts, side="right") - 1
    first = np.clip(first, 0, times.size - 1)
    value: Array = values[first]
    last = np.searchsorted(times, end, side="left") - 1
    last = np.clip(last, 0, times.size - 1)
    # Equation (1) only where the command changes within the interval; elsewhere its value is exact.
    crossing = last > first
    if crossing.any():
        areas = values[:-1] * np.diff(times)
        area = np.concatenate([[0.0], np.cumsum(areas)])
        a = starts[crossing]
        b = end[crossing]
        integral = _compute_held_integral(times, values, area, b) - _compute_held_integral(
            times, values, area, a
        )
        value[crossing] = integral / (b - a)  # (1)
    return value


def _average_linear_signal(times: Array, values: Array, starts: Array, end: Array) -> Array:
    """Return the means of a linearly interpolated signal over intervals.

    Shapes: T samples.

    The signal is constant before the first and after the last sample.

    The mean over (a, b) is (A(b) - A(a)) / (b - a) (1), with the integral A of the signal.

    Args:
        times: (T,) sample times, s.
        values: (T,) values.
        starts: Beginnings of the intervals, s, of any shape.
        end: Ends of the intervals, s, of the same shape.
    """
    halves = 0.5 * (values[:-1] + values[1:]) * np.diff(times)
    area = np.concatenate([[0.0], np.cumsum(halves)])
    value = np.interp(0.5 * (starts + end), times, values)
    # The mean over a part of one linear segment is its middle value; over several segments, (1).
    first = np.searchsorted(times, starts, side="right")
    crossing = np.searchsorted(times, end, side="left") > first
    if crossing.any():
        a, b = starts[crossing], end[crossing]
        integral = _compute_linear_integral(times, values, area, b) - _compute_linear_integral(
            times, values, area, a
        )
        value[crossing] = integral / (b - a)  # (1)
    result: Array = value
    return result


def _compute_linear_integral(times: Array, values: Array, area: Array, t: Array) -> Array:
    """Return the integral A(t) (1) of a signal that is interpolated linearly between samples.

    Shapes: T samples.

    The difference of A over a step, divided by its length, is the mean that the engine applies.

    Args:
        times: (T,) sample times, s.
        values: (T,) values.
        area: (T,) integral up to each of `times`.
        t: Times, s.
    """
    index = np.clip(np.searchsorted(times, t, side="right") - 1, 0, times.size - 1)
    value_at_t = np.interp(t, times, values)
    result: Array = area[index] + 0.5 * (values[index] + value_at_t) * (t - times[index])
    return result


def _compute_held_integral(times: Array, values: Array, area: Array, t: Array) -> Array:
    """Return the integral A(t) (1) of a signal that is held between samples.

    Shapes: T samples.

    The difference of A over a step, divided by its length, is the mean that the engine applies.

    A(t) is the sum of u_i (t_{i+1} - t_i) up to t (1).

    Args:
        times: (T,) sample times, s.
        values: (T,) values.
        area: (T,) integral up to each of `times`.
        t: Times, s.
    """
    index = np.searchsorted(times, t, side="right") - 1
    index = np.clip(index, 0, times.size - 1)
    result: Array = area[index] + values[index] * (t - times[index])
    return result
