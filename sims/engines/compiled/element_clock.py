"""Time, inputs and recorded states of a batch element in its slot of a block."""

from __future__ import annotations

import numpy as np

from sims.engines.compiled.data_layout import (
    DIMENSIONS,
    ELEMENT,
    EVENT_COUNT,
    EVENT_DELAY,
    FIRST_VECTOR,
    FLOOR,
    FLOOR_LEVEL,
    IN_P,
    IN_U,
    IS_STEP_START,
    K1,
    MASS,
    MAX_STEP,
    NO_EVENT,
    ORDER_INDEX,
    PENDING_EVENT,
    REMAINING_TIME,
    STEP_COUNT,
    STEP_INDEX,
    STEP_LIMIT,
    STEP_START,
    BatchArrays,
    BlockBuffers,
    ProgramArrays,
    T,
    V,
    X,
)


def load_element(
    program: ProgramArrays, arrays: BatchArrays, block: BlockBuffers, i: int, order_index: int
) -> None:
    """Load an element into a slot, at the beginning of its run.

    A slot is a column of the buffers. It takes the next element when its element has finished.

    Args:
        program: program of the system and its effects.
        arrays: batch of elements.
        block: registers r, numbers a and integers n of the slots; a slot is a column that holds
            one batch element.
        i: index of the slot, the column of the batch element.
        order_index: index of the element in `arrays.order`.
    """
    a = block.a
    n = block.n
    d = program.flags[DIMENSIONS]
    element = arrays.order[order_index]
    for row in range(FIRST_VECTOR):
        a[row, i] = 0.0
    n[:, i] = 0
    n[ORDER_INDEX, i] = order_index
    n[ELEMENT, i] = element
    n[PENDING_EVENT, i] = NO_EVENT
    n[IS_STEP_START, i] = 1
    for k in range(d):
        a[X + k, i] = arrays.x[element, k]
        a[V + k, i] = arrays.v[element, k]
    a[MAX_STEP, i] = arrays.max_steps[element]
    a[STEP_LIMIT, i] = arrays.max_steps[element]
    a[EVENT_DELAY, i] = np.inf
    a[MASS, i] = arrays.mass[element]
    a[FLOOR_LEVEL, i] = arrays.ground[FLOOR, element]
    a[REMAINING_TIME, i] = arrays.steps[element if arrays.steps.shape[0] > 1 else 0, 0]
    first = program.rows[IN_P]
    for p in range(arrays.parameters.shape[1]):
        block.r[first + p, i] = arrays.parameters[order_index, p]
    set_inputs(program, arrays, block, i)


def set_inputs(program: ProgramArrays, arrays: BatchArrays, block: BlockBuffers, i: int) -> None:
    """Set the inputs of the element's step; after the last step, those of the last step.

    Args:
        program: program of the system and its effects.
        arrays: batch of elements.
        block: registers r, numbers a and integers n of the slots; a slot is a column that holds
            one batch element.
        i: index of the slot, the column of the batch element.
    """
    first = program.rows[IN_U]
    step = min(block.n[STEP_INDEX, i], arrays.steps.shape[1] - 1)
    row = block.n[ELEMENT, i] if arrays.inputs.shape[1] > 1 else 0
    for u in range(arrays.inputs.shape[0]):
        block.r[first + u, i] = arrays.inputs[u, row, step]


def record_and_check_remaining(
    program: ProgramArrays, arrays: BatchArrays, block: BlockBuffers, i: int
) -> bool:
    """Record the state of an element that begins a step at a sample time.

    Args:
        program: program of the system and its effects.
        arrays: batch of elements.
        block: registers r, numbers a and integers n of the slots; a slot is a column that holds
            one batch element.
        i: index of the slot, the column of the batch element.

    Returns:
        Whether the element has further steps.
    """
    a = block.a
    n = block.n
    step = n[STEP_INDEX, i]
    if n[IS_STEP_START, i] != 0:
        n[IS_STEP_START, i] = 0
        if step % arrays.steps_per_record == 0:
            record_state(program, arrays, block, i, step // arrays.steps_per_record)
        if step == arrays.steps.shape[1]:
            return False
    if arrays.patience < np.inf and a[REMAINING_TIME, i] > 0.0:
        a[STEP_COUNT, i] += 1.0
        if a[STEP_COUNT, i] > arrays.patience * arrays.planned_counts[n[ELEMENT, i]]:
            # Failed elements are recognised by their last recorded state.
            arrays.records[n[ELEMENT, i], arrays.records.shape[1] - 1, :] = np.nan
            return False
    return True


def record_state(
    program: ProgramArrays, arrays: BatchArrays, block: BlockBuffers, i: int, record: int
) -> None:
    """Record position, velocity and acceleration of the element in slot i.

    Args:
        program: program of the system and its effects.
        arrays: batch of elements.
        block: registers r, numbers a and integers n of the slots; a slot is a column that holds
            one batch element.
        i: index of the slot, the column of the batch element.
        record: index of the record.
    """
    a = block.a
    d = program.flags[DIMENSIONS]
    element = block.n[ELEMENT, i]
    for k in range(d):
        arrays.records[element, record, k] = a[X + k, i]
        arrays.records[element, record, d + k] = a[V + k, i]
        arrays.records[element, record, 2 * d + k] = a[K1 + k, i]


def next_step(program: ProgramArrays, arrays: BatchArrays, block: BlockBuffers, i: int) -> None:
    """Begin the next planned step of the element in slot i, with the inputs of that step.

    A planned step is one of the batch's steps; it may be divided at events such as impacts.

    Args:
        program: program of the system and its effects.
        arrays: batch of elements.
        block: registers r, numbers a and integers n of the slots; a slot is a column that holds
            one batch element.
        i: index of the slot, the column of the batch element.
    """
    a = block.a
    n = block.n
    row = n[ELEMENT, i] if arrays.steps.shape[0] > 1 else 0
    step = n[STEP_INDEX, i] + 1
    n[STEP_INDEX, i] = step
    n[IS_STEP_START, i] = 1
    n[EVENT_COUNT, i] = 0
    a[STEP_START, i] += arrays.steps[row, step - 1]
    a[T, i] = a[STEP_START, i]
    a[REMAINING_TIME, i] = arrays.steps[row, step] if step < arrays.steps.shape[1] else 0.0
    set_inputs(program, arrays, block, i)
