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

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sims.core.effect import ActiveEffects, Effect, Input, Sensor
from sims.core.simulator import Array, Indices, Scenario
from sims.engines.scenario_groups import ScenarioGroups

_ROUNDING_SHARE = 1e-6
"""Fraction of a step by which an interval may exceed an integer number of steps."""
TIME_TOLERANCE = 1e-6
"""Largest deviation of sample times from the engine's steps, as a fraction of an interval.

Recordings round their time stamps.
"""


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

    def compute_state_times(self, steps_per_state: int) -> Array:
        """Return the times (L, R) since the start of the run at which the engine stores states, s.

        Shapes: L batch elements, R stored states.

        The first of them is zero, the time of the initial state.

        Args:
            steps_per_state: Number of steps from one stored state to the next.
        """
        start = np.zeros((len(self.ends), 1))
        return np.concatenate([start, self.ends[:, steps_per_state - 1 :: steps_per_state]], axis=1)


Commands = Sequence[Mapping[str, Array]]
"""Commanded inputs of each distinct scenario by name, each (T,)."""


def build_time_grid(
    runs: ScenarioGroups, commands: Commands, effects: ActiveEffects, largest_step: float
) -> TimeGrid:
    """Build steps through all times at which a sample is taken or a changed command is applied.

    Without effects that shift time, and without offsets between inputs and samples, commands change
    at samples only, so that the steps depend on the scenario alone. A sample before the start shows
    the initial state. Shorter runs wait at their end, in steps of zero length.

    Args:
        runs: Scenarios of the batch elements.
        commands: Inputs of each distinct scenario.
        effects: Effects on input and sensors.
        largest_step: Maximum length of a step, s.

    Returns:
        The steps of each batch element, and the number of the stored state for each sample.
    """
    # (N, T) sample times since the start of each of N distinct scenarios.
    samples = max(s.times.size for s in runs.unique_scenarios)
    instants = np.stack([pad_with_last(_sample_times(s), samples) for s in runs.unique_scenarios])
    shifting = [(e, c) for e, c in effects if c.any() and shifts_time(e)]
    if not shifting and not any(s.offset for s in runs.unique_scenarios):
        # Scenarios with the same sample times share one row and everything computed from it.
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
    # From here on, one row for each batch element, since effects differ between them.
    instants = instants[runs.scenario_index]
    for effect, c in shifting:
        if isinstance(effect, Sensor):
            instants = np.where(is_active(c), effect.times(c, instants), instants)
    # Times must increase and begin with the run, whatever an effect returns.
    instants = np.maximum(instants, 0.0)
    instants = np.maximum.accumulate(instants, axis=1)
    changes = _find_change_times(runs, commands, shifting)
    event_times = np.concatenate([instants, changes], axis=1)
    event_times = np.clip(event_times, 0.0, instants[:, -1:])  # within the run
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

    Shapes: L batch elements, at most K changes of all inputs.

    With a shift to the time s(t), the change commanded at t is applied at t + (t - s(t)) (1).

    Args:
        runs: scenarios of the batch elements.
        commands: values of each input, by name, of each distinct scenario.
        shifting: effects that shift time, with their coefficients.
    """
    columns = []
    for index, name in enumerate(commands[0]):  # all scenarios have the same inputs
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

    All steps of a batch element are stored in blocks with the same number of steps, after each of
    which the engine stores a state. This number is the most frequent one of the steps that an
    interval needs; steps of zero length fill the last block of an interval. For example, if most
    intervals need 4 steps, an interval with 5 has two blocks, whose last three steps are zero.

    Shapes: N batch elements, S steps, T times.

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
    blocks = -(-steps_per_interval // steps_per_block)  # blocks of each interval, rounded up
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
    # The state is stored after each block, so the number of blocks is that of the stored state.
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
    times, _ = scenario.before[name]  # and values
    history_times: Array = times + scenario.offset
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


def equalise_steps(steps: Array, steps_per_sample: int) -> Array:
    """Return equal steps if the given ones differ only by rounding.

    A change of the step size costs an engine more than a step.

    Shapes: S steps.

    Args:
        steps: (S,) step sizes in seconds, > 0.
        steps_per_sample: number of steps from one sample to the next.

    Returns:
        The steps (S,), equal or unchanged.
    """
    if not steps.size:
        return steps
    # The error of the sample times is compared, not that of each step, because errors of rounded
    # time stamps do not add up.
    mean_step = math.fsum(steps) / steps.size
    equal_times = mean_step * np.arange(1, steps.size + 1)
    largest_deviation = np.abs(np.cumsum(steps) - equal_times).max()
    are_equal = largest_deviation <= TIME_TOLERANCE * mean_step * steps_per_sample
    return np.full(steps.size, mean_step) if are_equal else steps
