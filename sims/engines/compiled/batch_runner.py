"""Run a batch on the compiled kernel: group elements by active effects and prepare arrays."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from sims.core.effect import Contact, Effect, Force, Friction
from sims.core.engine import IntegrationBatch, Trajectories
from sims.core.simulator import Array
from sims.engines.compiled.compilability import get_force_program
from sims.engines.compiled.data_layout import DRY, GUIDED, BatchArrays
from sims.engines.compiled.force_program import ForceProgram, NumpyForceProgram
from sims.engines.compiled.kernel import get_kernel
from sims.engines.compiled.kernel_entry import FLY_ELEMENTS, STEP_BLOCK, STEP_IN_LOCKSTEP
from sims.engines.compiled.step_size import MAX_STEP_DIVISIONS
from sims.engines.ground_contact import Indices
from sims.engines.time_grid import is_active

_SIMD_WIDTH = 8
"""SIMD width: the number of used slots is a multiple of it."""
_MIN_ELEMENTS_PER_THREAD = 256
"""Minimum number of batch elements per thread."""


def integrate_batch(
    lanes: IntegrationBatch, turn: float, patience: float, jobs: int
) -> Trajectories:
    """Integrate a batch on the compiled kernel.

    Args:
        lanes: batch to integrate.
        turn: maximum phase of an oscillation per step in radians.
        patience: maximum number of steps of an element, as a multiple of the planned ones.
        jobs: number of threads.

    Returns:
        The trajectories.
    """
    runner = _BatchRunner(lanes, turn, patience, jobs)
    for chosen, effects in _group_by_effects(lanes):
        runner.integrate(chosen, effects)
    return Trajectories(*np.split(runner.records, 3, axis=2))


class _BatchRunner:
    """Arrays of a batch that the compiled kernel integrates.

    Attributes:
        records: (L, R, 3 D) recorded positions, velocities and accelerations.

    Args:
        lanes: whole batch.
        turn: maximum phase of an oscillation per step in radians; see `step_size`.
        patience: maximum number of steps; see `sims.engines.batch.BatchEngine`.
        jobs: number of threads.
    """

    def __init__(self, lanes: IntegrationBatch, turn: float, patience: float, jobs: int) -> None:
        self._kernel = get_kernel()
        self._jobs = jobs
        self._lanes = lanes
        self._turn = turn
        self._patience = patience
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
        record_count = self._steps.shape[1] // lanes.steps_per_sample + 1
        self.records = np.empty((count, record_count, 3 * dimensions))
        self._longest = self._spans.copy()
        self._x = np.ascontiguousarray(lanes.x, dtype=np.float64)
        self._v = np.ascontiguousarray(lanes.v, dtype=np.float64)

    def integrate(self, chosen: Indices, effects: Sequence[tuple[Effect, Array]]) -> None:
        """Integrate some elements.

        Args:
            chosen: (n,) indices of the elements.
            effects: effects that act on them, with their coefficients (K, L, 1).
        """
        lanes = self._lanes
        program = get_force_program(lanes, chosen, [effect for effect, _ in effects])
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
            kept=self.records,
        )
        if lanes.system.uniform and not any(isinstance(e, (Force, Friction)) for e, _ in effects):
            self._run(FLY_ELEMENTS, program, work)
        else:
            self._step(program, work)

    def _step(self, program: ForceProgram | NumpyForceProgram, work: BatchArrays) -> None:
        """Integrate elements in steps."""
        chosen = work.order
        all_parts = np.ceil(self._lanes.system.fastest * self._spans / self._turn)
        all_parts = np.clip(all_parts, 1.0, MAX_STEP_DIVISIONS)
        width = _width(program, work)
        prepared = program.prepare(width)
        self._kernel.choose_step_divisions(
            prepared.arrays, work, prepared.block, width, self._spans, self._turn, all_parts
        )
        prepared.raise_error()
        parts = all_parts[chosen]
        spans = self._spans[chosen]
        if self._lanes.system.bends:
            # The fine steps that hidden states need count as planned steps.
            self._planned[chosen] *= parts
        # Slightly longer than the part, so that rounding does not leave a tiny step after the last
        # one.
        self._longest[chosen] = np.where(parts > 1, spans / parts * (1.0 + 1e-9), spans)
        # Elements with many steps begin first; the others fill the remaining slots meanwhile.
        order = np.argsort(-parts, kind="stable")
        separate = len(order)
        has_events = program.arrays.flags[DRY:GUIDED].any()
        if not has_events and len(self._steps) == 1 and self._patience >= 1.0:
            separate = int(np.count_nonzero(parts > 1))
        self._run(STEP_BLOCK, program, _select(work, order[:separate]))
        self._run(STEP_IN_LOCKSTEP, program, _select(work, order[separate:]))

    def _run(
        self, function: int, program: ForceProgram | NumpyForceProgram, work: BatchArrays
    ) -> None:
        """Run a function of the kernel, on several threads if there are enough elements."""
        count = len(work.order)
        threads = min(self._jobs, max(count // _MIN_ELEMENTS_PER_THREAD, 1))

        def run(part: BatchArrays) -> None:
            width = _width(program, part)
            prepared = program.prepare(width)
            self._kernel.integrate(function, prepared.arrays, part, prepared.block, width)
            prepared.raise_error()

        # Every thread gets some elements with many steps and its own buffers. No two threads write
        # the same element, and the result of an element does not depend on any other.
        parts = [_select(work, np.arange(k, count, threads)) for k in range(threads)]
        if not count:
            return
        if threads == 1:
            run(work)
            return
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(run, parts))


def _select(work: BatchArrays, places: Indices) -> BatchArrays:
    """Return the work on the elements at these places of its order."""
    if len(places) == len(work.order) and (places == np.arange(len(places))).all():
        return work
    return work._replace(order=work.order[places], parameters=work.parameters[places])


def _width(program: ForceProgram | NumpyForceProgram, work: BatchArrays) -> int:
    """Return the number of slots in use."""
    needed = -(-len(work.order) // _SIMD_WIDTH) * _SIMD_WIDTH
    return min(program.block_width, needed)


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


def _group_by_effects(lanes: IntegrationBatch) -> list[tuple[Indices, list[tuple[Effect, Array]]]]:
    """Return groups of elements (n,) with the same active effects, and these effects."""
    hooks = (Force, Friction, Contact)
    there: list[tuple[Effect, Array]] = [(e, c) for e, c in lanes.effects if isinstance(e, hooks)]
    on = [is_active(c)[:, 0] for _, c in there]
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
