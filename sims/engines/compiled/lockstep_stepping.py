"""Step a block whose elements share their steps and have no events.

They are elements of a smooth program whose steps are not divided. The results are, bit for bit,
those of `sims.engines.compiled.element_stepping`, which checks every element in every step.
"""

from __future__ import annotations

from sims.engines.compiled.accelerations import compute_frictionless_acceleration, evaluate_forces
from sims.engines.compiled.data_layout import (
    CONSTANTS_BEGIN,
    DIMENSIONS,
    FORCES_BEGIN,
    IN_U,
    K1,
    NEXT_V,
    NEXT_X,
    STEP_INDEX,
    STEP_START,
    BatchArrays,
    BlockBuffers,
    H,
    ProgramArrays,
    T,
    V,
    X,
)
from sims.engines.compiled.element_clock import load_element, record_state, set_inputs
from sims.engines.compiled.element_stepping import try_step
from sims.engines.compiled.interpreter import run_instructions


def step_in_lockstep(
    program: ProgramArrays, arrays: BatchArrays, block: BlockBuffers, w: int
) -> None:
    """Make all steps of all elements, w at a time.

    All w elements have the same steps and no events, so that no clock for each element is
    needed. This is the fastest way.

    Args:
        program: program of the system and its effects.
        arrays: batch of elements.
        block: registers r, numbers a and integers n of the slots; a slot is a column that holds
            one batch element.
        w: number of slots in use.
    """
    a = block.a
    step_count = arrays.steps.shape[1]
    for first in range(0, arrays.order.size, w):
        count = min(w, arrays.order.size - first)
        for i in range(w):
            load_element(program, arrays, block, i, first + min(i, count - 1))
        run_instructions(
            program.code, program.ends[CONSTANTS_BEGIN], program.ends[FORCES_BEGIN], block.r, w
        )
        for step in range(step_count + 1):
            evaluate_forces(program, block, w)
            compute_frictionless_acceleration(program, block, w, K1)
            if step % arrays.steps_per_record == 0:
                for i in range(count):
                    record_state(program, arrays, block, i, step // arrays.steps_per_record)
            if step == step_count:
                break
            h = arrays.steps[0, step]
            for i in range(w):
                a[H, i] = h
            try_step(program, block, w)
            accept_step(program, block, w, h)
            set_shared_inputs(program, arrays, block, w, step + 1)


def accept_step(program: ProgramArrays, block: BlockBuffers, w: int, h: float) -> None:
    """Accept the step of h seconds just tried.

    The result of the step becomes the state of all slots.

    Args:
        program: program of the system and its effects.
        block: registers r, numbers a and integers n of the slots; a slot is a column that holds
            one batch element.
        w: number of slots in use.
        h: step size in seconds.
    """
    a = block.a
    for k in range(program.flags[DIMENSIONS]):
        for i in range(w):
            a[X + k, i] = a[NEXT_X + k, i]
            a[V + k, i] = a[NEXT_V + k, i]
    for i in range(w):
        a[STEP_START, i] += h
        a[T, i] = a[STEP_START, i]


def set_shared_inputs(
    program: ProgramArrays, arrays: BatchArrays, block: BlockBuffers, w: int, step: int
) -> None:
    """Set the inputs of this step; after the last step, those of the last step.

    Args:
        program: program of the system and its effects.
        arrays: batch of elements.
        block: registers r, numbers a and integers n of the slots; a slot is a column that holds
            one batch element.
        w: number of slots in use.
        step: index of the step.
    """
    if arrays.inputs.shape[1] > 1:
        for i in range(w):
            block.n[STEP_INDEX, i] = step
            set_inputs(program, arrays, block, i)
        return
    input_step = min(step, arrays.steps.shape[1] - 1)
    for u in range(arrays.inputs.shape[0]):
        value = arrays.inputs[u, 0, input_step]
        for i in range(w):
            block.r[program.rows[IN_U] + u, i] = value
