"""Run a batch on the compiled kernel: group elements by active effects and prepare arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from sims.core.simulator import Array
from sims.core.system import Contact, Effect, Force, Friction, IntegrationBatch, Trajectories
from sims.engines.batch.force_field import is_active
from sims.engines.batch.step_size import MAX_STEP_DIVISIONS
from sims.engines.compiled import compilability
from sims.engines.compiled.data_layout import BLOCK_WIDTH, BatchArrays
from sims.engines.compiled.force_program import CompiledModel
from sims.engines.compiled.kernel import CompiledKernel
from sims.engines.ground_contact import Indices

_SIMD_WIDTH = 8
"""SIMD width: the number of used slots is a multiple of it."""
_MIN_ELEMENTS_PER_THREAD = 256
"""Minimum number of batch elements per thread."""


class _Job:
    """Batch of stepped elements that the compiled kernel integrates.

    Args:
        lanes: whole batch.
        turn: maximum phase of an oscillation per step in radians; see `batch.step_size`.
        patience: maximum number of steps; see `sims.engines.batch.BatchEngine`.
        machine: compiled kernel.
        jobs: number of threads.
    """

    def __init__(
        self,
        lanes: IntegrationBatch,
        turn: float,
        patience: float,
        machine: CompiledKernel,
        jobs: int,
    ) -> None:
        self._jobs = jobs
        self._lanes = lanes
        self._turn = turn
        self._patience = patience
        self._machine = machine
        count, dimensions = lanes.x.shape
        shared = lanes.steps.strides[0] == 0
        steps = lanes.steps[:1] if shared else lanes.steps
        self._steps = np.ascontiguousarray(steps, dtype=np.float64)
        ones = np.ones(count)
        self._spans = self._steps.max(axis=1, initial=0.0) * ones
        self._planned = np.count_nonzero(self._steps, axis=1) * ones
        self._inputs = _stacked(list(lanes.inputs.values()), self._steps.shape[1])
        self._mass = _column(lanes.system.mass(lanes.theta, lanes.constants), count)
        self._ground = _ground(lanes)
        records = self._steps.shape[1] // lanes.steps_per_sample + 1
        self._kept = np.empty((count, records, 3 * dimensions))
        hidden = np.ceil(lanes.system.fastest * self._spans / turn)
        self._parts = np.clip(hidden, 1.0, MAX_STEP_DIVISIONS)
        self._longest = np.empty(count)
        self._x = np.ascontiguousarray(lanes.x, dtype=np.float64)
        self._v = np.ascontiguousarray(lanes.v, dtype=np.float64)

    def motion(self) -> Trajectories:
        """Return the recorded trajectories."""
        x, v, a = np.split(self._kept, 3, axis=2)
        return Trajectories(x, v, a)

    def step(self, chosen: Indices, effects: Sequence[tuple[Effect, Array]]) -> bool:
        """Step the elements `chosen`, on which exactly these effects act.

        Args:
            chosen: (n,) indices of the elements.
            effects: active effects with their coefficients (K, L, 1).

        Returns:
            Whether system and effects can be compiled; if not, nothing is done.
        """
        lanes = self._lanes
        made = compilability.get_compiled_model(lanes, chosen, [effect for effect, _ in effects])
        if made is None:
            return False
        columns = [lanes.theta[chosen], *(c[chosen] for c in lanes.constants.values())]
        columns += [c[:, chosen, 0].T for _, c in effects]
        parameters = np.concatenate(columns, axis=1)
        work = BatchArrays(
            order=chosen.astype(np.int64),
            parameters=np.ascontiguousarray(parameters, dtype=np.float64),
            mass=self._mass,
            x=self._x,
            v=self._v,
            steps=self._steps,
            inputs=self._inputs,
            longest=self._longest,
            planned=self._planned,
            ground=self._ground,
            every=lanes.steps_per_sample,
            patience=self._patience,
            kept=self._kept,
        )
        self._machine.choose_step_divisions(
            made.program,
            work,
            made.allocate_buffers(),
            _width(work),
            self._spans,
            self._turn,
            self._parts,
        )
        parts = self._parts[chosen]
        spans = self._spans[chosen]
        if lanes.system.bends:
            # The fine steps that hidden states need count as planned steps.
            self._planned[chosen] *= parts
        # Slightly longer than the part, so that rounding does not leave a tiny step after the last
        # one.
        self._longest[chosen] = np.where(parts > 1, spans / parts * (1.0 + 1e-9), spans)
        # Elements with many steps begin first; the others fill the remaining slots meanwhile.
        order = np.argsort(-parts, kind="stable")
        apart = len(order)
        if made.has_no_events and len(self._steps) == 1 and self._patience >= 1.0:
            apart = int(np.count_nonzero(parts > 1))
        self._shared(self._machine.step_block, made, _some(work, order[:apart]))
        self._shared(self._machine.step_in_lockstep, made, _some(work, order[apart:]))
        return True

    def _shared(self, way: Callable[..., None], made: CompiledModel, work: BatchArrays) -> None:
        """Make all steps, on several threads if there are enough elements."""
        lanes = len(work.order)
        count = min(self._jobs, max(lanes // _MIN_ELEMENTS_PER_THREAD, 1))
        # Every thread gets some elements with many steps and its own buffers. No two threads write
        # the same element, and the result of an element does not depend on any other.
        works = [_some(work, np.arange(k, lanes, count)) for k in range(count)] if lanes else []
        if count == 1:
            for part in works:
                way(made.program, part, made.allocate_buffers(), _width(part))
            return
        with ThreadPoolExecutor(count) as threads:
            done = [
                threads.submit(way, made.program, part, made.allocate_buffers(), _width(part))
                for part in works
            ]
        for one in done:
            one.result()


def _some(work: BatchArrays, places: Indices) -> BatchArrays:
    """Return the work on the elements at these places of its order."""
    if len(places) == len(work.order) and (places == np.arange(len(places))).all():
        return work
    return work._replace(order=work.order[places], parameters=work.parameters[places])


def _width(work: BatchArrays) -> int:
    """Return the number of slots in use."""
    return min(BLOCK_WIDTH, -(-len(work.order) // _SIMD_WIDTH) * _SIMD_WIDTH)


def _column(values: Array, count: int) -> Array:
    return np.ascontiguousarray(np.broadcast_to(values, (count, 1))[:, 0], dtype=np.float64)


def _stacked(values: list[Array], steps: int) -> Array:
    """Return the inputs (U, L or 1, S), with one row if all elements share it."""
    if not values:
        return np.zeros((0, 1, steps))
    if all(value.strides[0] == 0 for value in values):
        values = [value[:1] for value in values]
    return np.ascontiguousarray(np.stack(values), dtype=np.float64)


def _ground(lanes: IntegrationBatch) -> Array:
    """Return the ground parameters (4, L), rows as in `sims.engines.compiled.data_layout`."""
    count = len(lanes.x)
    ground = np.zeros((4, count))
    system = lanes.system
    if system.bounces:
        friction = system.friction(lanes.constants)
        grip = system.grip(lanes.constants)
        ground[0] = _column(system.floor(lanes.constants), count)
        ground[1] = _column(system.restitution(lanes.theta), count)
        if friction is not None:
            ground[2] = _column(friction, count)
        if grip is not None:
            ground[3] = 1.0 - _column(grip, count)
    return ground


def step_batch(
    lanes: IntegrationBatch, turn: float, patience: float, machine: CompiledKernel, jobs: int = 1
) -> tuple[Trajectories, Indices]:
    """Integrate stepped elements on the compiled kernel.

    Args:
        lanes: batch of elements that are all stepped.
        turn: maximum phase of an oscillation per step in radians.
        patience: maximum number of steps of an element, as a multiple of the planned ones.
        machine: compiled kernel.
        jobs: number of threads.

    Returns:
        The trajectories, and the indices of elements left out because their effects cannot be
        compiled.
    """
    job = _Job(lanes, turn, patience, machine, jobs)
    left = [chosen for chosen, effects in _groups(lanes) if not job.step(chosen, effects)]
    return job.motion(), np.sort(np.concatenate([np.empty(0, dtype=np.intp), *left]))


def _groups(lanes: IntegrationBatch) -> list[tuple[Indices, list[tuple[Effect, Array]]]]:
    """Return groups of elements (n,) with the same active effects, and these effects."""
    hooks = (Force, Friction, Contact)
    there: list[tuple[Effect, Array]] = [(e, c) for e, c in lanes.effects if isinstance(e, hooks)]
    on = [is_active(c) for _, c in there]
    if not on:
        return [(np.arange(len(lanes.x)), [])]
    patterns = np.ascontiguousarray(np.array(on).T)
    # Most calls have one group, and NumPy's search for equal rows costs as much as a few elements.
    if (patterns == patterns[0]).all():
        groups = {0: np.arange(len(patterns))}
    else:
        lanes_of: dict[bytes, list[int]] = {}
        for lane, pattern in enumerate(patterns):
            lanes_of.setdefault(pattern.tobytes(), []).append(lane)
        groups = {members[0]: np.array(members) for members in lanes_of.values()}
    return [
        (members, [pair for pair, is_on in zip(there, patterns[first], strict=True) if is_on])
        for first, members in groups.items()
    ]
