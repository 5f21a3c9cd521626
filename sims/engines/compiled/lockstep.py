"""Step a block whose elements share their steps and have no events.

They are elements of a smooth program whose steps are not divided. The results are, bit for bit,
those of `sims.engines.compiled.advance`, which checks every element in every step.
"""

from __future__ import annotations

from sims.engines.compiled.advance import attempt
from sims.engines.compiled.clock import feel, keep, load
from sims.engines.compiled.dynamics import free, present
from sims.engines.compiled.evaluate import execute
from sims.engines.compiled.kinds import (
    DIMENSIONS,
    IN_U,
    K1,
    NEXT_V,
    NEXT_X,
    STARTS,
    STEP,
    Block,
    H,
    Program,
    T,
    V,
    Work,
    X,
)


def march(program: Program, work: Work, block: Block, w: int) -> None:
    """Make all steps of all elements, w at a time.

    Args:
        program: program of the system and its effects.
        work: batch of elements.
        block: buffers of the slots.
        w: number of slots in use.
    """
    a = block.a
    end = work.steps.shape[1]
    for first in range(0, work.order.size, w):
        count = min(w, work.order.size - first)
        for i in range(w):
            load(program, work, block, i, first + min(i, count - 1))
        execute(program.code, program.ends[0], program.ends[1], block.r, w)
        for step in range(end + 1):
            present(program, block, w)
            free(program, block, w, K1)
            if step % work.every == 0:
                for i in range(count):
                    keep(program, work, block, i, step // work.every)
            if step == end:
                break
            h = work.steps[0, step]
            for i in range(w):
                a[H, i] = h
            attempt(program, block, w)
            pass_by(program, block, w, h)
            feel_alike(program, work, block, w, step + 1)


def pass_by(program: Program, block: Block, w: int, h: float) -> None:
    """Accept the step of h seconds just tried.

    Args:
        program: program of the system and its effects.
        block: buffers of the slots.
        w: number of slots in use.
        h: step size in seconds.
    """
    a = block.a
    for k in range(program.flags[DIMENSIONS]):
        for i in range(w):
            a[X + k, i] = a[NEXT_X + k, i]
            a[V + k, i] = a[NEXT_V + k, i]
    for i in range(w):
        a[STARTS, i] += h
        a[T, i] = a[STARTS, i]


def feel_alike(program: Program, work: Work, block: Block, w: int, step: int) -> None:
    """Set the inputs of this step; after the last step, those of the last step.

    Args:
        program: program of the system and its effects.
        work: batch of elements.
        block: buffers of the slots.
        w: number of slots in use.
        step: index of the step.
    """
    if work.inputs.shape[1] > 1:
        for i in range(w):
            block.n[STEP, i] = step
            feel(program, work, block, i)
        return
    at = min(step, work.steps.shape[1] - 1)
    for u in range(work.inputs.shape[0]):
        value = work.inputs[u, 0, at]
        for i in range(w):
            block.r[program.rows[IN_U] + u, i] = value
