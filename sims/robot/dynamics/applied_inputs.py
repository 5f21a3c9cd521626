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
from sims.engines.time_grid import ScenarioGroups, TimeGrid, compute_applied_inputs
from sims.robot.dynamics.active_effects import slice_active_effects
from sims.robot.dynamics.midpoint_state import Mask, Places

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

    def cuts(self, step: float, share: float, is_changed: bool) -> Array:
        """Return the fractions of a step at which it is divided.

        Args:
            step: step length in seconds.
            share: share of each step over which the input is averaged.
            is_changed: whether effects change the inputs, within a step or at its ends.
        """
        if share < 1.0:
            return np.array([share, 1.0])
        # If commands change only at step ends, the mean describes each step completely.
        places = self._sample_places(step)
        is_aligned = bool((np.abs(places - np.rint(places)) < STEP_COUNT_TOLERANCE).all())
        return NO_SUBDIVISION if is_aligned and not is_changed else STEP_SUBDIVISION

    def seen(self, step: float) -> Mask:
        """Return whether a sample is at the beginning of the first step and each step end (S + 1,).

        Args:
            step: step length in seconds.
        """
        seen = np.zeros(self.steps + 1, dtype=bool)
        seen[np.clip(np.rint(self._sample_places(step)).astype(np.intp), 0, self.steps)] = True
        return seen

    def _sample_places(self, step: float) -> Array:
        """Return the times of the samples (T,) in steps."""
        scenario = self.scenario
        places: Array = (scenario.times - scenario.times[0] + scenario.offset) / step
        return places


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
    holds a control over a step, so that each value is a mean over the step.

    Args:
        step: step length in seconds.
        scenario: scenario of the run.
        commands: commanded inputs (T,) by name.
        acting: active effects with their coefficients (K, n, 1).
        n: number of batch elements.
        steps: number S of steps.
        share: share of each step, from its beginning, over which the input is averaged. The default
            1.0 gives the value to apply over the whole step.

    Returns:
        Applied inputs (n, S) by name.
    """
    run = RunInputs(scenario, commands, acting, n, steps)
    cuts, seen = run.cuts(step, share, is_changed=False), run.seen(step)
    applied_inputs: dict[str, Array] = {}
    for name, signal in commands.items():
        earlier = scenario.before[name].tobytes() if name in scenario.before else b""
        read = name in scenario.linear, scenario.offset, earlier
        key = step, steps, cuts.tobytes(), *read, _compute_signal_digest(scenario.times, signal)
        bare = _InputRequest(0, scenario, name, signal, np.zeros(1, dtype=np.intp), ())
        plain = _applied_input_cache.get(
            key, partial(_compute_applied_inputs, step, [bare], steps, seen, cuts)
        )
        applied_inputs[name] = np.repeat(plain, n, axis=0)
    for _, name, lanes, values in compute_changed_inputs(step, [run], share):
        applied_inputs[name][lanes] = values
    return applied_inputs


def compute_changed_inputs(
    step: float, runs: Sequence[RunInputs], share: float = 1.0
) -> Iterator[tuple[int, str, Places, Array]]:
    """Compute the inputs that effects change, of several runs together.

    Effects with a state are integrated step by step, and a step costs about the same for few and
    for many batch elements.

    Args:
        step: step length in seconds.
        runs: the runs.
        share: as in `compute_inputs_over_steps`.

    Yields:
        Number of the run, name of the input, batch elements (L,), and their applied inputs (L, S).
    """
    alike: dict[tuple[int, bytes, bytes], list[_InputRequest]] = {}
    for number, run in enumerate(runs):
        cuts, seen = run.cuts(step, share, is_changed=True), run.seen(step)
        requests = alike.setdefault((run.steps, cuts.tobytes(), seen.tobytes()), [])
        for name, signal in run.commands.items():
            passed = tuple(
                (e, c) for e, c in run.acting if isinstance(e, Input) and e.signal == name
            )
            # Inputs are grouped by effects, so that the value of a batch element does not depend on
            # others.
            requests += [
                _InputRequest(number, run.scenario, name, signal, *part)
                for part in _by_kinds(passed, run.n)
            ]
    for (steps, cut_bytes, seen_bytes), requests in alike.items():
        cuts, seen = np.frombuffer(cut_bytes), np.frombuffer(seen_bytes, dtype=bool)
        for group in _group_requests(requests):
            values = _compute_applied_inputs(step, group, steps, seen, cuts)
            ends = np.cumsum([one.lanes.size for one in group])
            for one, rows in zip(group, np.split(values, ends[:-1]), strict=True):
                yield one.run, one.name, one.lanes, rows


class _InputRequest(NamedTuple):
    """Request for one applied input.

    Attributes:
        run: number of the run.
        scenario: scenario of the run.
        name: name of the input.
        signal: (T,) commanded values.
        lanes: batch elements in which input effects are active.
        acting: these effects, with coefficients for the batch elements.
    """

    run: int
    scenario: Scenario
    name: str
    signal: Array
    lanes: Places
    acting: ActiveEffects


def _restrict_to_input(scenario: Scenario, name: str) -> Scenario:
    """Restrict a scenario to one input, under the name `SINGLE_INPUT_NAME`."""
    return replace(
        scenario,
        inputs={},
        linear=frozenset({SINGLE_INPUT_NAME} if name in scenario.linear else ()),
        before={SINGLE_INPUT_NAME: scenario.before[name]} if name in scenario.before else {},
    )


def _by_kinds(passed: ActiveEffects, n: int) -> Iterator[tuple[Places, ActiveEffects]]:
    """Group n batch elements by the effects that act on them, without elements on which none acts.

    Yields: Indices of a group's elements, and the effects with the coefficients of these
    elements.
    """
    there = np.array([(c != 0).any(axis=(0, 2)) for _, c in passed], dtype=bool).reshape(-1, n)
    kinds, of = np.unique(there, axis=1, return_inverse=True)
    for number, kind in enumerate(kinds.T):
        if kind.any():
            lanes = np.flatnonzero(of.ravel() == number)
            yield lanes, slice_active_effects(passed, lanes)


def _group_requests(asked: Sequence[_InputRequest]) -> Iterator[list[_InputRequest]]:
    """Group requests with equal types of effects, at most `MAX_BATCH_SIZE` elements each."""
    alike: dict[tuple[str, ...], list[_InputRequest]] = {}
    for one in asked:
        alike.setdefault(tuple(e.of or e.name for e, _ in one.acting), []).append(one)
    for group in alike.values():
        sizes = np.cumsum([one.lanes.size for one in group])
        parts = (sizes - 1) // MAX_BATCH_SIZE
        for part in np.unique(parts):
            yield [group[k] for k in np.flatnonzero(parts == part)]


def _concatenate_effects(asked: Sequence[_InputRequest]) -> ActiveEffects:
    """Concatenate the effects of a group of requests along the batch elements."""
    first = [effect for effect, _ in asked[0].acting]
    rows = zip(*([c for _, c in one.acting] for one in asked), strict=True)
    return tuple((effect, np.concatenate(c, axis=1)) for effect, c in zip(first, rows, strict=True))


def _compute_applied_inputs(
    step: float,
    requests: Sequence[_InputRequest],
    steps: int,
    seen: Mask,
    cuts: Array,
) -> Array:
    """Compute the input that each request applies over each step, (N, S) for N batch elements.

    Delays and filters act within a step. `cuts` are the times in a step, as shares of its length,
    at which it is divided for them. With the cuts of `STEP_SUBDIVISION` the parts are combined to
    one value per step; with fewer cuts, the first part is returned.
    """
    acting = _concatenate_effects(requests)
    of = np.repeat(np.arange(len(requests)), [one.lanes.size for one in requests])
    runs = ScenarioGroups(tuple(_restrict_to_input(one.scenario, one.name) for one in requests), of)
    plan = _parts_of_steps(step, steps, of.size, cuts, alike=not acting)
    commands = [{SINGLE_INPUT_NAME: one.signal} for one in requests]
    values = compute_applied_inputs(plan, runs, commands, acting)[SINGLE_INPUT_NAME]
    parts = values.reshape(of.size, steps, cuts.size)
    return parts[:, :, 0] if cuts.size < STEP_SUBDIVISION.size else compute_step_inputs(parts, seen)


def _parts_of_steps(step: float, steps: int, n: int, cuts: Array, alike: bool) -> TimeGrid:
    """Make the plan of steps that are subdivided at the given fractions."""
    begins: Array = step * np.arange(float(steps))
    ends = (begins[:, None] + step * cuts).ravel()
    lengths = np.diff(ends, prepend=0.0)
    rows = np.zeros((n, 1), dtype=np.intp)
    shape = n, ends.size
    whole = np.broadcast_to(lengths, shape), np.broadcast_to(ends, shape)
    return TimeGrid(*whole, 1, rows, has_uniform_steps=alike)


def compute_step_inputs(parts: Array, seen: Mask) -> Array:
    """Compute the inputs of steps (n, S) from their means (n, S, 4) over the quarters of each step.

    A step of length h has one constant control. Its mean is that of the command. The first moment
    of the command about the middle of the step,

        D = 1 / h^2 times the integral of (s - h / 2) u(s)                                 (1)

    is reproduced by adding -D to the step and +D to the next one. If a sample is at the end of the
    step and none at its beginning, -D is added to the previous step and +D to this one, since only
    the states at samples are observed. So a command that changes within a step is applied neither
    early nor late by a fraction of the step.

    Args:
        parts: (n, S, 4) means over the quarters.
        seen: (S + 1,) whether a sample is at the beginning of the first step and at each step end.
    """
    weights = (np.arange(4.0) + 0.5) / 4.0 - 0.5
    moments = (parts * weights).mean(axis=2)  # (1)
    given: Array = parts.mean(axis=2)
    last = parts.shape[1] - 1
    for way, allowed in ((1, ~seen[1:]), (-1, seen[1:] & ~seen[:-1])):
        steps = np.flatnonzero(allowed)
        steps = steps[(steps + way >= 0) & (steps + way <= last)]
        given[:, steps] -= way * moments[:, steps]
        given[:, steps + way] += way * moments[:, steps]
    return given
