"""When a simulation steps, and what its plant feels: sample instants, steps and inputs of many
lanes at once.

Effects that shift time (a sensor's delay, a skewed clock) move the instants at which the world is
sampled; effects on the input change the signal before the integration starts, since it does not
depend on the plant. So every engine has them. What a lane gets does not depend on the others, but
for steps of no length in which it waits for them.

A command u holds its value from one sample to the next. Over a step from a to b the plant feels its
mean, of which the integral A is piecewise linear:

    (A(b) - A(a)) / (b - a),    A(t) = sum of u_i (t_{i+1} - t_i) up to t  (1)

Where a scenario says that it goes straight from sample to sample, A is made of parabolas instead.

An effect that shifts time feels at t what was commanded at s(t); the change commanded at t is then
felt at

    t + (t - s(t))                                                         (2)

which is right where the shift is the same at both instants, as it is for a delay, and all but
right for one that hardly changes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sims.base import Array, Scenario
from sims.system import Acting, Effect, Input, Sensor, Signal

_ROUNDING = 1e-6
"""Share of a step by which an interval may exceed a whole number of steps."""

FINE = 2e-3
"""Seconds of a step before the run, where no step within it is longer."""

Indices = NDArray[np.intp]
Number = TypeVar("Number", np.float64, np.intp)


@dataclass(frozen=True)
class Plan:
    """The steps of all lanes.

    Attributes:
        steps: (L, S) lengths, seconds; S is a multiple of `every`. Lanes may share memory.
        ends: (L, S) seconds since the start of the run at the end of each step.
        every: after this many steps the state is kept; the initial state is kept first.
        rows: (L, T) which of the kept states each sample shows.
        alike: whether lanes of one run make the same steps.
    """

    steps: Array
    ends: Array
    every: int
    rows: Indices
    alike: bool = False


@dataclass(frozen=True)
class Runs:
    """Scenarios of lanes, of which many may be the same.

    Attributes:
        distinct: scenarios that differ in their times or inputs.
        of: (L,) which of them each lane has.
    """

    distinct: tuple[Scenario, ...]
    of: Indices

    def spread(self, rows: NDArray[Number]) -> NDArray[Number]:
        """Rows (N, ...) of the distinct scenarios as rows of the lanes; one row is that of all, and
        shares memory.
        """
        if len(rows) == 1:
            return np.broadcast_to(rows, (self.of.size, *rows.shape[1:]))
        return rows[self.of]


def make_runs(scenarios: Sequence[Scenario], by_initial: bool = False) -> Runs:
    """Group scenarios (one a lane) with the same times and inputs.

    Args:
        scenarios: of the lanes.
        by_initial: whether the initial states that they state are to be the same, too.
    """
    # Told apart by object first: comparing contents costs more than most lanes' share of a step.
    objects, of = by_object(scenarios)
    by_content: dict[object, int] = {}
    distinct: list[Scenario] = []
    groups = []
    for scenario in objects:
        signals = sorted(scenario.inputs.items())
        earlier = tuple((name, u.tobytes()) for name, u in sorted(scenario.before.items()))
        read = tuple(sorted(scenario.linear)), scenario.offset, earlier
        stated = tuple(sorted(scenario.initial.items())) if by_initial else ()
        told = ((name, u.tobytes()) for name, u in signals)
        off = tuple((name, mask.tobytes()) for name, mask in sorted(scenario.off.items()))
        content = scenario.times.tobytes(), read, stated, off, *told
        group = by_content.setdefault(content, len(distinct))
        if group == len(distinct):
            distinct.append(scenario)
        groups.append(group)
    return Runs(tuple(distinct), np.array(groups, dtype=np.intp)[of])


def by_object(scenarios: Sequence[Scenario]) -> tuple[list[Scenario], Indices]:
    """The different objects among scenarios (one a lane), and which of them each lane has (L,)."""
    # A lane costs one look into a dictionary, and there may be thousands.
    objects = {id(scenario): scenario for scenario in scenarios}
    place = {key: i for i, key in enumerate(objects)}
    of = np.array([place[id(scenario)] for scenario in scenarios], dtype=np.intp)
    return list(objects.values()), of


Commands = Sequence[Mapping[str, Array]]
"""Commanded inputs of each distinct scenario by name, each (T,)."""


def make_plan(runs: Runs, commands: Commands, acting: Acting, largest_step: float) -> Plan:
    """Steps through every instant at which a sample is taken or a changed command felt.

    A sample that would be taken before the start shows the initial state. Shorter runs wait at
    their end.

    Args:
        runs: scenarios of the lanes.
        commands: inputs of each distinct scenario.
        acting: effects on input and sensors.
        largest_step: no step is longer, in seconds.
    """
    samples = max(s.times.size for s in runs.distinct)
    instants = np.stack([_padded(_since_start(s), samples) for s in runs.distinct])
    shifting = [(e, c) for e, c in acting if c.any() and _shifts(e)]
    if not shifting and not any(s.offset for s in runs.distinct):
        # Runs with the same instants share one row, and all that is computed from it.
        if (instants == instants[:1]).all():
            instants = instants[:1]
        steps, ends, every, rows = _divided(instants, largest_step)
        return Plan(runs.spread(steps), runs.spread(ends), every, runs.spread(rows), alike=True)
    instants = instants[runs.of]
    for effect, c in shifting:
        if isinstance(effect, Sensor):
            instants = np.where(acts(c), effect.times(c, instants), instants)
    # Time never runs backwards, whatever an effect makes of it, and begins with the run.
    instants = np.maximum(instants, 0.0)
    instants = np.maximum.accumulate(instants, axis=1)
    changes = _changes(runs, commands, shifting)
    marks = np.concatenate([instants, changes], axis=1)
    marks = np.clip(marks, 0.0, instants[:, -1:])
    order = np.argsort(marks, axis=1, kind="stable")
    marks = np.take_along_axis(marks, order, axis=1)
    steps, ends, every, rows = _divided(marks, largest_step)
    # The rows of the sorted marks back in the order of the marks, of which the first are samples.
    back = np.empty_like(rows)
    np.put_along_axis(back, order, rows, axis=1)
    return Plan(steps, ends, every, back[:, :samples])


def _changes(runs: Runs, commands: Commands, shifting: Sequence[tuple[Effect, Array]]) -> Array:
    """Instants (L, K) at which a changed command is felt; zero where a lane has fewer."""
    columns = []
    for place, name in enumerate(commands[0]):
        rows = []
        for s, u in zip(runs.distinct, commands, strict=True):
            changed = np.diff(u[name]) != 0
            later = np.maximum(_commanded(s)[1:], 0.0)
            # What was commanded before the run may be felt within it.
            rows.append(np.concatenate([_earlier(s, name), later[changed]]))
        size = max(row.size for row in rows)
        padded = [np.concatenate([row, np.zeros(size - row.size)]) for row in rows]
        felt = np.stack(padded)[runs.of]
        # Effects act on the first input.
        for effect, c in shifting if place == 0 else ():
            if isinstance(effect, Input):
                commanded = effect.times(c, felt)
                felt = np.where(acts(c), felt + (felt - commanded), felt)  # (2)
        columns.append(felt)
    if not columns:
        return np.zeros((runs.of.size, 0))
    return np.concatenate(columns, axis=1)


def _divided(instants: Array, largest_step: float) -> tuple[Array, Array, int, Indices]:
    """Steps and their ends (N, S) through instants (N, T), after how many a state is kept, which
    one at each instant.

    An interval is divided into equal steps; those of a lane depend on no other. They are laid into
    blocks of as many steps as most intervals have, and steps of no length fill the last block of an
    interval.
    """
    lanes, samples = instants.shape
    start = np.zeros((lanes, 1))
    before = np.concatenate([start, instants[:, :-1]], axis=1)
    intervals = instants - before
    # An interval of a whole number of steps has that number, whatever its rounding.
    parts = np.ceil(intervals / largest_step - _ROUNDING).astype(np.intp)
    parts = np.where(intervals > 0, np.maximum(parts, 1), 0)
    every = int(np.bincount(parts[parts > 0]).argmax()) if parts.any() else 1
    blocks = -(-parts // every)
    rows = np.cumsum(blocks, axis=1)
    size = max(int(rows[:, -1].max()), 1)
    # From here on one entry a block: its interval, its number in the lane, the numbers of its steps
    # in the interval.
    interval = np.repeat(np.arange(lanes * samples), blocks.ravel())
    lane = interval // samples
    in_lane = rows[:, -1]
    in_lanes_before = np.cumsum(in_lane) - in_lane
    block = np.arange(interval.size) - in_lanes_before[lane]
    blocks_before = (rows - blocks).ravel()[interval]
    in_interval = (block - blocks_before)[:, None]
    number = in_interval * every + np.arange(every)
    count = parts.ravel()[interval, None]
    length = intervals.ravel()[interval, None] / count
    steps = np.zeros((lanes, size, every))
    ends = np.repeat(instants[:, -1], size * every).reshape(lanes, size, every)
    steps[lane, block] = np.where(number < count, length, 0.0)
    # The last step of an interval ends at the instant itself and not near it.
    inside = before.ravel()[interval, None] + (number + 1) * length
    instant = instants.ravel()[interval, None]
    ends[lane, block] = np.where(number + 1 < count, inside, instant)
    return steps.reshape(lanes, -1), ends.reshape(lanes, -1), every, rows


def _since_start(scenario: Scenario) -> Array:
    """(T,) seconds since the first sample."""
    seconds: Array = scenario.times - scenario.times[0]
    return seconds


def _commanded(scenario: Scenario) -> Array:
    """(T,) seconds since the first sample at which inputs have their values."""
    seconds: Array = _since_start(scenario) + scenario.offset
    return seconds


def _earlier(scenario: Scenario, name: str) -> Array:
    """(K,) the same of an input before the run, as far as it is known."""
    if name not in scenario.before:
        return np.empty(0)
    earlier: Array = scenario.before[name][0] + scenario.offset
    return earlier


def _signal(scenario: Scenario, name: str, values: Array) -> Array:
    """(K + T,) the values at these instants, from those in the run (T,)."""
    if name not in scenario.before:
        return values
    return np.concatenate([scenario.before[name][1], values])


def _padded(values: Array, size: int) -> Array:
    """`values` and their last one, over and over, up to this size."""
    more = np.full(size - values.size, values[-1])
    return np.concatenate([values, more])


def felt_inputs(plan: Plan, runs: Runs, commands: Commands, acting: Acting) -> dict[str, Array]:
    """What the plant feels over each step, (L, S) by name: each command's mean over the step,
    through the effects.

    A command holds its value from one recorded sample to the next, and had its first value before
    the first, unless more is known. Effects act on the first input; those with a memory begin where
    it is known first.

    Args:
        plan: the steps.
        runs: scenarios of the lanes.
        commands: inputs of each distinct scenario.
        acting: input effects in the order in which the signal passes them.
    """
    effects = tuple((effect, c, acts(c)) for effect, c in acting if c.any())
    begin, end, steps = _before(plan.ends), plan.ends, plan.steps
    first, *others = commands[0]
    felt = {}
    for name in others if effects else (first, *others):
        felt[name] = _felt(runs, name, commands, begin, end, plan.alike)
    if not effects:
        return felt
    lead = _led(runs, first, max(float(steps.max(initial=0.0)), FINE))
    if lead[0].size:
        parts = zip(lead, (begin, end, steps), strict=True)
        begin, end, steps = (np.hstack([before[runs.of], now]) for before, now in parts)
    ends = end
    # Back from the plant to the command: the last effect asks the one before it for its instants.
    for effect, c, on in reversed(effects):
        assert isinstance(effect, Input)
        # Most effects leave instants as they are, and then nothing is asked of every single lane.
        if not _shifts(effect):
            continue
        begin = np.where(on, effect.times(c, begin), begin)
        end = np.where(on, effect.times(c, end), end)
    # And forward with the values.
    means = _felt(runs, first, commands, begin, end, plan.alike)
    for effect, c, on in effects:
        if isinstance(effect, Input) and effect.between:
            other = _felt(runs, first, commands, begin, end, plan.alike, other=True)
            means = np.where(on, means + c[0] * (other - means), means)
    pairs = zip(runs.distinct, commands, strict=True)
    beginnings = np.array([_signal(s, first, u[first])[0] for s, u in pairs])
    passed = _passed(effects, steps, ends, means, beginnings[runs.of, None])
    return {first: passed[:, lead[0].shape[1] :], **felt}


def _led(runs: Runs, name: str, largest: float) -> tuple[Array, Array, Array]:
    """(N, K) each: beginnings, ends and lengths of steps before the runs, in which an input is
    known; none is longer than `largest`, and they have no length where it is not.
    """
    marks = [_earlier(s, name) for s in runs.distinct]
    marks = [np.append(row[row < 0], 0.0) for row in marks]
    size = max(row.size for row in marks)
    if size == 1:
        nothing = np.empty((len(marks), 0))
        return nothing, nothing, nothing
    first = np.array([[row[0]] for row in marks])
    steps, ends, _, _ = _divided(np.stack([_padded(row, size) for row in marks]) - first, largest)
    ends = ends + first
    return np.hstack([first, ends[:, :-1]]), ends, steps


def _passed(
    effects: Sequence[tuple[Effect, Array, NDArray[np.bool_]]],
    steps: Array,
    ends: Array,
    means: Array,
    start: Array,
) -> Array:
    """(L, S) what becomes of `means` (L, S) on their way through effects on the input.

    Args:
        effects: with their coefficients, and where they act, (L, 1).
        steps: (L, S) lengths.
        ends: (L, S) their ends.
        means: of the command over each step.
        start: (L, 1) the command's first value, which has always been there before the first step.
    """
    lasting = _lasting(steps)
    values = np.take_along_axis(means, lasting, axis=1)
    start = start.copy()
    for effect, c, on in effects:
        assert isinstance(effect, Input)
        # Of hundreds of lanes an effect may act in a few: the others are not asked.
        lanes = np.flatnonzero(on)
        own, begin = c[:, lanes], start[lanes]
        nothing = np.zeros_like(begin)
        signal = Signal(values[lanes], steps[lanes], begin, ends[lanes])
        passed = effect.feel(own, signal)
        values[lanes] = np.take_along_axis(passed, lasting[lanes], axis=1)
        start[lanes] = effect.feel(own, Signal(begin, nothing, begin, nothing))
    return values


def _before(ends: Array) -> Array:
    """(L, S) the beginnings of steps, from their ends; shares memory as they do."""
    own = ends[:1] if ends.strides[0] == 0 else ends
    start = np.zeros((len(own), 1))
    begin = np.concatenate([start, own[:, :-1]], axis=1)
    return np.broadcast_to(begin, ends.shape)


def _lasting(steps: Array) -> Indices:
    """(L, S) for each step itself if it has a length, else the last before it that has: waiting
    feels nothing new.
    """
    own = np.arange(steps.shape[1])
    lasting = np.where(steps > 0, own, 0)
    last: Indices = np.maximum.accumulate(lasting, axis=1)
    return last


def _felt(
    runs: Runs,
    name: str,
    commands: Commands,
    begin: Array,
    end: Array,
    alike: bool,
    other: bool = False,
) -> Array:
    """Means (L, S) of each lane's signal from `begin` to `end` (L, S); of lanes that are alike only
    the first of each run is looked at. With `other`, a signal that holds between samples goes
    straight, and one that goes straight holds.
    """
    count = len(commands) if alike else len(begin)
    result = np.empty((count, begin.shape[1]))
    # All lanes of a run in one call.
    by_run = np.argsort(runs.of, kind="stable")
    borders = np.flatnonzero(np.diff(runs.of[by_run])) + 1
    for lanes in np.split(by_run, borders):
        run = runs.of[lanes[0]]
        scenario = runs.distinct[run]
        means = _straight_means if (name in scenario.linear) != other else _means
        to, of = (slice(run, run + 1), lanes[:1]) if alike else (lanes, lanes)
        instants = np.concatenate([_earlier(scenario, name), _commanded(scenario)])
        signal = _signal(scenario, name, commands[run][name])
        result[to] = means(instants, signal, begin[of], end[of])
    return runs.spread(result) if alike else result


def _means(times: Array, values: Array, begin: Array, end: Array) -> Array:
    """Means over [begin, end] of the signal that holds values[i] from times[i] on; its value where
    begin = end.
    """
    place = np.searchsorted(times, begin, side="right") - 1
    place = np.clip(place, 0, times.size - 1)
    value: Array = values[place]
    last = np.searchsorted(times, end, side="left") - 1
    last = np.clip(last, 0, times.size - 1)
    # (1) only where the command changes within: elsewhere its value is exact, a quotient is not.
    crossing = last > place
    if crossing.any():
        held = values[:-1] * np.diff(times)
        area = np.concatenate([[0.0], np.cumsum(held)])
        a = begin[crossing]
        b = end[crossing]
        over = _area(times, values, area, b) - _area(times, values, area, a)
        value[crossing] = over / (b - a)  # (1)
    return value


def _straight_means(times: Array, values: Array, begin: Array, end: Array) -> Array:
    """The same of the signal that goes straight from values[i] at times[i] to the next, and is as
    at its ends before and after.
    """
    halves = 0.5 * (values[:-1] + values[1:]) * np.diff(times)
    area = np.concatenate([[0.0], np.cumsum(halves)])
    value = np.interp(0.5 * (begin + end), times, values)
    # A mean over part of one straight stretch is its middle; over more of them, (1).
    first = np.searchsorted(times, begin, side="right")
    crossing = np.searchsorted(times, end, side="left") > first
    if crossing.any():
        a, b = begin[crossing], end[crossing]
        over = _straight_area(times, values, area, b) - _straight_area(times, values, area, a)
        value[crossing] = over / (b - a)  # (1)
    result: Array = value
    return result


def _straight_area(times: Array, values: Array, area: Array, t: Array) -> Array:
    """A(t) of (1) of a signal that goes straight, with `area` (T,) that up to each of `times`."""
    place = np.clip(np.searchsorted(times, t, side="right") - 1, 0, times.size - 1)
    here = np.interp(t, times, values)
    result: Array = area[place] + 0.5 * (values[place] + here) * (t - times[place])
    return result


def _area(times: Array, values: Array, area: Array, t: Array) -> Array:
    """A(t) of (1), with `area` (T,) that up to each of `times` (T,)."""
    place = np.searchsorted(times, t, side="right") - 1
    place = np.clip(place, 0, times.size - 1)
    result: Array = area[place] + values[place] * (t - times[place])
    return result


def _shifts(effect: Effect) -> bool:
    """Whether it moves instants: whether it has a `times` of its own."""
    if not isinstance(effect, (Input, Sensor)):
        return False
    return type(effect).times not in (Input.times, Sensor.times)


def acts(c: Array) -> NDArray[np.bool_]:
    """(L, 1) in which lanes an effect with coefficients (K, L, 1) is not off."""
    result: NDArray[np.bool_] = (c != 0).any(axis=0)
    return result
