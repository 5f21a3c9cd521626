"""Time, inputs and recorded states of a batch element in its slot of a block."""

from __future__ import annotations

import numpy as np

from sims.engines.compiled.data_layout import (
    BEGINS,
    DIMENSIONS,
    EVENTS,
    FIRST,
    FLOOR,
    GOAL,
    IN_P,
    IN_U,
    K1,
    LANE,
    LEFT,
    LEVEL,
    LIMIT,
    LONGEST,
    MASS,
    NOTHING,
    PLACE,
    STARTS,
    STEP,
    TAKEN,
    TRY,
    BatchArrays,
    BlockBuffers,
    ProgramArrays,
    T,
    V,
    X,
)


def load_element(
    program: ProgramArrays, work: BatchArrays, block: BlockBuffers, i: int, place: int
) -> None:
    """Load an element into a slot, at the beginning of its run.

    Args:
        program: program of the system and its effects.
        work: batch of elements.
        block: buffers of the slots.
        i: index of the slot.
        place: index of the element in `work.order`.
    """
    a = block.a
    n = block.n
    d = program.flags[DIMENSIONS]
    lane = work.order[place]
    for row in range(FIRST):
        a[row, i] = 0.0
    n[:, i] = 0
    n[PLACE, i] = place
    n[LANE, i] = lane
    n[GOAL, i] = NOTHING
    n[BEGINS, i] = 1
    for k in range(d):
        a[X + k, i] = work.x[lane, k]
        a[V + k, i] = work.v[lane, k]
    a[LONGEST, i] = work.longest[lane]
    a[LIMIT, i] = work.longest[lane]
    a[TRY, i] = np.inf
    a[MASS, i] = work.mass[lane]
    a[LEVEL, i] = work.ground[FLOOR, lane]
    a[LEFT, i] = work.steps[lane if work.steps.shape[0] > 1 else 0, 0]
    first = program.rows[IN_P]
    for p in range(work.parameters.shape[1]):
        block.r[first + p, i] = work.parameters[place, p]
    set_inputs(program, work, block, i)


def set_inputs(program: ProgramArrays, work: BatchArrays, block: BlockBuffers, i: int) -> None:
    """Set the inputs of the element's step; after the last step, those of the last step.

    Args:
        program: program of the system and its effects.
        work: batch of elements.
        block: buffers of the slots.
        i: index of the slot.
    """
    first = program.rows[IN_U]
    step = min(block.n[STEP, i], work.steps.shape[1] - 1)
    row = block.n[LANE, i] if work.inputs.shape[1] > 1 else 0
    for u in range(work.inputs.shape[0]):
        block.r[first + u, i] = work.inputs[u, row, step]


def record_and_check_remaining(
    program: ProgramArrays, work: BatchArrays, block: BlockBuffers, i: int
) -> bool:
    """Record the state of an element that begins a step at a sample time.

    Args:
        program: program of the system and its effects.
        work: batch of elements.
        block: buffers of the slots.
        i: index of the slot.

    Returns:
        Whether the element has further steps.
    """
    a = block.a
    n = block.n
    step = n[STEP, i]
    if n[BEGINS, i] != 0:
        n[BEGINS, i] = 0
        if step % work.every == 0:
            record_state(program, work, block, i, step // work.every)
        if step == work.steps.shape[1]:
            return False
    if work.patience < np.inf and a[LEFT, i] > 0.0:
        a[TAKEN, i] += 1.0
        if a[TAKEN, i] > work.patience * work.planned[n[LANE, i]]:
            # Failed elements are recognised by their last recorded state.
            work.kept[n[LANE, i], work.kept.shape[1] - 1, :] = np.nan
            return False
    return True


def record_state(
    program: ProgramArrays, work: BatchArrays, block: BlockBuffers, i: int, record: int
) -> None:
    """Record the element's state.

    Args:
        program: program of the system and its effects.
        work: batch of elements.
        block: buffers of the slots.
        i: index of the slot.
        record: index of the record.
    """
    a = block.a
    d = program.flags[DIMENSIONS]
    lane = block.n[LANE, i]
    for k in range(d):
        work.kept[lane, record, k] = a[X + k, i]
        work.kept[lane, record, d + k] = a[V + k, i]
        work.kept[lane, record, 2 * d + k] = a[K1 + k, i]


def next_step(program: ProgramArrays, work: BatchArrays, block: BlockBuffers, i: int) -> None:
    """Advance the element to its next planned step.

    Args:
        program: program of the system and its effects.
        work: batch of elements.
        block: buffers of the slots.
        i: index of the slot.
    """
    a = block.a
    n = block.n
    row = n[LANE, i] if work.steps.shape[0] > 1 else 0
    step = n[STEP, i] + 1
    n[STEP, i] = step
    n[BEGINS, i] = 1
    n[EVENTS, i] = 0
    a[STARTS, i] += work.steps[row, step - 1]
    a[T, i] = a[STARTS, i]
    a[LEFT, i] = work.steps[row, step] if step < work.steps.shape[1] else 0.0
    set_inputs(program, work, block, i)
