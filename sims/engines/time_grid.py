"""Integration time grid and applied inputs of many batch elements.

Effects that shift time (a sensor's delay, a skewed clock) move the times at which the system is
sampled. Effects on the input change the signal before the integration starts, since it does not
depend on the plant. Therefore every engine supports them. The result of a batch element does not
depend on the others, except for steps of zero length in which it waits for them.

A command u is held from one sample to the next (zero-order hold). Over a step from a to b its mean
is applied to the plant; its integral A is piecewise linear:

    (A(b) - A(a)) / (b - a),    A(t) = sum of u_i (t_{i+1} - t_i) up to t  (1)

Where a scenario states linear interpolation between samples, A is piecewise quadratic instead.

With an effect that shifts time, the command of the time s(t) is applied at t. The change commanded
at t is then applied at

    t + (t - s(t))                                                         (2)

This is exact if the shift is equal at both times, as for a delay, and a good approximation if it
changes slowly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sims.core.effect import ActiveEffects, Effect, Input, Sensor, Signal
from sims.core.simulator import Array, Indices, Scenario

_ROUNDING_SHARE = 1e-6
"""Fraction of a step by which an interval may exceed an integer number of steps."""

MAX_LEAD_IN_STEP_SECONDS = 2e-3
"""Maximum step before the run in seconds, unless a step within the run is longer."""

Number = TypeVar("Number", np.float64, np.intp)


@dataclass(frozen=True)
class TimeGrid:
    """Time grid: the steps of all batch elements.

    Attributes:
        steps: (L, S) lengths of the steps, s; S is a multiple of `steps_per_sample`. Batch elements
            may share memory.
        ends: (L, S) time since the start of the run at the end of each step, s.
        steps_per_sample: Number of steps after which the state is stored; the initial state is
            stored first.
        rows: (L, T) number of the stored state for each sample.
        has_uniform_steps: Whether batch elements with the same scenario have the same steps.
    """

    steps: Array
    ends: Array
    steps_per_sample: int
    rows: Indices
    has_uniform_steps: bool = False


@dataclass(frozen=True)
class ScenarioGroups:
    """Scenarios of batch elements, grouped if they are equal.

    Attributes:
        unique_scenarios: Scenarios that differ in their times or inputs.
        scenario_index: (L,) number of the distinct scenario of each batch element.
    """

    unique_scenarios: tuple[Scenario, ...]
    scenario_index: Indices

    def expand_rows(self, rows: NDArray[Number]) -> NDArray[Number]:
        """Expand rows (N, ...) of the distinct scenarios to rows (L, ...) of the batch elements.

        A single row is broadcast and shares memory.
        """
        if len(rows) == 1:
            return np.broadcast_to(rows, (self.scenario_index.size, *rows.shape[1:]))
        return rows[self.scenario_index]


def group_scenarios(scenarios: Sequence[Scenario], by_initial: bool = False) -> ScenarioGroups:
    """Group scenarios with the same times and inputs.

    Inputs and time steps are computed once for each group, not for each batch element.

    Args:
        scenarios: Scenario of each batch element.
        by_initial: Whether grouped scenarios must also state the same initial states.
    """
    # Compare objects first, because comparing the contents of each scenario is slow.
    objects, object_index = group_by_identity(scenarios)
    by_content: dict[object, int] = {}
    distinct: list[Scenario] = []
    groups = []
    for scenario in objects:
        signals = sorted(scenario.inputs.items())
        input_histories = tuple((name, u.tobytes()) for name, u in sorted(scenario.before.items()))
        interpretation = tuple(sorted(scenario.linear)), scenario.offset, input_histories
        initial_states = tuple(sorted(scenario.initial.items())) if by_initial else ()
        signals_content = ((name, u.tobytes()) for name, u in signals)
        off_masks = tuple((name, mask.tobytes()) for name, mask in sorted(scenario.off.items()))
        content = (
            scenario.times.tobytes(),
            interpretation,
            initial_states,
            off_masks,
            *signals_content,
        )
        group = by_content.setdefault(content, len(distinct))
        if group == len(distinct):
            distinct.append(scenario)
        groups.append(group)
    return ScenarioGroups(tuple(distinct), np.array(groups, dtype=np.intp)[object_index])


def group_by_identity(scenarios: Sequence[Scenario]) -> tuple[list[Scenario], Indices]:
    """Return the distinct objects among scenarios, and the number of each element's object (L,)."""
    # One dictionary lookup per batch element, of which there may be thousands.
    objects = {id(scenario): scenario for scenario in scenarios}
    index = {key: i for i, key in enumerate(objects)}
    object_index = np.array([index[id(scenario)] for scenario in scenarios], dtype=np.intp)
    return list(objects.values()), object_index


Commands = Sequence[Mapping[str, Array]]
"""Commanded inputs of each distinct scenario by name, each (T,)."""


def build_time_grid(
    runs: ScenarioGroups, commands: Commands, effects: ActiveEffects, largest_step: float
) -> TimeGrid:
    """Build steps through all times at which a sample is taken or a changed command is applied.

    A sample before the start shows the initial state. Shorter runs wait at their end.

    Args:
        runs: Scenarios of the batch elements.
        commands: Inputs of each distinct scenario.
        effects: Effects on input and sensors.
        largest_step: Maximum length of a step, s.
    """
    samples = max(s.times.size for s in runs.unique_scenarios)
    instants = np.stack([_pad_with_last(_sample_times(s), samples) for s in runs.unique_scenarios])
    shifting = [(e, c) for e, c in effects if c.any() and _shifts_time(e)]
    if not shifting and not any(s.offset for s in runs.unique_scenarios):
        # Runs with the same sample times share one row and everything computed from it.
        if (instants == instants[:1]).all():
            instants = instants[:1]
        steps, step_ends, steps_per_sample, rows = _divide_intervals(instants, largest_step)
        return TimeGrid(
            runs.expand_rows(steps),
            runs.expand_rows(step_ends),
            steps_per_sample,
            runs.expand_rows(rows),
            has_uniform_steps=True,
        )
    instants = instants[runs.scenario_index]
    for effect, c in shifting:
        if isinstance(effect, Sensor):
            instants = np.where(is_active(c), effect.times(c, instants), instants)
    # Times must increase and begin with the run, whatever an effect returns.
    instants = np.maximum(instants, 0.0)
    instants = np.maximum.accumulate(instants, axis=1)
    changes = _find_change_times(runs, commands, shifting)
    event_times = np.concatenate([instants, changes], axis=1)
    event_times = np.clip(event_times, 0.0, instants[:, -1:])
    order = np.argsort(event_times, axis=1, kind="stable")
    event_times = np.take_along_axis(event_times, order, axis=1)
    steps, step_ends, steps_per_sample, rows = _divide_intervals(event_times, largest_step)
    # Rows in the original order of the marks, of which the first are samples.
    sample_rows = np.empty_like(rows)
    np.put_along_axis(sample_rows, order, rows, axis=1)
    return TimeGrid(steps, step_ends, steps_per_sample, sample_rows[:, :samples])


def _find_change_times(
    runs: ScenarioGroups, commands: Commands, shifting: Sequence[tuple[Effect, Array]]
) -> Array:
    """Return the times (L, K) at which a changed command is applied; zero where there are fewer."""
    columns = []
    for index, name in enumerate(commands[0]):
        change_times = []
        for s, u in zip(runs.unique_scenarios, commands, strict=True):
            changed = np.diff(u[name]) != 0
            command_times = np.maximum(_get_command_times(s)[1:], 0.0)
            # Commands from before the run may be applied within it.
            change_times.append(
                np.concatenate([_get_history_times(s, name), command_times[changed]])
            )
        size = max(row.size for row in change_times)
        padded = [np.concatenate([row, np.zeros(size - row.size)]) for row in change_times]
        applied = np.stack(padded)[runs.scenario_index]
        # Effects act on the first input only.
        for effect, c in shifting if index == 0 else ():
            if isinstance(effect, Input):
                commanded = effect.times(c, applied)
                applied = np.where(is_active(c), applied + (applied - commanded), applied)  # (2)
        columns.append(applied)
    if not columns:
        return np.zeros((runs.scenario_index.size, 0))
    return np.concatenate(columns, axis=1)


def _divide_intervals(instants: Array, largest_step: float) -> tuple[Array, Array, int, Indices]:
    """Divide the intervals between times into equal steps.

    The steps are arranged in blocks of the most frequent number of steps per interval; steps of
    zero length fill the last block of an interval. The steps of a batch element do not depend on
    others.

    Args:
        instants: (N, T) times since the start, s.
        largest_step: Maximum length of a step, s.

    Returns:
        Steps (N, S), their ends (N, S), the number of steps per stored state, and the number of the
        stored state at each time (N, T).
    """
    elements, samples = instants.shape
    start = np.zeros((elements, 1))
    interval_starts = np.concatenate([start, instants[:, :-1]], axis=1)
    intervals = instants - interval_starts
    # Tolerate rounding where an interval is an integer number of steps.
    parts = np.ceil(intervals / largest_step - _ROUNDING_SHARE).astype(np.intp)
    parts = np.where(intervals > 0, np.maximum(parts, 1), 0)
    steps_per_block = int(np.bincount(parts[parts > 0]).argmax()) if parts.any() else 1
    blocks = -(-parts // steps_per_block)
    block_ends = np.cumsum(blocks, axis=1)
    max_blocks = max(int(block_ends[:, -1].max()), 1)
    # Arrays with one entry per block: its interval, its number in the batch element, and the
    # numbers of its steps in the interval.
    interval = np.repeat(np.arange(elements * samples), blocks.ravel())
    element = interval // samples
    element_blocks = block_ends[:, -1]
    first_blocks = np.cumsum(element_blocks) - element_blocks
    block = np.arange(interval.size) - first_blocks[element]
    blocks_before = (block_ends - blocks).ravel()[interval]
    block_in_interval = (block - blocks_before)[:, None]
    step_numbers = block_in_interval * steps_per_block + np.arange(steps_per_block)
    step_counts = parts.ravel()[interval, None]
    step_lengths = intervals.ravel()[interval, None] / step_counts
    steps = np.zeros((elements, max_blocks, steps_per_block))
    step_ends = np.repeat(instants[:, -1], max_blocks * steps_per_block).reshape(
        elements, max_blocks, steps_per_block
    )
    steps[element, block] = np.where(step_numbers < step_counts, step_lengths, 0.0)
    # The last step of an interval ends exactly at the given time.
    inner_times = interval_starts.ravel()[interval, None] + (step_numbers + 1) * step_lengths
    interval_ends = instants.ravel()[interval, None]
    step_ends[element, block] = np.where(step_numbers + 1 < step_counts, inner_times, interval_ends)
    return steps.reshape(elements, -1), step_ends.reshape(elements, -1), steps_per_block, block_ends


def _sample_times(scenario: Scenario) -> Array:
    """Return the sample times (T,) since the first sample, s."""
    seconds: Array = scenario.times - scenario.times[0]
    return seconds


def _get_command_times(scenario: Scenario) -> Array:
    """Return the times (T,) since the first sample at which inputs change, s."""
    seconds: Array = _sample_times(scenario) + scenario.offset
    return seconds


def _get_history_times(scenario: Scenario, name: str) -> Array:
    """Return the times (K,) of an input's known history before the run, s."""
    if name not in scenario.before:
        return np.empty(0)
    history_times: Array = scenario.before[name][0] + scenario.offset
    return history_times


def _get_command_values(scenario: Scenario, name: str, values: Array) -> Array:
    """Return the values (K + T,) of an input, including its known history before the run.

    Args:
        scenario: Scenario with the history.
        name: Name of the input.
        values: (T,) values in the run.
    """
    if name not in scenario.before:
        return values
    return np.concatenate([scenario.before[name][1], values])


def _pad_with_last(values: Array, size: int) -> Array:
    """Repeat the last of `values` up to the given size."""
    padding = np.full(size - values.size, values[-1])
    return np.concatenate([values, padding])


def compute_applied_inputs(
    plan: TimeGrid, runs: ScenarioGroups, commands: Commands, acting: ActiveEffects
) -> dict[str, Array]:
    """Return the applied inputs: the mean of each command over each step, changed by the effects.

    A command is held between recorded samples, and had its first value before the first sample,
    unless its history is known. Effects act on the first input; effects with memory begin at the
    start of the known history.

    Args:
        plan: Time grid.
        runs: Scenarios of the batch elements.
        commands: Inputs of each distinct scenario.
        acting: Input effects in the order in which the signal passes them.

    Returns:
        Applied inputs (L, S) by name.
    """
    effects = tuple((effect, c, is_active(c)) for effect, c in acting if c.any())
    starts, ends, steps = _step_begins(plan.ends), plan.ends, plan.steps
    input_name, *other_names = commands[0]
    applied = {}
    for name in other_names if effects else (input_name, *other_names):
        applied[name] = _average_command(runs, name, commands, starts, ends, plan.has_uniform_steps)
    if not effects:
        return applied
    lead_in = _build_lead_in_steps(
        runs, input_name, max(float(steps.max(initial=0.0)), MAX_LEAD_IN_STEP_SECONDS)
    )
    if lead_in[0].size:
        parts = zip(lead_in, (starts, ends, steps), strict=True)
        starts, ends, steps = (
            np.hstack([lead_part[runs.scenario_index], run_part]) for lead_part, run_part in parts
        )
    step_ends = ends
    # Backwards from the plant to the command: map the times through the effects.
    for effect, c, is_acting in reversed(effects):
        assert isinstance(effect, Input)
        # Most effects do not shift time; skip them.
        if not _shifts_time(effect):
            continue
        starts = np.where(is_acting, effect.times(c, starts), starts)
        ends = np.where(is_acting, effect.times(c, ends), ends)
    # Forwards with the values. Rows that share their memory are equal.
    has_uniform_steps = plan.has_uniform_steps or ends.strides[0] == 0
    means = _average_command(runs, input_name, commands, starts, ends, has_uniform_steps)
    for effect, c, is_acting in effects:
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
    initial_values = np.array(
        [_get_command_values(s, input_name, u[input_name])[0] for s, u in pairs]
    )
    result = _apply_input_effects(
        effects, steps, step_ends, means, initial_values[runs.scenario_index, None]
    )
    return {input_name: result[:, lead_in[0].shape[1] :], **applied}


def _build_lead_in_steps(
    runs: ScenarioGroups, name: str, largest: float
) -> tuple[Array, Array, Array]:
    """Build the steps before the runs in which the history of an input is known.

    Args:
        runs: Scenarios of the batch elements.
        name: Name of the input.
        largest: Maximum length of a step, s.

    Returns:
        Beginnings, ends and lengths (N, K) of the steps, s; the length is zero where the history is
        unknown.
    """
    event_times = [_get_history_times(s, name) for s in runs.unique_scenarios]
    event_times = [np.append(row[row < 0], 0.0) for row in event_times]
    size = max(row.size for row in event_times)
    if size == 1:
        no_steps = np.empty((len(event_times), 0))
        return no_steps, no_steps, no_steps
    first = np.array([[row[0]] for row in event_times])
    steps, step_ends, _, _ = _divide_intervals(
        np.stack([_pad_with_last(row, size) for row in event_times]) - first, largest
    )
    step_ends = step_ends + first
    return np.hstack([first, step_ends[:, :-1]]), step_ends, steps


def _apply_input_effects(
    effects: Sequence[tuple[Effect, Array, NDArray[np.bool_]]],
    steps: Array,
    ends: Array,
    means: Array,
    start: Array,
) -> Array:
    """Pass the means of the command through the effects on the input.

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
    distinct_steps = steps[:1] if steps.strides[0] == 0 else steps
    last_steps = None if (distinct_steps > 0).all() else _find_last_nonzero_step(steps)
    values = means.copy() if last_steps is None else np.take_along_axis(means, last_steps, axis=1)
    start = start.copy()
    for effect, c, is_acting in effects:
        assert isinstance(effect, Input)
        # An effect may be active in few of the batch elements; evaluate only these.
        elements = np.flatnonzero(is_acting)
        coefficients, begin = c[:, elements], start[elements]
        zeros = np.zeros_like(begin)
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
    """Return the number (L, S) of each step, or of the last step before it with nonzero length.

    The input does not change while a batch element waits.
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
    result = np.empty((count, starts.shape[1]))
    # Process all batch elements with the same scenario in one call.
    order = np.argsort(runs.scenario_index, kind="stable")
    borders = np.flatnonzero(np.diff(runs.scenario_index[order])) + 1
    for elements in np.split(order, borders):
        run = runs.scenario_index[elements[0]]
        scenario = runs.unique_scenarios[run]
        average_signal = (
            _average_linear_signal
            if (name in scenario.linear) != is_other_interpolation
            else _average_held_signal
        )
        target_rows, source_rows = (
            (slice(run, run + 1), elements[:1]) if has_uniform_steps else (elements, elements)
        )
        instants = np.concatenate(
            [_get_history_times(scenario, name), _get_command_times(scenario)]
        )
        signal = _get_command_values(scenario, name, commands[run][name])
        result[target_rows] = average_signal(
            instants, signal, starts[source_rows], ends[source_rows]
        )
    return runs.expand_rows(result) if has_uniform_steps else result


def _average_held_signal(times: Array, values: Array, starts: Array, end: Array) -> Array:
    """Return the means of a held signal over intervals; its value where an interval has no length.

    Args:
        times: (T,) times from which the values hold, s.
        values: (T,) values.
        starts: Beginnings of the intervals, s.
        end: Ends of the intervals, s.
    """
    index = np.searchsorted(times, starts, side="right") - 1
    index = np.clip(index, 0, times.size - 1)
    value: Array = values[index]
    last = np.searchsorted(times, end, side="left") - 1
    last = np.clip(last, 0, times.size - 1)
    # Equation (1) only where the command changes within the interval; elsewhere its value is exact.
    crossing = last > index
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

    The signal is constant before the first and after the last sample.

    Args:
        times: (T,) sample times, s.
        values: (T,) values.
        starts: Beginnings of the intervals, s.
        end: Ends of the intervals, s.
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

    The difference of A over a step, divided by its length, is the mean that the engine applies.

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


def _shifts_time(effect: Effect) -> bool:
    """Return whether an effect shifts time, that is, overrides `times`."""
    if not isinstance(effect, (Input, Sensor)):
        return False
    return type(effect).times not in (Input.times, Sensor.times)


def is_active(c: Array) -> NDArray[np.bool_]:
    """Return the mask (L, 1) of batch elements in which coefficients (K, L, 1) are not all zero."""
    result: NDArray[np.bool_] = (c != 0).any(axis=0)
    return result
