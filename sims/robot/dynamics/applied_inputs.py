"""Inputs of a robot as applied to the plant over each simulation step."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from sims.core.effect import ActiveEffects, Input
from sims.core.simulator import Array, Scenario
from sims.engines.scenario_groups import ScenarioGroups
from sims.engines.step_inputs import compute_applied_inputs
from sims.engines.time_grid import TimeGrid
from sims.robot.dynamics.active_effects import slice_active_effects
from sims.robot.dynamics.midpoint_state import IndexArray, Mask

SAME_INSTANT_SHARE = 1e-6
"""Share of a step, from its beginning, over which the input counts as its initial value."""
STEP_COUNT_TOLERANCE = 1e-6
"""Tolerance, as a share of a step, within which a time counts as the end of a step."""
STEP_SUBDIVISION: Array = np.array([0.25, 0.5, 0.75, 1.0])
"""Fractions of a step at which it is subdivided, to resolve changes of a command within it."""
CACHE_BYTES = 64 * 2**20
"""Maximum size of cached applied inputs, in bytes."""
NO_SUBDIVISION: Array = np.array([1.0])
"""Fractions of a step that is not subdivided."""
SINGLE_INPUT_NAME = "u"
"""Name given to an input that is evaluated separately."""
MAX_BATCH_SIZE = 256
"""Maximum number of batch elements whose inputs are evaluated together."""


class _BoundedCache:
    """Cache of arrays that is emptied when it exceeds `CACHE_BYTES` bytes."""

    def __init__(self) -> None:
        self._arrays: dict[tuple[object, ...], Array] = {}
        self._bytes = 0

    def get(self, key: tuple[object, ...], make: Callable[[], Array]) -> Array:
        """Return the array cached under a key; otherwise compute it with `make` and cache it.

        If the cache exceeds `CACHE_BYTES`, all older arrays are removed.

        Args:
            key: all values on which the array depends.
            make: computes the array.
        """
        if key not in self._arrays:
            array = make()
            self._bytes += array.nbytes
            if self._bytes > CACHE_BYTES:
                self._arrays.clear()
                self._bytes = array.nbytes
            self._arrays[key] = array
        return self._arrays[key]


_applied_input_cache = _BoundedCache()
"""Cache of applied inputs without input effects.

Thousands of simulations share the same commands.
"""


def _compute_signal_digest(times: Array, signal: Array) -> bytes:
    """Compute a digest of a signal and its sample times, which is a key of the cache."""
    digest = hashlib.blake2b(times.tobytes(), digest_size=16)
    digest.update(signal.tobytes())
    return digest.digest()


class RunInputs(NamedTuple):
    """Commands of a run, and the input effects of n batch elements.

    Attributes:
        scenario: scenario of the run.
        commands: commanded inputs (T,) by name.
        acting: active effects with their coefficients (K, n, 1).
        n: number of batch elements.
        steps: number S of steps.
    """

    scenario: Scenario
    commands: Mapping[str, Array]
    acting: ActiveEffects
    n: int
    steps: int

    def get_step_fractions(self, step: float, share: float, is_changed: bool) -> Array:
        """Return the fractions of a step at which it is divided to compute mean inputs.

        The cases are:

        * An input that is averaged over the first part of a step only: the end of this part.
        * Commands that change at the ends of steps only, without input effects: no division.
        * Otherwise quarters, so that a command that changes within a step has the right time.

        Args:
            step: step length in seconds.
            share: share of each step, from its beginning, over which the input is averaged.
            is_changed: whether effects change the inputs, at any time within a step.

        Returns:
            Ends of the parts of a step as shares of its length, ascending; the last one is 1.
        """
        if share < 1.0:
            return np.array([share, 1.0])
        # If commands change only at step ends, the mean describes each step completely.
        sample_times = self._get_sample_times_in_steps(step)
        distances_from_step_end = np.abs(sample_times - np.rint(sample_times))
        is_aligned = bool((distances_from_step_end < STEP_COUNT_TOLERANCE).all())
        return NO_SUBDIVISION if is_aligned and not is_changed else STEP_SUBDIVISION

    def find_steps_with_sample(self, step: float) -> Mask:
        """Find the ends of steps that are nearest to a sample of the run.

        Args:
            step: step length in seconds.

        Returns:
            (S + 1,) whether a sample is at the beginning of the first step, and at the end of each
            of the S steps.
        """
        nearest_ends = np.rint(self._get_sample_times_in_steps(step)).astype(np.intp)
        has_sample = np.zeros(self.steps + 1, dtype=bool)
        has_sample[np.clip(nearest_ends, 0, self.steps)] = True
        return has_sample

    def _get_sample_times_in_steps(self, step: float) -> Array:
        """Return the times of the samples (T,) in steps."""
        scenario = self.scenario
        sample_times: Array = (scenario.times - scenario.times[0] + scenario.offset) / step
        return sample_times


def compute_inputs_over_steps(
    step: float,
    scenario: Scenario,
    commands: Mapping[str, Array],
    acting: ActiveEffects,
    n: int,
    steps: int,
    share: float = 1.0,
) -> dict[str, Array]:
    """Compute the applied inputs of n batch elements over S steps.

    An applied input is the command after all input effects (gain, delay, lag and so on). MuJoCo
    holds a control over a step, so that each value is a mean over the step. First all elements get
    the commands without effects, which are cached; then the inputs that effects change replace
    them.

    Args:
        step: step length in seconds.
        scenario: scenario of the run.
        commands: commanded inputs (T,) at T samples by name.
        acting: active effects with K coefficients each, (K, n, 1).
        n: number of batch elements.
        steps: number S of steps.
        share: share of each step, from its beginning, over which the input is averaged. The default
            1.0 gives the value to apply over the whole step; `SAME_INSTANT_SHARE` gives the value
            at the beginning of the step.

    Returns:
        Applied inputs (n, S) by name.
    """
    run = RunInputs(scenario, commands, acting, n, steps)
    fractions = run.get_step_fractions(step, share, is_changed=False)
    has_sample = run.find_steps_with_sample(step)
    applied_inputs: dict[str, Array] = {}
    for name, signal in commands.items():
        # Commands before the run, as bytes; empty if they are not known.
        earlier = scenario.before[name].tobytes() if name in scenario.before else b""
        # Everything on which the applied input depends.
        key = (
            step,
            steps,
            fractions.tobytes(),
            name in scenario.linear,
            scenario.offset,
            earlier,
            _compute_signal_digest(scenario.times, signal),
        )
        # One batch element without effects, (1, S), stands for all.
        request = _InputRequest(
            run=0,
            scenario=scenario,
            name=name,
            signal=signal,
            batch_indices=np.zeros(1, dtype=np.intp),
            acting=(),
        )
        unchanged = _applied_input_cache.get(
            key, partial(_compute_applied_inputs, step, [request], steps, has_sample, fractions)
        )
        applied_inputs[name] = np.repeat(unchanged, n, axis=0)
    # The inputs of batch elements with input effects.
    for _, name, batch_indices, values in compute_changed_inputs(step, [run], share):
        applied_inputs[name][batch_indices] = values
    return applied_inputs


def compute_changed_inputs(
    step: float, runs: Sequence[RunInputs], share: float = 1.0
) -> Iterator[tuple[int, str, IndexArray, Array]]:
    """Compute the inputs that effects change, of several runs together.

    Effects with a state, such as a lag, are integrated step by step, and a step costs about the
    same for few and for many batch elements. So inputs are collected from all runs, grouped by
    equal step times and equal effects, and each group is integrated at once. Inputs and batch
    elements without effects are left out.

    Args:
        step: step length in seconds.
        runs: the runs.
        share: share of each step, from its beginning, over which the input is averaged.

    Yields:
        Number of the run, name of the input, indices (L,) of L of the run's batch elements, and
        their applied inputs (L, S) over S steps.
    """
    # 1. Collect one request for each input and group of batch elements with the same effects on it.
    # They are grouped by the steps, their division, and the steps with a sample; arrays are stored
    # as bytes, so that they can be keys.
    requests_by_grid: dict[tuple[int, bytes, bytes], list[_InputRequest]] = {}
    for run_index, run in enumerate(runs):
        fractions = run.get_step_fractions(step, share, is_changed=True)
        has_sample = run.find_steps_with_sample(step)
        requests = requests_by_grid.setdefault(
            (run.steps, fractions.tobytes(), has_sample.tobytes()), []
        )
        for name, signal in run.commands.items():
            input_effects = tuple(
                (e, c) for e, c in run.acting if isinstance(e, Input) and e.signal == name
            )
            # Each element is evaluated with its own effects only, so that its value does not depend
            # on other elements.
            requests += [
                _InputRequest(run_index, run.scenario, name, signal, batch_indices, acting)
                for batch_indices, acting in _group_by_active_effects(input_effects, run.n)
            ]
    # 2. Evaluate the requests of a group in one batch, and divide the rows of the result again.
    for (steps, fraction_bytes, sample_bytes), requests in requests_by_grid.items():
        fractions = np.frombuffer(fraction_bytes)
        has_sample = np.frombuffer(sample_bytes, dtype=bool)
        for group in _group_requests(requests):
            values = _compute_applied_inputs(step, group, steps, has_sample, fractions)
            ends = np.cumsum([request.batch_indices.size for request in group])
            for request, rows in zip(group, np.split(values, ends[:-1]), strict=True):
                yield request.run, request.name, request.batch_indices, rows


class _InputRequest(NamedTuple):
    """Request for one applied input.

    Attributes:
        run: number of the run.
        scenario: scenario of the run.
        name: name of the input.
        signal: (T,) commanded values.
        batch_indices: batch elements in which input effects are active.
        acting: these effects, with coefficients for the batch elements.
    """

    run: int
    scenario: Scenario
    name: str
    signal: Array
    batch_indices: IndexArray
    acting: ActiveEffects


def _restrict_to_input(scenario: Scenario, name: str) -> Scenario:
    """Restrict a scenario to the interpolation (`linear`) and the history (`before`) of one input.

    The input gets the name `SINGLE_INPUT_NAME`, so that inputs of several names are computed in one
    batch. Its commands are passed separately, so the scenario has no inputs.

    Args:
        scenario: scenario of a run.
        name: name of the input in this scenario.
    """
    return replace(
        scenario,
        inputs={},
        linear=frozenset({SINGLE_INPUT_NAME} if name in scenario.linear else ()),
        before={SINGLE_INPUT_NAME: scenario.before[name]} if name in scenario.before else {},
    )


def _group_by_active_effects(
    input_effects: ActiveEffects, n: int
) -> Iterator[tuple[IndexArray, ActiveEffects]]:
    """Group n batch elements by the effects that act on them, without elements on which none acts.

    Args:
        input_effects: effects with K coefficients each, (K, n, 1); one with zeros only does not
            act.
        n: number of batch elements.

    Yields:
        Indices of a group's elements, and the effects with the coefficients of these elements.
    """
    # Row e, column l: whether effect e acts on batch element l; also valid without effects.
    is_active = np.array([(c != 0).any(axis=(0, 2)) for _, c in input_effects], dtype=bool).reshape(
        -1, n
    )
    # Most runs have no input effect, and `np.unique` would take longer than the rest.
    if not is_active.any():
        return
    # Each distinct column is one combination of effects.
    combinations, combination_of_element = np.unique(is_active, axis=1, return_inverse=True)
    for number, combination in enumerate(combinations.T):
        if combination.any():
            batch_indices = np.flatnonzero(combination_of_element.ravel() == number)
            yield batch_indices, slice_active_effects(input_effects, batch_indices)


def _group_requests(requests: Sequence[_InputRequest]) -> Iterator[list[_InputRequest]]:
    """Group requests with equal types of effects, of about `MAX_BATCH_SIZE` batch elements each.

    A group is evaluated in one batch, with one effect function per effect and one row per element.
    A request is not divided, so that a group may be larger than `MAX_BATCH_SIZE` by one request.

    Args:
        requests: requests for inputs, with the effects that act on them.
    """
    requests_by_effects: dict[tuple[str, ...], list[_InputRequest]] = {}
    for request in requests:
        # Names of the registered effects, which are equal at all places.
        effect_types = tuple(e.of or e.name for e, _ in request.acting)
        requests_by_effects.setdefault(effect_types, []).append(request)
    for group in requests_by_effects.values():
        # A request belongs to the part in which its last element lies.
        ends = np.cumsum([request.batch_indices.size for request in group])
        part_of_request = (ends - 1) // MAX_BATCH_SIZE
        for part in np.unique(part_of_request):
            yield [group[k] for k in np.flatnonzero(part_of_request == part)]


def _concatenate_effects(requests: Sequence[_InputRequest]) -> ActiveEffects:
    """Concatenate the effects of a group of requests along the batch elements."""
    first = [effect for effect, _ in requests[0].acting]
    rows = zip(*([c for _, c in request.acting] for request in requests), strict=True)
    return tuple((effect, np.concatenate(c, axis=1)) for effect, c in zip(first, rows, strict=True))


def _compute_applied_inputs(
    step: float,
    requests: Sequence[_InputRequest],
    steps: int,
    has_sample: Mask,
    fractions: Array,
) -> Array:
    """Compute the input that each request applies over each step, (N, S) for N batch elements.

    A request has the commands of one input and the effects on it. The requests are integrated as
    one batch on a time grid that divides each step at `fractions`, because delays and filters act
    within a step. Quarters (`STEP_SUBDIVISION`) are then combined to one value per step. With fewer
    parts, the value of the first part is returned: it is the whole step, or the beginning of the
    step that was asked for.

    Args:
        step: step length in seconds.
        requests: requests with equal types of effects, N batch elements in all.
        steps: number S of steps.
        has_sample: (S + 1,) whether a sample is at the beginning of the first step and at each
            step's end.
        fractions: ends of the parts of a step, as shares of its length.
    """
    acting = _concatenate_effects(requests)
    # Each request is treated as a run with one input; a request may have several batch elements.
    sizes = [request.batch_indices.size for request in requests]
    request_of_element = np.repeat(np.arange(len(requests)), sizes)
    element_count = request_of_element.size
    runs = ScenarioGroups(
        tuple(_restrict_to_input(request.scenario, request.name) for request in requests),
        request_of_element,
    )
    # Without effects, which may shift the times of each element differently, a request is evaluated
    # once for all of its elements.
    time_grid = _make_subdivided_grid(
        step, steps, element_count, fractions, has_uniform_steps=not acting
    )
    commands = [{SINGLE_INPUT_NAME: request.signal} for request in requests]
    values = compute_applied_inputs(time_grid, runs, commands, acting)[SINGLE_INPUT_NAME]
    parts = values.reshape(element_count, steps, fractions.size)
    if fractions.size < STEP_SUBDIVISION.size:
        return parts[:, :, 0]
    return compute_step_inputs(parts, has_sample)


def _make_subdivided_grid(
    step: float, steps: int, n: int, fractions: Array, has_uniform_steps: bool
) -> TimeGrid:
    """Make the time grid of equal steps that are all divided at the given fractions.

    Args:
        step: step length in seconds.
        steps: number of steps.
        n: number of batch elements, which all have the same steps.
        fractions: ends of the parts of a step, as shares of its length.
        has_uniform_steps: whether inputs may be computed once for all batch elements with the same
            scenario.
    """
    begins: Array = step * np.arange(float(steps))
    ends = (begins[:, None] + step * fractions).ravel()
    lengths = np.diff(ends, prepend=0.0)
    return TimeGrid(
        steps=np.broadcast_to(lengths, (n, ends.size)),
        ends=np.broadcast_to(ends, (n, ends.size)),
        # No state is stored: the grid is used for inputs only.
        steps_per_sample=1,
        rows=np.zeros((n, 1), dtype=np.intp),
        has_uniform_steps=has_uniform_steps,
    )


def compute_step_inputs(parts: Array, has_sample: Mask) -> Array:
    """Compute one input for each step (n, S) from the means (n, S, 4) over its quarters.

    MuJoCo holds one control over a step of length h, so a command that changes within a step would
    be applied too early or too late by a fraction of it. The control has the command's mean. In
    addition, the first moment of the command about the middle of the step,

        D = 1 / h^2 times the integral of (s - h / 2) u(s) over the step, s = 0 to h           (1)

    is reproduced by two neighbouring steps together. Between them the state is wrong, so no sample
    may be there:

    * Without a sample at the end of the step, -D is added to the step and +D to the next one.
    * With a sample at its end and none at its beginning, -D is added to the previous step and +D to
      this one.
    * With samples at both ends, nothing is added.

    Args:
        parts: (n, S, 4) means over the quarters of S steps, for n batch elements.
        has_sample: (S + 1,) whether a sample is at the beginning of the first step and at each step
            end.
    """
    # Distances of the middles of the quarters from the middle of the step, in steps.
    distances = (np.arange(4.0) + 0.5) / 4.0 - 0.5
    moments = parts @ (distances / 4.0)  # D of each step, (n, S)
    means: Array = parts @ np.full(4, 0.25)
    last = parts.shape[1] - 1
    # Direction of the step that shares the moment: 1 for the next one, -1 for the previous one.
    for direction, allowed in ((1, ~has_sample[1:]), (-1, has_sample[1:] & ~has_sample[:-1])):
        steps = np.flatnonzero(allowed)
        steps = steps[(steps + direction >= 0) & (steps + direction <= last)]
        means[:, steps] -= direction * moments[:, steps]
        means[:, steps + direction] += direction * moments[:, steps]
    return means
