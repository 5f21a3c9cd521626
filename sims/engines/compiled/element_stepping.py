"""Step the elements of one program, a block of them together, each with its own clock.

The method is the classical Runge-Kutta method of fourth order, written for x'' = a(t, x, v) (E.
Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 1993, sections II.1
and, for second order, II.14, doi:10.1007/978-3-540-78862-1). With step h,

    k1 = a(t, x, v)                                                        (1)
    k2 = a(t + h/2, x + h/2 v, v + h/2 k1)                                 (2)
    k3 = a(t + h/2, x + h/2 v + h^2/4 k1, v + h/2 k2)                      (3)
    k4 = a(t + h, x + h v + h^2/2 k2, v + h k3)                            (4)
    x' = x + h v + h^2/6 (k1 + k2 + k3)                                    (5)
    v' = v + h/6 (k1 + 2 k2 + 2 k3 + k4)                                   (6)

The nonlinearity of the acceleration within the step is estimated by the difference between (6) and
the midpoint rule, v + h/2 (k2 + k3), per second:

    b = (k1 - k2 - k3 + k4) / 6                                            (7)

Steps are the planned ones, divided where the motion of an element is too fast for them
(`step_size`). Steps in which friction or the forces of effects are too nonlinear (Stribeck's peak,
the ripples of a fast motor) are rejected and shortened, and steps that contain an event are cut
(`events`). The slot of a finished
element is given to the next one, so that slots stay in use although elements need different numbers
of steps. The result of an element does not depend on any other.
"""

from __future__ import annotations

import numpy as np

from sims.engines.compiled.data_layout import (
    AFTER,
    BEGINS,
    BEND,
    BOUNCES,
    BUSY,
    DIMENSIONS,
    DRY,
    F1,
    F2,
    F3,
    F4,
    FLOOR,
    GOAL,
    IDLE,
    IN_T,
    IN_V,
    IN_X,
    K1,
    K2,
    K3,
    K4,
    LANE,
    LEFT,
    LEVEL,
    LIMIT,
    LONGEST,
    MASS,
    MAX_COORDINATES,
    NEXT_V,
    NEXT_X,
    NOTHING,
    PEAK,
    PLACE,
    PUSHED,
    RESTS,
    RUBBED,
    SPARE,
    STEP,
    STICKS,
    TRY,
    WAY,
    BatchArrays,
    BlockBuffers,
    H,
    ProgramArrays,
    T,
    V,
    X,
)
from sims.engines.compiled.dynamics import begin_step, compute_acceleration, evaluate_forces
from sims.engines.compiled.element_clock import load_element, next_step, record_and_check_remaining
from sims.engines.compiled.events import (
    FORCE_NONLINEARITY_TOLERANCE,
    FRICTION_NONLINEARITY_TOLERANCE,
    NEGLIGIBLE_ACCELERATION_SHARE,
    detect_event,
    handle_event,
    handle_impact,
    is_too_nonlinear,
)
from sims.engines.compiled.interpreter import nan_maximum, run_instructions


def step_block(program: ProgramArrays, work: BatchArrays, block: BlockBuffers, w: int) -> None:
    """Make all steps of all elements.

    Args:
        program: program of the system and its effects.
        work: batch of elements.
        block: buffers of the slots.
        w: number of slots in use.
    """
    begun = 0
    alive = 0
    for i in range(w):
        block.n[PLACE, i] = -1
        if begun < work.order.size:
            load_element(program, work, block, i, begun)
            begun += 1
            alive += 1
        else:
            load_element(program, work, block, i, work.order.size - 1)  # its result is not used
            block.n[PLACE, i] = -1
    fresh = True
    while alive > 0:
        if fresh:
            run_instructions(program.code, program.ends[0], program.ends[1], block.r, w)
            if program.flags[BOUNCES] != 0:
                resolve_initial_ground_contact(program, work, block, w)
            fresh = False
        evaluate_forces(program, block, w)
        begin_step(program, block, w)
        for i in range(w):
            block.n[IDLE, i] = block.n[PLACE, i] < 0
            if block.n[PLACE, i] >= 0 and not record_and_check_remaining(program, work, block, i):
                alive -= 1
                block.n[PLACE, i] = -1
                if begun < work.order.size:
                    load_element(program, work, block, i, begun)
                    begun += 1
                    alive += 1
                    fresh = True
                block.n[IDLE, i] = 1
            a = block.a
            a[H, i] = min(min(a[LEFT, i], a[LIMIT, i]), a[TRY, i])
            if block.n[IDLE, i] != 0:
                a[H, i] = 0.0
        try_step(program, block, w)
        detect_possible_events(program, block, w)
        accept_steps(program, work, block, w)
        for i in range(w):
            if block.n[BUSY, i] != 0 and block.n[IDLE, i] == 0:
                accept_or_retry(program, work, block, i)


def resolve_initial_ground_contact(
    program: ProgramArrays, work: BatchArrays, block: BlockBuffers, w: int
) -> None:
    """Apply ground contact at the initial state of newly loaded elements.

    Elements that start inside the ground are moved to its surface; those that do not move up have
    an impact or rest.

    Args:
        program: program of the system and its effects.
        work: batch of elements.
        block: buffers of the slots.
        w: number of slots in use.
    """
    a = block.a
    n = block.n
    d = program.flags[DIMENSIONS]
    high = X + d - 1
    up = V + d - 1
    some = False
    for i in range(w):
        if is_newly_loaded(block, i):
            floor = work.ground[FLOOR, n[LANE, i]]
            a[high, i] = nan_maximum(a[high, i], floor)
            some |= a[high, i] <= floor and a[up, i] <= 0.0
    if not some:
        return
    evaluate_forces(program, block, w)
    begin_step(program, block, w)
    for i in range(w):
        if is_newly_loaded(block, i):
            floor = work.ground[FLOOR, n[LANE, i]]
            if a[high, i] <= floor and a[up, i] < 0.0:
                handle_impact(program, work, block, i, K1)
            elif a[high, i] <= floor and a[up, i] == 0.0:
                n[RESTS, i] = 1


def is_newly_loaded(block: BlockBuffers, i: int) -> bool:
    """Return whether an element has just been loaded into slot `i`."""
    n = block.n
    return bool(n[PLACE, i] >= 0 and n[STEP, i] == 0 and n[BEGINS, i] == 1)


def try_step(program: ProgramArrays, block: BlockBuffers, w: int) -> None:
    """Try a step of H seconds of every element, equations (2) to (6).

    The result is stored in rows NEXT_X and NEXT_V.

    Args:
        program: program of the system and its effects.
        block: buffers of the slots.
        w: number of slots in use.
    """
    a = block.a
    r = block.r
    d = program.flags[DIMENSIONS]
    t = program.rows[IN_T]
    for stage in range(1, 4):
        share = 0.5 if stage < 3 else 1.0
        last = K1 + (stage - 1) * MAX_COORDINATES
        for i in range(w):
            r[t, i] = a[T, i] + share * a[H, i]
        for k in range(d):
            x = program.rows[IN_X] + k
            v = program.rows[IN_V] + k
            if stage == 1:
                for i in range(w):
                    r[x, i] = a[X + k, i] + 0.5 * a[H, i] * a[V + k, i]  # (2)
            elif stage == 2:
                for i in range(w):
                    half = 0.5 * a[H, i]
                    r[x, i] = r[x, i] + (half * half) * a[K1 + k, i]  # (3)
            else:
                for i in range(w):
                    r[x, i] = a[X + k, i] + a[H, i] * r[v, i]  # (4)
            for i in range(w):
                r[v, i] = a[V + k, i] + share * a[H, i] * a[last + k, i]
        compute_acceleration(
            program, block, w, K1 + stage * MAX_COORDINATES, F1 + stage * MAX_COORDINATES
        )
    for k in range(d):
        for i in range(w):
            h = a[H, i]
            sixth = h / 6.0
            inner = a[K2 + k, i] + a[K3 + k, i]
            outer = a[K1 + k, i] + a[K4 + k, i]
            v = a[V + k, i]
            a[NEXT_X + k, i] = a[X + k, i] + h * (v + sixth * (a[K1 + k, i] + inner))  # (5)
            a[NEXT_V + k, i] = v + sixth * (outer + 2.0 * inner)  # (6)


def detect_possible_events(program: ProgramArrays, block: BlockBuffers, w: int) -> None:
    """Mark the elements as busy that may have an event in the step just tried.

    Args:
        program: program of the system and its effects.
        block: buffers of the slots.
        w: number of slots in use.
    """
    a = block.a
    n = block.n
    d = program.flags[DIMENSIONS]
    for i in range(w):
        n[BUSY, i] = 1 if n[IDLE, i] != 0 or n[GOAL, i] != NOTHING else 0
    if program.flags[PUSHED] != 0 or program.flags[DRY] != 0:
        for i in range(w):
            a[BEND, i] = 0.0
            a[SPARE, i] = 0.0
        for k in range(d):
            for i in range(w):
                bend = (a[K1 + k, i] + a[K4 + k, i]) - (a[K2 + k, i] + a[K3 + k, i])
                a[BEND, i] += bend * bend
                a[SPARE, i] += a[K1 + k, i] * a[K1 + k, i]
        for i in range(w):
            a[PEAK, i] = nan_maximum(a[PEAK, i], a[SPARE, i])
    if program.flags[PUSHED] != 0:
        for i in range(w):
            n[BUSY, i] |= 1 if a[BEND, i] > FORCE_NONLINEARITY_TOLERANCE * a[PEAK, i] else 0
    if program.flags[BOUNCES] != 0:
        for i in range(w):
            low = a[NEXT_X + d - 1, i] < a[LEVEL, i]
            lifts = n[RESTS, i] != 0 and not a[NEXT_V + d - 1, i] <= 0.0
            n[BUSY, i] |= 1 if low or lifts else 0
    if program.flags[DRY] != 0:
        detect_friction_events(program, block, w)


def detect_friction_events(program: ProgramArrays, block: BlockBuffers, w: int) -> None:
    """Mark the elements as busy that may have a friction event in the step just tried.

    In several dimensions all elements are busy.

    Args:
        program: program of the system and its effects.
        block: buffers of the slots.
        w: number of slots in use.
    """
    a = block.a
    n = block.n
    if program.flags[DIMENSIONS] > 1:
        for i in range(w):
            n[BUSY, i] = 1
        return
    for i in range(w):
        a[RUBBED, i] = nan_maximum(a[RUBBED, i], nan_maximum(abs(a[F1, i]), abs(a[F4, i])))
        a[SPARE, i] = NEGLIGIBLE_ACCELERATION_SHARE * np.sqrt(a[PEAK, i]) * a[MASS, i]
    for i in range(w):
        bend = abs(a[F1, i] - a[F2, i] - a[F3, i] + a[F4, i])
        sharp = bend > FRICTION_NONLINEARITY_TOLERANCE * nan_maximum(a[RUBBED, i], a[SPARE, i])
        turns = a[NEXT_V, i] * a[WAY, i] < 0.0
        slips = 1 if sharp or turns else 0
        loosens = 1 if a[AFTER, i] > 0.0 else 0
        n[BUSY, i] |= loosens if n[STICKS, i] != 0 else slips


def accept_steps(program: ProgramArrays, work: BatchArrays, block: BlockBuffers, w: int) -> None:
    """Accept the steps just tried of elements that are not busy.

    Args:
        program: program of the system and its effects.
        work: batch of elements.
        block: buffers of the slots.
        w: number of slots in use.
    """
    a = block.a
    n = block.n
    for k in range(program.flags[DIMENSIONS]):
        for i in range(w):
            x = a[NEXT_X + k, i]
            v = a[NEXT_V + k, i]
            a[X + k, i] = a[X + k, i] if n[BUSY, i] != 0 else x
            a[V + k, i] = a[V + k, i] if n[BUSY, i] != 0 else v
    for i in range(w):
        h = 0.0 if n[BUSY, i] != 0 else a[H, i]
        left = a[LEFT, i] - h
        grown = 2.0 * a[LIMIT, i]
        grown = grown if grown < a[LONGEST, i] else a[LONGEST, i]
        a[T, i] += h
        # By rounding, parts of a step may add up to more than its length; a negative rest would run
        # backwards in time.
        a[LEFT, i] = left if left > 0.0 else 0.0
        # The limit doubles with each accepted step of that length, as the nonlinearity may still be
        # near.
        a[LIMIT, i] = grown if n[BUSY, i] == 0 and h >= a[LIMIT, i] else a[LIMIT, i]
    for i in range(w):
        if a[LEFT, i] <= 0.0 and n[BUSY, i] == 0:
            next_step(program, work, block, i)


def accept_or_retry(program: ProgramArrays, work: BatchArrays, block: BlockBuffers, i: int) -> None:
    """Accept the step just tried if it contains no event, otherwise prepare to repeat it.

    Args:
        program: program of the system and its effects.
        work: batch of elements.
        block: buffers of the slots.
        i: index of the slot.
    """
    a = block.a
    n = block.n
    d = program.flags[DIMENSIONS]
    bends = program.flags[DRY] != 0 or program.flags[PUSHED] != 0
    if bends and is_too_nonlinear(program, block, i):
        return
    if (program.flags[DRY] != 0 or program.flags[BOUNCES] != 0) and detect_event(
        program, work, block, i
    ):
        return
    for k in range(d):
        a[X + k, i] = a[NEXT_X + k, i]
        a[V + k, i] = a[NEXT_V + k, i]
    h = a[H, i]
    a[T, i] += h
    # By rounding, parts of a step may add up to more than its length; a negative rest would run
    # backwards in time.
    a[LEFT, i] = nan_maximum(a[LEFT, i] - h, 0.0)
    if n[GOAL, i] != NOTHING:
        handle_event(program, work, block, i)
    if n[RESTS, i] != 0 and not a[V + d - 1, i] <= 0.0:
        n[RESTS, i] = 0
    if a[LEFT, i] <= 0.0:
        next_step(program, work, block, i)
