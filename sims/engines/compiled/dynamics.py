"""Accelerations of the elements in a block, with dry friction and ground support.

Dry friction opposes motion with its full limit. Its direction is fixed during a step, so that the
step is smooth. An element at rest sticks while the pulling force is within the limit, otherwise it
slips in the direction of that force. With generalised inertia M, pulling force F (all forces except
dry friction), limit L and the unit vector d of the motion,

    M a = F - L d          while it moves, d = v / |v|                     (1)
    a = 0                  at rest, as long as |F| <= L                    (2)
    M a = F - L F / |F|    at rest, where |F| > L                          (3)

(C. Coulomb's law; see E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations
I, 1993, section II.6, on such discontinuities: a step must not extend across one).
"""

from __future__ import annotations

import numpy as np

from sims.engines.compiled.data_layout import (
    AFTER,
    BEFORE,
    BOUNCES,
    DIMENSIONS,
    DRY,
    F1,
    GUIDED,
    IN_T,
    IN_V,
    IN_X,
    K1,
    MASS,
    OUT_LIMIT,
    RESTS,
    STICKS,
    WAY,
    BlockBuffers,
    ProgramArrays,
    T,
    V,
    X,
)
from sims.engines.compiled.events import compute_norm
from sims.engines.compiled.interpreter import nan_maximum, run_instructions


def evaluate_forces(program: ProgramArrays, block: BlockBuffers, w: int) -> None:
    """Copy every element's state to the registers and evaluate the forces.

    Args:
        program: program of the system and its effects.
        block: buffers of the slots.
        w: number of slots in use.
    """
    d = program.flags[DIMENSIONS]
    rows = program.rows
    r = block.r
    a = block.a
    for i in range(w):
        r[rows[IN_T], i] = a[T, i]
    for k in range(d):
        for i in range(w):
            r[rows[IN_X] + k, i] = a[X + k, i]
            r[rows[IN_V] + k, i] = a[V + k, i]
    run_instructions(program.code, program.ends[1], program.ends[2], r, w)


def begin_step(program: ProgramArrays, block: BlockBuffers, w: int) -> None:
    """Compute the accelerations at the beginning of a step, in rows K1.

    This also determines which elements stick, and the direction of motion of the others.

    Args:
        program: program of the system and its effects.
        block: buffers of the slots.
        w: number of slots in use.
    """
    d = program.flags[DIMENSIONS]
    if program.flags[DRY] == 0:
        compute_frictionless_acceleration(program, block, w, K1)
        return
    if d == 1 and program.flags[BOUNCES] == 0:
        begin_step_1d(program, block, w)
        return
    a = block.a
    r = block.r
    limits = program.rows[OUT_LIMIT]
    guided = program.flags[GUIDED]
    for i in range(w):
        limit = r[limits, i]
        compute_pulling_force(program, block, i, K1)
        size = compute_norm(a, K1, guided, i)
        speed = compute_norm(a, V, guided, i)
        a[BEFORE, i] = size - limit
        a[AFTER, i] = size - limit
        still = speed == 0.0
        sticks = still and size <= limit  # (2)
        block.n[STICKS, i] = sticks
        # (1) and (3): along the motion, or at rest along the pulling force.
        divisor = speed
        if still:
            divisor = size if size > 0.0 else 1.0
        for k in range(guided):
            pull = a[K1 + k, i]
            way = (pull if still else a[V + k, i]) / divisor
            rub = limit * way
            a[WAY + k, i] = way
            a[F1 + k, i] = rub
            a[K1 + k, i] = 0.0 if sticks else (pull - rub) / a[MASS, i]
        compute_unguided_acceleration(program, block, i, K1, F1)


def begin_step_1d(program: ProgramArrays, block: BlockBuffers, w: int) -> None:
    """Compute `begin_step` for one coordinate without ground: the same numbers, without branches.

    Args:
        program: program of the system and its effects.
        block: buffers of the slots.
        w: number of slots in use.
    """
    a = block.a
    r = block.r
    limits = program.rows[OUT_LIMIT]
    force = program.out[0]
    for i in range(w):
        pull = r[force, i]
        limit = r[limits, i]
        v = a[V, i]
        size = abs(pull)
        excess = size - limit
        still = v == 0.0
        towards = pull if still else v
        divisor = (size if size > 0.0 else 1.0) if still else abs(v)
        way = towards / divisor
        rub = limit * way
        slips = (pull - rub) / a[MASS, i]
        holds = still and size <= limit
        a[BEFORE, i] = excess
        a[AFTER, i] = excess
        a[WAY, i] = way
        a[F1, i] = rub
        a[K1, i] = 0.0 if holds else slips
        block.n[STICKS, i] = 1 if holds else 0


def compute_acceleration(
    program: ProgramArrays, block: BlockBuffers, w: int, to: int, rub_to: int
) -> None:
    """Compute the accelerations within the present step.

    Args:
        program: program of the system and its effects.
        block: buffers of the slots.
        w: number of slots in use.
        to: first row of the accelerations.
        rub_to: first row of dry friction.
    """
    run_instructions(program.code, program.ends[1], program.ends[2], block.r, w)
    if program.flags[DRY] == 0:
        compute_frictionless_acceleration(program, block, w, to)
        return
    if program.flags[DIMENSIONS] == 1 and program.flags[BOUNCES] == 0:
        compute_acceleration_1d(program, block, w, to, rub_to)
        return
    for i in range(w):
        compute_acceleration_nd(program, block, i, to, rub_to)


def compute_acceleration_1d(
    program: ProgramArrays, block: BlockBuffers, w: int, to: int, rub_to: int
) -> None:
    """Compute `compute_acceleration` for one coordinate without ground.

    Args:
        program: program of the system and its effects.
        block: buffers of the slots.
        w: number of slots in use.
        to: row of the acceleration.
        rub_to: row of dry friction.
    """
    a = block.a
    r = block.r
    limits = program.rows[OUT_LIMIT]
    force = program.out[0]
    for i in range(w):
        pull = r[force, i]
        limit = r[limits, i]
        rub = limit * a[WAY, i]
        slips = (pull - rub) / a[MASS, i]
        a[AFTER, i] = abs(pull) - limit
        a[rub_to, i] = rub
        a[to, i] = 0.0 if block.n[STICKS, i] != 0 else slips


def compute_acceleration_nd(
    program: ProgramArrays, block: BlockBuffers, i: int, to: int, rub_to: int
) -> None:
    """Compute `compute_acceleration` for an element of several coordinates.

    Args:
        program: program of the system and its effects.
        block: buffers of the slots.
        i: index of the slot.
        to: first row of the accelerations.
        rub_to: first row of dry friction.
    """
    a = block.a
    guided = program.flags[GUIDED]
    velocity = program.rows[IN_V]
    limit = block.r[program.rows[OUT_LIMIT], i]
    compute_pulling_force(program, block, i, to)
    a[AFTER, i] = compute_norm(a, to, guided, i) - limit
    # The direction may turn within the step, but must not reverse: a reversal is an event at which
    # the step is cut.
    square = 0.0
    for k in range(guided):
        square += block.r[velocity + k, i] * block.r[velocity + k, i]
    speed = np.sqrt(square)
    along = 0.0
    for k in range(guided):
        way = a[WAY + k, i]
        unit = block.r[velocity + k, i] / speed if speed > 0.0 else way
        a[rub_to + k, i] = unit
        along += unit * way
    side = -1.0 if along < 0.0 else 1.0
    for k in range(guided):
        rub = limit * (a[rub_to + k, i] * side)
        a[rub_to + k, i] = rub
        slips = (a[to + k, i] - rub) / a[MASS, i]
        a[to + k, i] = 0.0 if block.n[STICKS, i] != 0 else slips
    compute_unguided_acceleration(program, block, i, to, rub_to)


def compute_unguided_acceleration(
    program: ProgramArrays, block: BlockBuffers, i: int, to: int, rub_to: int
) -> None:
    """Convert forces to accelerations for the coordinates without dry friction.

    Args:
        program: program of the system and its effects.
        block: buffers of the slots.
        i: index of the slot.
        to: first row of the accelerations, which contains the forces before.
        rub_to: first row of dry friction.
    """
    a = block.a
    for k in range(program.flags[GUIDED], program.flags[DIMENSIONS]):
        a[WAY + k, i] = 0.0
        a[rub_to + k, i] = 0.0
        a[to + k, i] = a[to + k, i] / a[MASS, i]


def compute_pulling_force(program: ProgramArrays, block: BlockBuffers, i: int, to: int) -> None:
    """Compute all forces except dry friction, without the part that the ground supports.

    Args:
        program: program of the system and its effects.
        block: buffers of the slots.
        i: index of the slot.
        to: first row of the forces.
    """
    d = program.flags[DIMENSIONS]
    for k in range(d):
        block.a[to + k, i] = block.r[program.out[k], i]
    if block.n[RESTS, i] != 0:
        # The ground pushes but does not pull: an upward force remains.
        up = to + d - 1
        block.a[up, i] = nan_maximum(block.a[up, i], 0.0)


def compute_frictionless_acceleration(
    program: ProgramArrays, block: BlockBuffers, w: int, to: int
) -> None:
    """Compute accelerations without dry friction, in rows `to`.

    Args:
        program: program of the system and its effects.
        block: buffers of the slots.
        w: number of slots in use.
        to: first row of the accelerations.
    """
    a = block.a
    d = program.flags[DIMENSIONS]
    for k in range(d):
        force = program.out[k]
        row = to + k
        for i in range(w):
            a[row, i] = block.r[force, i] / a[MASS, i]
    if program.flags[BOUNCES] != 0:
        up = to + d - 1
        for i in range(w):
            if block.n[RESTS, i] != 0:
                a[up, i] = nan_maximum(block.r[program.out[d - 1], i], 0.0) / a[MASS, i]
