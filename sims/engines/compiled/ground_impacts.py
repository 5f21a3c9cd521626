"""Impacts of elements with level ground: velocity after an impact, and end of bouncing.

The last coordinate strikes the ground at its `floor`; the others are tangential. Restitution e is
the system's, modified by the contact effects in their order. With the normal speed n and the
tangential velocity u before the impact,

    n' = e n                                                               (1)
    u' = u max(1 - mu (1 + e) n / |u|, 1 - g)                              (2)

so the ground removes the tangential speed mu (1 + e) n, but never more than there is (R. M. Brach,
J. Appl. Mech. 56(1), 133, 1989, doi:10.1115/1.3176033). The maximum tangential impulse share g is
1, or less where the system specifies at which share a body that starts to spin begins to roll. A
ball that rests on the ground has no impacts and is not slowed by it.

A ball with e < 1 stops bouncing in finite time after infinitely many bounces. A flight that starts
with speed n' under a downward acceleration f lasts

    2 n' / f                                                               (3)

Bouncing is treated as finished when this time is less than `MIN_FLIGHT_SECONDS`, or after more than
`MAX_SHORT_FLIGHTS` consecutive flights shorter than `SHORT_FLIGHT_SECONDS`. The omitted bounces
have impact speeds n', e n', e^2 n', ..., and the tangential speed that they would remove is removed
at once:

    mu (1 + e) (n' + e n' + e^2 n' + ...) = mu (1 + e) n' / (1 - e)        (4)

The time of an impact is that of `events`, which is an estimate. After the step to it, with the
height d above the ground, its rate r and its acceleration a, the impact is

    s = -d / r (1 + d a / (2 r^2))                                         (5)

seconds away, which solves d + r s + a s^2 / 2 = 0 up to terms of third order in d.
"""

from __future__ import annotations

import numpy as np

from sims.engines.compiled.accelerations import begin_step, evaluate_forces
from sims.engines.compiled.data_layout import (
    DIMENSIONS,
    ELEMENT,
    FLOOR,
    GROUND_FRICTION,
    IMPACTS,
    IN_E,
    IN_MU,
    IN_SPEED,
    IS_RESTING,
    IS_STEP_START,
    K1,
    MIN_REMAINING_SHARE,
    ORDER_INDEX,
    OUT_E,
    OUT_MU,
    RESTITUTION,
    SHORT_FLIGHT_COUNT,
    STEP_INDEX,
    Block,
    V,
    X,
)
from sims.engines.compiled.element_loading_and_recording import shift_time
from sims.engines.compiled.interpreter import nan_maximum, run_instructions

MIN_FLIGHT_SECONDS = 5e-5
"""Minimum duration of a flight in seconds; a flight of this duration rises 3 nm."""
SHORT_FLIGHT_SECONDS = 2e-3
"""Duration in seconds below which a flight counts as short, see `MAX_SHORT_FLIGHTS`."""
MAX_SHORT_FLIGHTS = 64
"""Maximum number of consecutive short flights; after more, bouncing is finished."""


def resolve_initial_ground_contact(block: Block) -> None:
    """Apply ground contact at the initial state of newly loaded elements.

    Elements that start inside the ground are moved to its surface. Of those on the ground, the ones
    that move down have an impact, and the ones without vertical speed rest. The last coordinate is
    the height.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. `block.flags` states what the system has, such as
            dry friction.
    """
    a = block.a
    n = block.n
    d = block.flags[DIMENSIONS]
    height_row = X + d - 1
    rate_row = V + d - 1
    any_on_ground = False
    for i in range(block.w):
        if is_newly_loaded(block, i):
            floor = block.ground[FLOOR, n[ELEMENT, i]]
            a[height_row, i] = nan_maximum(a[height_row, i], floor)
            any_on_ground |= a[height_row, i] <= floor and a[rate_row, i] <= 0.0
    if not any_on_ground:
        return
    # `handle_impact` needs the acceleration before the impact, which `begin_step` writes to K1.
    evaluate_forces(block)
    begin_step(block)
    for i in range(block.w):
        if is_newly_loaded(block, i):
            floor = block.ground[FLOOR, n[ELEMENT, i]]
            if a[height_row, i] <= floor and a[rate_row, i] < 0.0:
                handle_impact(block, i, K1)
            elif a[height_row, i] <= floor and a[rate_row, i] == 0.0:
                n[IS_RESTING, i] = 1


def is_newly_loaded(block: Block, i: int) -> bool:
    """Return whether a slot holds an element at the beginning of its run.

    Args:
        block: buffers of the elements that are integrated together.
        i: index of the slot.
    """
    n = block.n
    # An order index of -1 marks a slot that is not used.
    return bool(n[ORDER_INDEX, i] >= 0 and n[STEP_INDEX, i] == 0 and n[IS_STEP_START, i] == 1)


def handle_impact(block: Block, i: int, k: int) -> None:
    """Apply an impact with the ground, which the element has nearly reached.

    First the element moves exactly to the ground: with its height h above the ground, the rate r of
    h and the upward acceleration a, the impact is -h / r (1 + h a / (2 r^2)) seconds away (5).
    Then its velocity becomes that of the rebound.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. `block.flags` states what the system has, such as
            dry friction.
        i: index of the slot, the column of the batch element.
        k: first row of the acceleration before the impact: K1 at the beginning of a step, K4 at
            its end.
    """
    a = block.a
    d = block.flags[DIMENSIONS]
    floor = block.ground[FLOOR, block.n[ELEMENT, i]]
    # The last coordinate is the height.
    height_row = X + d - 1
    rate_row = V + d - 1
    upward_acceleration = a[k + d - 1, i]
    rate = a[rate_row, i]
    correction = 0.0
    if rate < 0.0:
        correction = (floor - a[height_row, i]) / rate
        correction *= 1.0 - 0.5 * correction * upward_acceleration / rate  # (5)
    correction = shift_time(block, i, correction)
    for j in range(d):
        acceleration = a[k + j, i]
        a[X + j, i] += correction * (a[V + j, i] + 0.5 * correction * acceleration)
        a[V + j, i] += correction * acceleration
    # Exactly on the ground and not moving up, otherwise the next step would contain the same
    # impact.
    a[height_row, i] = floor
    a[rate_row, i] = clip_to_non_positive(a[rate_row, i])
    compute_rebound_velocity(block, i, upward_acceleration)


def clip_to_non_positive(rate: float) -> float:
    """Return the rate if it is negative, otherwise zero; NaN stays NaN."""
    return rate if rate <= 0.0 or rate != rate else 0.0


def compute_rebound_velocity(block: Block, i: int, upward_acceleration: float) -> None:
    """Set the velocity after an impact, from restitution and friction with effects.

    With restitution e, friction coefficient mu and normal speed v, the rebound speed is e v, and
    the tangential speed decreases by mu (1 + e) v, but not below a share that the ground leaves.
    A ball whose bounces are over comes to rest, and loses the tangential speed of all remaining
    impacts at once.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. `block.rows[NAME]` is the register of an input or
            an output, the first one if there are several. `block.flags` states what the system has,
            such as dry friction.
        i: index of the slot, the column of the batch element.
        upward_acceleration: upward acceleration before the impact; negative under gravity.
    """
    a = block.a
    r = block.r
    d = block.flags[DIMENSIONS]
    rows = block.rows
    element = block.n[ELEMENT, i]
    rate_row = V + d - 1
    speed = abs(a[rate_row, i])
    # The program always runs from slot 0 on, so that all slots up to this one are filled; the
    # results of the others are not used.
    width = i + 1
    for s in range(width):
        r[rows[IN_E], s] = block.ground[RESTITUTION, element]
        r[rows[IN_MU], s] = block.ground[GROUND_FRICTION, element]
        r[rows[IN_SPEED], s] = speed
    run_instructions(block.code, block.ends[IMPACTS], block.ends[IMPACTS + 1], r, width)
    restitution = r[rows[OUT_E], i]
    friction = r[rows[OUT_MU], i]
    rebound_speed = restitution * speed
    lost_speed = friction * (1.0 + restitution) * speed
    if count_bounce_and_check_end(block, i, rebound_speed, -upward_acceleration):
        if restitution < 1.0:
            # Sum of the geometric series of all further impacts, whose speeds fall by e each.
            lost_speed += friction * (1.0 + restitution) * rebound_speed / (1.0 - restitution)
        rebound_speed = 0.0
        block.n[IS_RESTING, i] = 1
    if friction > 0.0:
        square = 0.0
        for j in range(d - 1):
            square += a[V + j, i] * a[V + j, i]
        # With a single tangential coordinate, the root of the square would be rounded.
        tangential_speed = abs(a[V, i]) if d == 2 else np.sqrt(square)
        share = 1.0 - lost_speed / (tangential_speed if tangential_speed > 0.0 else 1.0)
        # The ground leaves at least this share, such as where the body begins to roll.
        remaining_share = nan_maximum(share, block.ground[MIN_REMAINING_SHARE, element])
        for j in range(d - 1):
            a[V + j, i] *= remaining_share
    a[rate_row, i] = rebound_speed


def count_bounce_and_check_end(
    block: Block, i: int, rebound_speed: float, downward_acceleration: float
) -> bool:
    """Count short flights in a row, and return whether bouncing is finished after this impact.

    Without this, a ball would bounce infinitely often in finite time. Bouncing ends at a flight
    shorter than `MIN_FLIGHT_SECONDS`, or after more than `MAX_SHORT_FLIGHTS` in a row that are
    shorter than `SHORT_FLIGHT_SECONDS`. Without downward acceleration, the element flies away.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`.
        i: index of the slot, the column of the batch element.
        rebound_speed: upward speed after the impact.
        downward_acceleration: downward acceleration.
    """
    if not downward_acceleration > 0.0:
        block.n[SHORT_FLIGHT_COUNT, i] = 0
        return False
    flight_seconds = 2.0 * rebound_speed / downward_acceleration
    count = block.n[SHORT_FLIGHT_COUNT, i] + 1 if flight_seconds < SHORT_FLIGHT_SECONDS else 0
    block.n[SHORT_FLIGHT_COUNT, i] = count
    return bool(flight_seconds < MIN_FLIGHT_SECONDS or count > MAX_SHORT_FLIGHTS)
