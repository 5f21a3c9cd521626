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

from sims.engines.compiled.accelerations import (
    compute_frictionless_acceleration,
    evaluate_forces,
    run_part,
)
from sims.engines.compiled.data_layout import (
    BOUNCES,
    CONSTANTS,
    DIMENSIONS,
    ELEMENT,
    FLOOR_LEVEL,
    K1,
    Block,
    T,
    V,
    X,
)
from sims.engines.compiled.element_clock import load_element
from sims.engines.compiled.element_stepping import resolve_initial_ground_contact
from sims.engines.compiled.events import compute_rebound_velocity


def fly_elements(block: Block) -> None:
    """Integrate elements on which only a constant force acts, in closed form.

    Between impacts with the ground they move on parabolas, so that no steps are needed. Each
    element is loaded into slot 0 of the buffers.

    Args:
        block: force program, batch elements and their buffers. Slot i holds one element: its
            numbers are `block.a[ROW, i]`, its integers `block.n[ROW, i]`, and the registers of
            the force program, inputs and forces among them, `block.r[REGISTER, i]`.
    """
    for order_index in range(block.order.size):
        load_element(block, 0, order_index)
        run_part(block, CONSTANTS)
        if block.flags[BOUNCES] != 0:
            resolve_initial_ground_contact(block)
        evaluate_forces(block)
        compute_frictionless_acceleration(block, K1)
        record_flight(block)


def record_flight(block: Block) -> None:
    """Record the states of the element in slot 0 at all sample times.

    It moves on a parabola up to its next impact with the ground. All impacts up to a sample time
    are applied before that sample is recorded; without ground, the next impact is at infinity.

    Args:
        block: force program, batch elements and their buffers. Slot i holds one element: its
            numbers are `block.a[ROW, i]`, its integers `block.n[ROW, i]`, and the registers of
            the force program, inputs and forces among them, `block.r[REGISTER, i]`.
    """
    element = block.n[ELEMENT, 0]
    # The step sizes have a single row if they are equal for all elements.
    row = element if block.steps.shape[0] > 1 else 0
    time = 0.0
    impact_time = compute_impact_time(block)
    for step in range(block.steps.shape[1] + 1):
        if step % block.steps_per_record == 0:
            while impact_time <= time:
                bounce(block, impact_time)
                impact_time = compute_impact_time(block)
            record_arc(block, step // block.steps_per_record, time)
        if step < block.steps.shape[1]:
            time += block.steps[row, step]


def record_arc(block: Block, record: int, time: float) -> None:
    """Record position, velocity and acceleration at a time on the present parabola of slot 0.

    The position is x + v s + a s^2 / 2 (1) and the velocity v + a s (2), with the time s since the
    beginning of the parabola. A record has D numbers each, for D coordinates.

    Args:
        block: force program, batch elements and their buffers. Slot i holds one element: its
            numbers are `block.a[ROW, i]`, its integers `block.n[ROW, i]`, and the registers of
            the force program, inputs and forces among them, `block.r[REGISTER, i]`.
        record: index of the record.
        time: seconds since the start of the run.
    """
    a = block.a
    d = block.flags[DIMENSIONS]
    element = block.n[ELEMENT, 0]
    s = time - a[T, 0]
    for k in range(d):
        v = a[V + k, 0]
        acceleration = a[K1 + k, 0]
        block.records[element, record, k] = a[X + k, 0] + s * (v + s * (0.5 * acceleration))  # (1)
        block.records[element, record, d + k] = v + s * acceleration  # (2)
        block.records[element, record, 2 * d + k] = acceleration


def compute_impact_time(block: Block) -> float:
    """Return the time of the next impact in seconds since the start; infinite if there is none.

    From height H with upward velocity u and downward acceleration g, it is s seconds away:
    s = (u + w) / g = 2 H / (w - u), w = sqrt(u^2 + 2 g H) (3). Of these two equal forms, the one
    that does not subtract nearly equal numbers is used.

    Args:
        block: force program, batch elements and their buffers. Slot i holds one element: its
            numbers are `block.a[ROW, i]`, its integers `block.n[ROW, i]`, and the registers of
            the force program, inputs and forces among them, `block.r[REGISTER, i]`.
    """
    if block.flags[BOUNCES] == 0:
        return np.inf
    a = block.a
    last = block.flags[DIMENSIONS] - 1
    height = a[X + last, 0] - a[FLOOR_LEVEL, 0]
    upward_velocity = a[V + last, 0]
    gravity = -a[K1 + last, 0]
    # NaN if the element never reaches the ground.
    root = np.sqrt(upward_velocity * upward_velocity + 2.0 * gravity * height)
    if upward_velocity < 0.0:
        seconds = 2.0 * height / (root - upward_velocity)  # (3)
    else:
        seconds = (upward_velocity + root) / gravity if gravity > 0.0 else np.inf
    is_nan = seconds != seconds
    return float(np.inf if is_nan else a[T, 0] + seconds)


def bounce(block: Block, impact_time: float) -> None:
    """Move the element in slot 0 to its impact, and begin the parabola after the rebound.

    Args:
        block: force program, batch elements and their buffers. Slot i holds one element: its
            numbers are `block.a[ROW, i]`, its integers `block.n[ROW, i]`, and the registers of
            the force program, inputs and forces among them, `block.r[REGISTER, i]`.
        impact_time: time of the impact in seconds since the start of the run.
    """
    a = block.a
    vertical = block.flags[DIMENSIONS] - 1
    s = impact_time - a[T, 0]
    for k in range(vertical + 1):
        acceleration = a[K1 + k, 0]
        a[X + k, 0] += s * (a[V + k, 0] + s * (0.5 * acceleration))  # (1)
        a[V + k, 0] += s * acceleration  # (2)
    a[T, 0] = impact_time
    a[X + vertical, 0] = a[FLOOR_LEVEL, 0]  # removes the rounding of (1) and (3)
    compute_rebound_velocity(block, 0, a[K1 + vertical, 0])
    compute_frictionless_acceleration(block, K1)
