"""Run a batch on the compiled kernel: group elements by active effects and prepare arrays."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from sims.core.effect import Contact, Effect, Force, Friction
from sims.core.engine import IntegrationBatch, Trajectories
from sims.core.simulator import Array, Indices
from sims.engines.compiled.data_layout import FRICTION_COORDINATE_COUNT, HAS_FRICTION, BatchArrays
from sims.engines.compiled.force_program import ForceProgram, NumpyForceProgram, get_force_program
from sims.engines.compiled.kernel import get_kernel
from sims.engines.compiled.kernel_entry import FLY_ELEMENTS, STEP_BLOCK, STEP_IN_LOCKSTEP
from sims.engines.compiled.step_size import MAX_STEP_DIVISIONS
from sims.engines.time_grid import is_active

_SIMD_WIDTH = 8
"""SIMD width: the number of used slots is a multiple of it."""
_MIN_ELEMENTS_PER_THREAD = 256
"""Minimum number of batch elements per thread."""


def integrate_batch(
    batch: IntegrationBatch, max_phase: float, patience: float, jobs: int
) -> Trajectories:
    """Integrate a batch on the compiled kernel.

    Args:
        batch: batch to integrate.
        max_phase: maximum phase of an oscillation per step in radians.
        patience: maximum number of steps of an element, as a multiple of the planned ones.
        jobs: number of threads.

    Returns:
        The trajectories.
    """
    runner = _BatchRunner(batch, max_phase, patience, jobs)
    for elements, effects in _group_by_effects(batch):
        runner.integrate(elements, effects)
    return Trajectories(*np.split(runner.records, 3, axis=2))


class _BatchRunner:
    """Arrays of a batch that the compiled kernel integrates.

    Attributes:
        records: (L, R, 3 D) recorded positions, velocities and accelerations.

    Args:
        batch: whole batch.
        max_phase: maximum phase of an oscillation per step in radians; see `step_size`.
        patience: maximum number of steps; see `sims.engines.batch.BatchEngine`.
        jobs: number of threads.
    """

    def __init__(
        self, batch: IntegrationBatch, max_phase: float, patience: float, jobs: int
    ) -> None:
        """Convert the batch to the contiguous arrays that the kernel reads.

        If all elements have the same steps, one row of steps is stored for all of them.
        `_spans` (L,) is the longest step of each element in seconds, `_planned_counts` (L,)
        its number of steps that are not zero.
        """
        self._kernel = get_kernel()
        self._jobs = jobs
        self._batch = batch
        self._max_phase = max_phase
        self._patience = patience
        count, dimensions = batch.x.shape
        shared = batch.steps.strides[0] == 0
        steps = batch.steps[:1] if shared else batch.steps
        self._steps = np.ascontiguousarray(steps, dtype=np.float64)
        ones = np.ones(count)
        self._spans = self._steps.max(axis=1, initial=0.0) * ones
        self._planned_counts = np.count_nonzero(self._steps, axis=1) * ones
        self._inputs = _stack_inputs(list(batch.inputs.values()), self._steps.shape[1])
        self._mass = _to_column(batch.system.mass(batch.theta, batch.constants), count)
        self._ground = _get_ground_parameters(batch)
        record_count = self._steps.shape[1] // batch.steps_per_sample + 1
        self.records = np.empty((count, record_count, 3 * dimensions))
        self._max_steps = self._spans.copy()
        self._x = np.ascontiguousarray(batch.x, dtype=np.float64)
        self._v = np.ascontiguousarray(batch.v, dtype=np.float64)

    def integrate(self, elements: Indices, effects: Sequence[tuple[Effect, Array]]) -> None:
        """Integrate elements that have the same active effects, and write their records.

        Elements of uniform systems without forces or friction by effects fly in closed
        form; others are stepped.

        Args:
            elements: (n,) indices of the elements.
            effects: effects that act on them, with their coefficients (K, L, 1).
        """
        batch = self._batch
        program = get_force_program(batch, elements, [effect for effect, _ in effects])
        columns = [batch.theta[elements], *(c[elements] for c in batch.constants.values())]
        columns += [c[:, elements, 0].T for _, c in effects]
        parameters = np.concatenate(columns, axis=1)
        arrays = BatchArrays(
            order=elements.astype(np.int64),
            parameters=np.ascontiguousarray(parameters, dtype=np.float64),
            mass=self._mass,
            x=self._x,
            v=self._v,
            steps=self._steps,
            inputs=self._inputs,
            max_steps=self._max_steps,
            planned_counts=self._planned_counts,
            ground=self._ground,
            steps_per_record=batch.steps_per_sample,
            patience=self._patience,
            records=self.records,
        )
        if batch.system.uniform and not any(isinstance(e, (Force, Friction)) for e, _ in effects):
            self._run_kernel_function(FLY_ELEMENTS, program, arrays)
        else:
            self._integrate_steps(program, arrays)

    def _integrate_steps(
        self, program: ForceProgram | NumpyForceProgram, arrays: BatchArrays
    ) -> None:
        """Integrate elements in steps, after dividing the steps where an element moves fast.

        `parts` (n,) is the number of parts of each step. Elements without events whose
        steps are not divided run in lockstep, which is faster; the others run in slots that
        take the next element when one is finished.
        """
        elements = arrays.order
        all_parts = np.ceil(self._batch.system.fastest * self._spans / self._max_phase)
        all_parts = np.clip(all_parts, 1.0, MAX_STEP_DIVISIONS)
        width = _count_slots(program, arrays)
        prepared = program.prepare(width)
        self._kernel.choose_step_divisions(
            prepared.arrays, arrays, prepared.block, width, self._spans, self._max_phase, all_parts
        )
        prepared.raise_error()
        parts = all_parts[elements]
        spans = self._spans[elements]
        if self._batch.system.bends:
            # The fine steps that hidden states need count as planned steps.
            self._planned_counts[elements] *= parts
        # Slightly longer than the part, so that rounding does not leave a tiny step after the last
        # one.
        self._max_steps[elements] = np.where(parts > 1, spans / parts * (1.0 + 1e-9), spans)
        # Elements with many steps begin first; the others fill the remaining slots meanwhile.
        order = np.argsort(-parts, kind="stable")
        separate_count = len(order)
        has_events = program.arrays.flags[HAS_FRICTION:FRICTION_COORDINATE_COUNT].any()
        if not has_events and len(self._steps) == 1 and self._patience >= 1.0:
            separate_count = int(np.count_nonzero(parts > 1))
        self._run_kernel_function(
            STEP_BLOCK, program, _select_elements(arrays, order[:separate_count])
        )
        self._run_kernel_function(
            STEP_IN_LOCKSTEP, program, _select_elements(arrays, order[separate_count:])
        )

    def _run_kernel_function(
        self, function: int, program: ForceProgram | NumpyForceProgram, arrays: BatchArrays
    ) -> None:
        """Run a function of the kernel, on several threads if there are enough elements."""
        count = len(arrays.order)
        threads = min(self._jobs, max(count // _MIN_ELEMENTS_PER_THREAD, 1))

        def run(part: BatchArrays) -> None:
            """Run one thread's part of the elements, in separate program buffers."""
            width = _count_slots(program, part)
            prepared = program.prepare(width)
            self._kernel.integrate(function, prepared.arrays, part, prepared.block, width)
            prepared.raise_error()

        # Every thread gets some elements with many steps and its own buffers. No two threads write
        # the same element, and the result of an element does not depend on any other.
        parts = [_select_elements(arrays, np.arange(k, count, threads)) for k in range(threads)]
        if threads > 1:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(run, parts))
        elif count:
            run(arrays)


def _select_elements(arrays: BatchArrays, places: Indices) -> BatchArrays:
    """Return the arrays with the elements at these places of their order."""
    if len(places) == len(arrays.order) and (places == np.arange(len(places))).all():
        return arrays
    return arrays._replace(order=arrays.order[places], parameters=arrays.parameters[places])


def _count_slots(program: ForceProgram | NumpyForceProgram, arrays: BatchArrays) -> int:
    """Return the number of slots in use."""
    padded_count = -(-len(arrays.order) // _SIMD_WIDTH) * _SIMD_WIDTH
    return min(program.block_width, padded_count)


def _to_column(values: Array, count: int) -> Array:
    return np.ascontiguousarray(np.broadcast_to(values, (count, 1))[:, 0], dtype=np.float64)


def _stack_inputs(values: list[Array], steps: int) -> Array:
    """Return the inputs (U, L or 1, S), with one row if all elements share it."""
    if not values:
        return np.zeros((0, 1, steps))
    if all(value.strides[0] == 0 for value in values):
        values = [value[:1] for value in values]
    return np.ascontiguousarray(np.stack(values), dtype=np.float64)


def _get_ground_parameters(batch: IntegrationBatch) -> Array:
    """Return the ground parameters (4, L), rows as in `sims.engines.compiled.data_layout`."""
    count = len(batch.x)
    ground = np.zeros((4, count))
    system = batch.system
    if system.bounces:
        friction = system.friction(batch.constants)
        grip = system.grip(batch.constants)
        ground[0] = _to_column(system.floor(batch.constants), count)
        ground[1] = _to_column(system.restitution(batch.theta), count)
        if friction is not None:
            ground[2] = _to_column(friction, count)
        if grip is not None:
            ground[3] = 1.0 - _to_column(grip, count)
    return ground


def _group_by_effects(batch: IntegrationBatch) -> list[tuple[Indices, list[tuple[Effect, Array]]]]:
    """Group the elements by their active effects, since each group needs its own program.

    Returns:
        Indices (n,) of each group's elements, and its effects with coefficients (K, L, 1).
    """
    effects: list[tuple[Effect, Array]] = [
        (e, c) for e, c in batch.effects if isinstance(e, Force | Friction | Contact)
    ]
    if not effects:
        return [(np.arange(len(batch.x)), [])]
    patterns = np.stack([is_active(c)[:, 0] for _, c in effects], axis=1)
    # Most calls have one group, and NumPy's search for equal rows costs as much as a few elements.
    if (patterns == patterns[0]).all():
        groups = {0: np.arange(len(patterns))}
    else:
        elements_of: dict[bytes, list[int]] = {}
        for element, pattern in enumerate(patterns):
            elements_of.setdefault(pattern.tobytes(), []).append(element)
        groups = {members[0]: np.array(members) for members in elements_of.values()}
    return [
        (members, [pair for pair, is_on in zip(effects, patterns[first], strict=True) if is_on])
        for first, members in groups.items()
    ]
