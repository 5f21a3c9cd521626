"""Load batch elements into the slots of a block, set clocks and inputs, and record their states."""

from __future__ import annotations

import numpy as np

from sims.engines.compiled.data_layout import (
    DIMENSIONS,
    ELEMENT,
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
    PATIENCE,
    PENDING_EVENT,
    REMAINING_TIME,
    STEP_COUNT,
    STEP_INDEX,
    STEP_LIMIT,
    Block,
    T,
    V,
    X,
)
from sims.engines.compiled.interpreter import nan_maximum


def load_element(block: Block, i: int, order_index: int) -> None:
    """Load an element into a slot, at the beginning of its run.

    A slot takes the next element when its element has finished. All its numbers are reset to zero,
    except the few that have another initial value.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. A vector has one row per coordinate: `X + k` is
            that of coordinate k. `block.rows[NAME]` is the register of an input or an output, the
            first one if there are several. `block.flags` states what the system has, such as dry
            friction.
        i: index of the slot, the column of the batch element.
        order_index: index of the element in `block.order`.
    """
    a = block.a
    n = block.n
    d = block.flags[DIMENSIONS]
    element = block.order[order_index]
    for row in range(FIRST_VECTOR):  # the rows with a single number
        a[row, i] = 0.0
    n[:, i] = 0
    n[ORDER_INDEX, i] = order_index
    n[ELEMENT, i] = element
    n[PENDING_EVENT, i] = NO_EVENT
    n[IS_STEP_START, i] = 1
    for k in range(d):
        a[X + k, i] = block.x[element, k]
        a[V + k, i] = block.v[element, k]
    a[MAX_STEP, i] = block.max_steps[element]
    a[STEP_LIMIT, i] = block.max_steps[element]
    a[EVENT_DELAY, i] = np.inf
    a[MASS, i] = block.mass[element]
    a[FLOOR_LEVEL, i] = block.ground[FLOOR, element]
    # Steps that are the same for all elements are stored in a single row.
    a[REMAINING_TIME, i] = block.steps[element if block.steps.shape[0] > 1 else 0, 0]
    first = block.rows[IN_P]
    for p in range(block.parameters.shape[1]):
        block.r[first + p, i] = block.parameters[order_index, p]
    set_inputs(block, i)


def set_inputs(block: Block, i: int) -> None:
    """Copy the inputs of an element's present step to the registers of the force program.

    After the last step, they are those of the last step.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. `block.rows[NAME]` is the register of an input or
            an output, the first one if there are several.
        i: index of the slot, the column of the batch element.
    """
    first = block.rows[IN_U]
    step = min(block.n[STEP_INDEX, i], block.steps.shape[1] - 1)
    # Inputs that are the same for all elements are stored in a single row.
    row = block.n[ELEMENT, i] if block.inputs.shape[1] > 1 else 0
    for u in range(block.inputs.shape[0]):
        block.r[first + u, i] = block.inputs[u, row, step]


def record_and_check_remaining(block: Block, i: int) -> bool:
    """Record the state of an element at a sample time, and return whether it has further steps.

    It is called before every attempt of a step. Nothing is recorded unless a planned step begins
    there (a step may be divided). An element that needs more attempts than `PATIENCE` allows is
    abandoned: its last record becomes NaN, by which the caller recognises the failure.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`.
        i: index of the slot, the column of the batch element.

    Returns:
        False if the element is finished or abandoned.
    """
    a = block.a
    n = block.n
    step = n[STEP_INDEX, i]
    if n[IS_STEP_START, i] != 0:
        n[IS_STEP_START, i] = 0
        if step % block.steps_per_record == 0:
            record_state(block, i, step // block.steps_per_record)
        if step == block.steps.shape[1]:
            return False
    # Steps of zero length do not count, as in the number of planned steps.
    if block.limits[PATIENCE] < np.inf and a[REMAINING_TIME, i] > 0.0:
        a[STEP_COUNT, i] += 1.0
        if a[STEP_COUNT, i] > block.limits[PATIENCE] * block.planned_counts[n[ELEMENT, i]]:
            block.records[n[ELEMENT, i], block.records.shape[1] - 1, :] = np.nan
            return False
    return True


def record_state(block: Block, i: int, record: int) -> None:
    """Record position, velocity and acceleration of the element in slot i.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. A vector has one row per coordinate: `X + k` is
            that of coordinate k. `block.flags` states what the system has, such as dry friction.
        i: index of the slot, the column of the batch element.
        record: index of the record.
    """
    a = block.a
    d = block.flags[DIMENSIONS]
    element = block.n[ELEMENT, i]
    for k in range(d):
        block.records[element, record, k] = a[X + k, i]
        block.records[element, record, d + k] = a[V + k, i]
        block.records[element, record, 2 * d + k] = a[K1 + k, i]


def shift_time(block: Block, i: int, seconds: float) -> float:
    """Correct the element's clock at an event, by at most one step, and return the correction.

    A step that should end at an event ends there only approximately. The caller computes by how
    much, and moves the state by the same time. Later steps have correspondingly less time left.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`.
        i: index of the slot, the column of the batch element.
        seconds: time correction in seconds; NaN counts as zero.

    Returns:
        The applied correction in seconds.
    """
    step = block.a[MAX_STEP, i]
    if seconds != seconds:  # NaN
        seconds = 0.0
    seconds = min(max(seconds, -step), step)
    block.a[T, i] += seconds
    block.a[REMAINING_TIME, i] = nan_maximum(block.a[REMAINING_TIME, i] - seconds, 0.0)
    return seconds
