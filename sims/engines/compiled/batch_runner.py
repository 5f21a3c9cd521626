"""Run a batch on the compiled engine: group elements by active effects and prepare arrays."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import compress
from typing import Any

import numpy as np

from sims.core.effect import Contact, Effect, Force, Friction, HiddenStateEffect
from sims.core.engine import IntegrationBatch, Trajectories
from sims.core.simulator import Array, Indices
from sims.core.system import StateSnapshot
from sims.engines.compiled.data_layout import (
    FLOOR,
    GROUND_FRICTION,
    MIN_REMAINING_SHARE,
    RESTITUTION,
    BatchArrays,
    Block,
    BlockBuffers,
    ProgramArrays,
    allocate_block,
    check_block,
)
from sims.engines.compiled.element_stepping import COMPILED, step_elements
from sims.engines.compiled.force_program import (
    ForceProgram,
    compute_own_inertia,
    get_force_program,
)
from sims.engines.compiled.step_size import MAX_STEP_DIVISIONS
from sims.engines.time_grid import is_active

_SIMD_WIDTH = 8
"""SIMD width: the number of used slots is a multiple of it."""
_MIN_ELEMENTS_PER_THREAD = 256
"""Minimum number of batch elements per thread."""


def integrate_batch(
    batch: IntegrationBatch, max_phase: float, patience: float, jobs: int
) -> Trajectories:
    """Integrate the motion of all elements of a batch in machine code.

    Elements with the same active effects have the same force program (see `force_program`), so
    they are grouped by effects, and each group is integrated with its program. A hidden state of an
    effect (such as the position of a load on an elastic gear, whose motor alone is measured) is one
    more coordinate, so that groups with hidden states need arrays of their own.

    Args:
        batch: batch to integrate.
        max_phase: maximum phase of an oscillation per step in radians; see `step_size`.
        patience: maximum number of steps of an element, as a multiple of the planned ones.
        jobs: number of threads.

    Returns:
        Positions, velocities and accelerations of the system's own coordinates.
    """
    # Loaded first, so that an error of the compiler is not reported as an error of the system.
    COMPILED.load()
    all_elements = _make_arrays(batch, [], max_phase, patience)
    count, record_count, _ = all_elements.records.shape
    # A record is position, velocity and acceleration, one after the other. This is a view of the
    # records, which the machine code fills in.
    trajectories = all_elements.records.reshape(count, record_count, 3, -1)
    for elements, effects in _group_by_effects(batch):
        arrays = all_elements._replace(order=elements.astype(np.int64))
        hidden = [(e, c[:, elements]) for e, c in effects if isinstance(e, HiddenStateEffect)]
        # With hidden states, records are wider; the system's own coordinates are copied below.
        if hidden:
            arrays = _make_arrays(batch.select(elements), hidden, max_phase, patience)
        program = get_force_program(batch, elements, [effect for effect, _ in effects])
        # Parameters of the program: the system's parameters and constants, then the coefficients.
        columns = [batch.theta[elements], *(c[elements] for c in batch.constants.values())]
        columns += [c[:, elements, 0].T for _, c in effects]
        parameters = np.ascontiguousarray(np.concatenate(columns, axis=1), dtype=np.float64)
        _integrate_group(program, arrays._replace(parameters=parameters), jobs)
        if hidden:
            records = arrays.records.reshape(len(elements), record_count, 3, -1)
            trajectories[elements] = records[..., : batch.x.shape[1]]
    return Trajectories(*np.moveaxis(trajectories, 2, 0))


def _group_by_effects(batch: IntegrationBatch) -> list[tuple[Indices, list[tuple[Effect, Array]]]]:
    """Group the elements by their active effects, since each group needs its own force program.

    Only effects that are part of a force program count: forces, friction, contact laws and hidden
    states. An effect is active in an element if its coefficients there are not all zero; one with a
    hidden state is off, by definition, unless its first coefficient is above zero.

    Args:
        batch: batch of L elements, with the K coefficients (K, L, 1) of their effects.

    Returns:
        Indices (n,) of each group's elements, and its effects with coefficients (K, L, 1).
    """
    effects: list[tuple[Effect, Array]] = [
        (e, c)
        for e, c in batch.effects
        if isinstance(e, Force | Friction | Contact | HiddenStateEffect)
    ]
    if not effects:
        return [(np.arange(len(batch.x)), [])]
    # (L, number of effects): whether each effect acts in each element.
    patterns = np.stack(
        [
            c[0, :, 0] > 0 if isinstance(e, HiddenStateEffect) else is_active(c)[:, 0]
            for e, c in effects
        ],
        axis=1,
    )
    # Most calls have one group, and NumPy's search for equal rows costs as much as a few elements.
    if (patterns == patterns[0]).all():
        groups = [np.arange(len(patterns))]
    else:
        elements_of: dict[bytes, list[int]] = {}
        for element, pattern in enumerate(patterns):
            elements_of.setdefault(pattern.tobytes(), []).append(element)
        groups = [np.array(members) for members in elements_of.values()]
    return [(members, list(compress(effects, patterns[members[0]]))) for members in groups]


def _make_arrays(
    batch: IntegrationBatch,
    hidden: list[tuple[HiddenStateEffect, Array]],
    max_phase: float,
    patience: float,
) -> BatchArrays:
    """Convert a batch to the contiguous arrays that the machine code reads.

    All elements are selected, without parameters. If all elements have the same steps, one row of
    steps is stored for all.

    Args:
        batch: system, initial states, inputs and effects of all elements.
        hidden: effects with a hidden state in all L elements, with their K coefficients (K, L, 1).
            The hidden states become the last coordinates.
        max_phase: maximum phase of an oscillation per step in radians; see `step_size`.
        patience: maximum number of steps of an element, as a multiple of the planned ones.
    """
    count, system = len(batch.x), batch.system
    # `fastest` is the maximum angular frequency of oscillations that forces do not show, rad/s.
    x, v, fastest = batch.x, batch.v, system.fastest
    if hidden:
        start = np.zeros((count, 1))
        inputs = {name: values[:, :1] for name, values in batch.inputs.items()}
        moment = StateSnapshot(system, batch.theta, batch.constants, start, x, v, inputs)
        states = [effect.begin(c, moment) for effect, c in hidden]
        x = np.concatenate([x, *(state.x for state in states)], axis=1)
        v = np.concatenate([v, *(state.v for state in states)], axis=1)
        fastest = max(fastest, *(effect.fastest for effect, _ in hidden))
    # A broadcast array, whose rows are the same memory, has a stride of zero.
    are_steps_shared = batch.steps.strides[0] == 0
    steps = np.ascontiguousarray(
        batch.steps[:1] if are_steps_shared else batch.steps, dtype=np.float64
    )
    ones = np.ones(count)
    longest_steps = steps.max(axis=1, initial=0.0) * ones
    # Minimum number of parts of a step in which the phase of these oscillations is small enough.
    divisions = np.ceil(fastest * longest_steps / max_phase)
    inertia = compute_own_inertia(system, batch.theta, batch.constants, hidden)
    record_count = steps.shape[1] // batch.steps_per_sample + 1  # with the initial state
    return BatchArrays(
        order=np.arange(count),
        parameters=np.zeros((0, 0)),  # set later for each group of elements
        mass=_to_column(inertia, count),
        x=np.ascontiguousarray(x, dtype=np.float64),
        v=np.ascontiguousarray(v, dtype=np.float64),
        steps=steps,
        inputs=_stack_inputs(list(batch.inputs.values()), steps.shape[1]),
        max_steps=longest_steps,
        planned_counts=np.count_nonzero(steps, axis=1) * ones,
        divisions=np.clip(divisions, 1.0, MAX_STEP_DIVISIONS),
        ground=_get_ground_parameters(batch),
        limits=np.array([patience, max_phase]),
        records=np.empty((count, record_count, 3 * x.shape[1])),
        steps_per_record=batch.steps_per_sample,
    )


def _integrate_group(program: ForceProgram, arrays: BatchArrays, jobs: int) -> None:
    """Integrate elements with equal effects, on several threads if there are enough of them.

    Args:
        program: force program of the effects.
        arrays: arrays of the batch, with the selected elements.
        jobs: maximum number of threads.
    """
    count = len(arrays.order)
    threads = min(jobs, max(count // _MIN_ELEMENTS_PER_THREAD, 1))

    def run(part: BatchArrays) -> None:
        """Integrate one thread's part of the elements, with buffers of its own.

        The number of slots is at most the number of elements, rounded up to whole SIMD vectors.
        """
        padded_count = -(-len(part.order) // _SIMD_WIDTH) * _SIMD_WIDTH
        width = min(program.program.block_width, padded_count)
        prepared, layout = program.prepare(width)
        integrate_elements(layout, part, allocate_block(prepared.r), width)
        # An exception in a user's force cannot pass through machine code; it is raised here.
        prepared.raise_error()

    # Every thread has its own buffers. No two threads write the same element, and the result of an
    # element does not depend on any other.
    parts = [_select_elements(arrays, np.arange(k, count, threads)) for k in range(threads)]
    if threads > 1:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(run, parts))
    else:
        run(arrays)


def integrate_elements(
    program: ProgramArrays,
    arrays: BatchArrays,
    buffers: BlockBuffers,
    w: int,
) -> None:
    """Integrate all elements of a batch.

    Args:
        program: program of the system and its effects.
        arrays: batch of elements.
        buffers: buffers of the slots, each of which holds one batch element at a time.
        w: number of slots in use.

    Raises:
        ValueError: an array is not as specified.
    """
    # `Block` has its integers last, and `steps_per_record` is the last field of `arrays`.
    fields: tuple[Any, ...] = *program, *arrays[:-1], *buffers, arrays.steps_per_record, w
    block = Block(*fields)
    check_block(block)
    COMPILED.bind(step_elements, *block)()


def _select_elements(arrays: BatchArrays, places: Indices) -> BatchArrays:
    """Return the arrays with the elements at these places of their order."""
    if len(places) == len(arrays.order) and (places == np.arange(len(places))).all():
        return arrays
    return arrays._replace(order=arrays.order[places], parameters=arrays.parameters[places])


def _to_column(values: Array, count: int) -> Array:
    return np.ascontiguousarray(np.broadcast_to(values, (count, 1))[:, 0], dtype=np.float64)


def _stack_inputs(values: list[Array], steps: int) -> Array:
    """Return the inputs as one array (U, L, S), or (U, 1, S) if all elements have the same inputs.

    Args:
        values: U inputs (L, S) in L elements and S steps. An input that is the same for all
            elements is a broadcast array, whose first stride is zero.
        steps: number S of steps.
    """
    if not values:
        return np.zeros((0, 1, steps))
    if all(value.strides[0] == 0 for value in values):
        values = [value[:1] for value in values]
    return np.ascontiguousarray(np.stack(values), dtype=np.float64)


def _get_ground_parameters(batch: IntegrationBatch) -> Array:
    """Return the parameters (4, L) of the ground for each of L elements.

    The rows are the height of the ground, the coefficients of restitution and friction, and the
    minimum share of the tangential speed that remains after an impact (1 minus the `grip`, the
    largest share that an impact removes). All are zero for systems that do not bounce.

    Args:
        batch: Elements to integrate.
    """
    count = len(batch.x)
    ground = np.zeros((4, count))
    system = batch.system
    if system.bounces:
        friction = system.friction(batch.constants)
        grip = system.grip(batch.constants)
        ground[FLOOR] = _to_column(system.floor(batch.constants), count)
        ground[RESTITUTION] = _to_column(system.restitution(batch.theta), count)
        if friction is not None:
            ground[GROUND_FRICTION] = _to_column(friction, count)
        if grip is not None:
            ground[MIN_REMAINING_SHARE] = 1.0 - _to_column(grip, count)
    return ground
