"""Closed-form motion under a constant force, with bounces, without steps.

Between impacts every coordinate is a parabola. A time s after state x, v,

    x(s) = x + v s + a s^2 / 2                                             (1)
    v(s) = v + a s                                                         (2)

and a ball at height H with upward speed u and downward acceleration g meets the ground after

    s = (u + w) / g = 2 H / (w - u),    w = sqrt(u^2 + 2 g H)              (3)

of which the first form has cancellation for u < 0 and the second for u > 0 (W. H. Press et al.,
Numerical Recipes, 3rd edition, 2007, section 5.6). Elements are integrated one after the other, in
the first slot of the block.
"""

from __future__ import annotations

import numpy as np

from sims.engines.compiled.accelerations import compute_frictionless_acceleration, evaluate_forces
from sims.engines.compiled.data_layout import (
    BOUNCES,
    CONSTANTS_BEGIN,
    DIMENSIONS,
    ELEMENT,
    FLOOR_LEVEL,
    FORCES_BEGIN,
    K1,
    BatchArrays,
    BlockBuffers,
    ProgramArrays,
    T,
    V,
    X,
)
from sims.engines.compiled.element_clock import load_element
from sims.engines.compiled.element_stepping import resolve_initial_ground_contact
from sims.engines.compiled.events import compute_rebound_velocity
from sims.engines.compiled.interpreter import run_instructions


def fly_elements(program: ProgramArrays, arrays: BatchArrays, block: BlockBuffers) -> None:
    """Integrate elements on which only a constant force acts, in closed form.

    Between impacts with the ground they move on parabolas, so that no steps are needed. Each
    element is loaded into slot 0 of the buffers.

    Args:
        program: program of the system and its effects.
        arrays: batch of elements.
        block: registers r, numbers a and integers n of the slots; a slot is a column that holds
            one batch element.
    """
    for order_index in range(arrays.order.size):
        load_element(program, arrays, block, 0, order_index)
        run_instructions(
            program.code, program.ends[CONSTANTS_BEGIN], program.ends[FORCES_BEGIN], block.r, 1
        )
        if program.flags[BOUNCES] != 0:
            resolve_initial_ground_contact(program, arrays, block, 1)
        evaluate_forces(program, block, 1)
        compute_frictionless_acceleration(program, block, 1, K1)
        record_flight(program, arrays, block)


def record_flight(program: ProgramArrays, arrays: BatchArrays, block: BlockBuffers) -> None:
    """Record the states of the element at all sample times.

    The element in slot 0 moves on a parabola up to its next impact with the ground, and bounces
    there.

    Args:
        program: program of the system and its effects.
        arrays: batch of elements.
        block: registers r, numbers a and integers n of the slots; a slot is a column that holds
            one batch element.
    """
    element = block.n[ELEMENT, 0]
    row = element if arrays.steps.shape[0] > 1 else 0
    time = 0.0
    impact = compute_impact_time(program, block)
    for step in range(arrays.steps.shape[1] + 1):
        if step % arrays.steps_per_record == 0:
            while impact <= time:
                bounce(program, arrays, block, impact)
                impact = compute_impact_time(program, block)
            record_arc(program, arrays, block, step // arrays.steps_per_record, time)
        if step < arrays.steps.shape[1]:
            time += arrays.steps[row, step]


def record_arc(
    program: ProgramArrays, arrays: BatchArrays, block: BlockBuffers, record: int, time: float
) -> None:
    """Record the state of slot 0 on its present parabola at a time, by (1) and (2).

    The position is x + v s + a s^2 / 2 and the velocity v + a s, with the time s since the
    beginning of the parabola. The record is position, velocity and acceleration, D numbers each.

    Args:
        program: program of the system and its effects.
        arrays: batch of elements.
        block: registers r, numbers a and integers n of the slots; a slot is a column that holds
            one batch element.
        record: index of the record.
        time: seconds since the start of the run.
    """
    a = block.a
    d = program.flags[DIMENSIONS]
    element = block.n[ELEMENT, 0]
    s = time - a[T, 0]
    for k in range(d):
        v = a[V + k, 0]
        acceleration = a[K1 + k, 0]
        arrays.records[element, record, k] = a[X + k, 0] + s * (v + s * (0.5 * acceleration))  # (1)
        arrays.records[element, record, d + k] = v + s * acceleration  # (2)
        arrays.records[element, record, 2 * d + k] = acceleration


def compute_impact_time(program: ProgramArrays, block: BlockBuffers) -> float:
    """Return the time of the next impact in seconds since the start; infinite if there is none.

    Args:
        program: program of the system and its effects.
        block: registers r, numbers a and integers n of the slots; a slot is a column that holds
            one batch element.
    """
    if program.flags[BOUNCES] == 0:
        return np.inf
    a = block.a
    last = program.flags[DIMENSIONS] - 1
    height = a[X + last, 0] - a[FLOOR_LEVEL, 0]
    upward_velocity = a[V + last, 0]
    down = -a[K1 + last, 0]
    root = np.sqrt(
        upward_velocity * upward_velocity + 2.0 * down * height
    )  # NaN if it does not reach the ground
    if upward_velocity < 0.0:
        seconds = 2.0 * height / (root - upward_velocity)  # (3)
    else:
        seconds = (upward_velocity + root) / down if down > 0.0 else np.inf
    return float(np.inf if seconds != seconds else a[T, 0] + seconds)


def bounce(program: ProgramArrays, arrays: BatchArrays, block: BlockBuffers, impact: float) -> None:
    """Move the element to its impact and begin the parabola after it.

    Args:
        program: program of the system and its effects.
        arrays: batch of elements.
        block: registers r, numbers a and integers n of the slots; a slot is a column that holds
            one batch element.
        impact: time of the impact in seconds since the start of the run.
    """
    a = block.a
    last = program.flags[DIMENSIONS] - 1
    s = impact - a[T, 0]
    for k in range(last + 1):
        acceleration = a[K1 + k, 0]
        a[X + k, 0] += s * (a[V + k, 0] + s * (0.5 * acceleration))  # (1)
        a[V + k, 0] += s * acceleration  # (2)
    a[T, 0] = impact
    a[X + last, 0] = a[FLOOR_LEVEL, 0]  # removes the rounding of (1) and (3)
    compute_rebound_velocity(program, arrays, block, 0, a[K1 + last, 0])
    compute_frictionless_acceleration(program, block, 1, K1)
