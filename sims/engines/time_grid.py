"""Integration time grid of many batch elements.

Effects that shift time (a sensor's delay, a skewed clock) move the times at which the system is
sampled. The result of a batch element does not depend on the others, except for steps of zero
length in which it waits for them.

With an effect that shifts time, the command of the time s(t) is applied at t. The change commanded
at t is then applied at

    t + (t - s(t))                                                         (1)

This is exact if the shift is equal at both times, as for a delay, and a good approximation if it
changes slowly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sims.core.effect import ActiveEffects, Effect, Input, Sensor
from sims.core.simulator import Array, Indices, Scenario

_ROUNDING_SHARE = 1e-6
"""Fraction of a step by which an interval may exceed an integer number of steps."""


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
        contents: Hashable content of each distinct scenario; empty if unknown.
    """

    unique_scenarios: tuple[Scenario, ...]
    scenario_index: Indices
    contents: tuple[object, ...] = ()

    @property
    def one_each(self) -> ScenarioGroups:
        """Groups of the distinct scenarios with one batch element each."""
        count = len(self.unique_scenarios)
        return ScenarioGroups(self.unique_scenarios, np.arange(count), self.contents)

    def expand_rows(self, rows: NDArray[Number]) -> NDArray[Number]:
        """Expand rows (N, ...) of the distinct scenarios to rows (L, ...) of the batch elements.

        Equal rows that share memory are broadcast.
        """
        if len(rows) == 1 or rows.strides[0] == 0:
            rows = rows[:1]
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
    group_by_content: dict[object, int] = {}
    distinct: list[Scenario] = []
    group_by_object = []
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
        group = group_by_content.setdefault(content, len(distinct))
        if group == len(distinct):
            distinct.append(scenario)
        group_by_object.append(group)
    index = np.array(group_by_object, dtype=np.intp)[object_index]
    return ScenarioGroups(tuple(distinct), index, tuple(group_by_content))


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
    instants = np.stack([pad_with_last(_sample_times(s), samples) for s in runs.unique_scenarios])
    shifting = [(e, c) for e, c in effects if c.any() and shifts_time(e)]
    if not shifting and not any(s.offset for s in runs.unique_scenarios):
        # Runs with the same sample times share one row and everything computed from it.
        if (instants == instants[:1]).all():
            instants = instants[:1]
        steps, step_ends, steps_per_sample, rows = divide_intervals(instants, largest_step)
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
    steps, step_ends, steps_per_sample, rows = divide_intervals(event_times, largest_step)
    # Rows in the original order of the event times, of which the first are samples.
    sample_rows = np.empty_like(rows)
    np.put_along_axis(sample_rows, order, rows, axis=1)
    return TimeGrid(steps, step_ends, steps_per_sample, sample_rows[:, :samples])


def _find_change_times(
    runs: ScenarioGroups, commands: Commands, shifting: Sequence[tuple[Effect, Array]]
) -> Array:
    """Return the times (L, K) at which a changed command is applied; zero where there are fewer.

    Shapes: L batch elements.

    With a shift to the time s(t), the change commanded at t is applied at t + (t - s(t)) (1).

    Args:
        runs: scenarios of the batch elements.
        commands: values of each input, by name, of each distinct scenario.
        shifting: effects that shift time, with their coefficients.
    """
    columns = []
    for index, name in enumerate(commands[0]):
        change_times = []
        for s, u in zip(runs.unique_scenarios, commands, strict=True):
            changed = np.diff(u[name]) != 0
            command_times = np.maximum(get_command_times(s)[1:], 0.0)
            # Commands from before the run may be applied within it.
            change_times.append(
                np.concatenate([get_history_times(s, name), command_times[changed]])
            )
        size = max(row.size for row in change_times)
        padded = [np.concatenate([row, np.zeros(size - row.size)]) for row in change_times]
        applied = np.stack(padded)[runs.scenario_index]
        # Effects act on the first input only.
        for effect, c in shifting if index == 0 else ():
            if isinstance(effect, Input):
                commanded = effect.times(c, applied)
                applied = np.where(is_active(c), applied + (applied - commanded), applied)  # (1)
        columns.append(applied)
    if not columns:
        return np.zeros((runs.scenario_index.size, 0))
    return np.concatenate(columns, axis=1)


def divide_intervals(instants: Array, largest_step: float) -> tuple[Array, Array, int, Indices]:
    """Divide the intervals between times into equal steps.

    The steps are arranged in blocks of the most frequent number of steps per interval; steps of
    zero length fill the last block of an interval. The steps of a batch element do not depend on
    others.

    Shapes: S steps, T samples.

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
    steps_per_interval = np.ceil(intervals / largest_step - _ROUNDING_SHARE).astype(np.intp)
    steps_per_interval = np.where(intervals > 0, np.maximum(steps_per_interval, 1), 0)
    steps_per_block = (
        int(np.bincount(steps_per_interval[steps_per_interval > 0]).argmax())
        if steps_per_interval.any()
        else 1
    )
    blocks = -(-steps_per_interval // steps_per_block)
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
    step_counts = steps_per_interval.ravel()[interval, None]
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


def get_command_times(scenario: Scenario) -> Array:
    """Return the times (T,) since the first sample at which inputs change, s."""
    seconds: Array = _sample_times(scenario) + scenario.offset
    return seconds


def get_history_times(scenario: Scenario, name: str) -> Array:
    """Return the times (K,) of an input's known history before the run, s."""
    if name not in scenario.before:
        return np.empty(0)
    history_times: Array = scenario.before[name][0] + scenario.offset
    return history_times


def pad_with_last(values: Array, size: int) -> Array:
    """Repeat the last of `values` up to the given size."""
    padding = np.full(size - values.size, values[-1])
    return np.concatenate([values, padding])


def shifts_time(effect: Effect) -> bool:
    """Return whether an effect shifts time, that is, overrides `times`."""
    if not isinstance(effect, (Input, Sensor)):
        return False
    return type(effect).times not in (Input.times, Sensor.times)


def is_active(c: Array) -> NDArray[np.bool_]:
    """Return the mask (L, 1) of batch elements in which coefficients (K, L, 1) are not all zero."""
    result: NDArray[np.bool_] = (c != 0).any(axis=0)
    return result
