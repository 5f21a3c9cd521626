"""Events of one element: impacts, standstill and break-away.

A step that contains an event is rejected and repeated up to the event time, which is estimated by
interpolation and corrected to second order afterwards; the state is changed there, and the rest of
the step follows (impacts: `ground_impacts`). `i` is the index of a slot.

For a quantity with value p and rate r at the beginning of a step of length h, and value q at its
end, the parabola through these values is

    p(s) = p + r s - b s^2,    b = (p + h r - q) / h^2                     (8)

Its root is computed in the form without cancellation (W. H. Press et al., Numerical Recipes, 3rd
edition, 2007, section 5.6):

    s = (r + w) / (2 b) = 2 p / (w - r),    w = sqrt(r^2 + 4 b p)          (9)
"""

from __future__ import annotations

import numpy as np

from sims.engines.compiled.accelerations import compute_norm, dot
from sims.engines.compiled.data_layout import (
    BOUNCES,
    BREAK_AWAY,
    DIMENSIONS,
    DIRECTION,
    ELEMENT,
    EVENT_COUNT,
    EVENT_DELAY,
    EXCESS_AFTER,
    EXCESS_BEFORE,
    FLOOR,
    FRICTION_COORDINATE_COUNT,
    HAS_FRICTION,
    IMPACT,
    IS_STICKING,
    K1,
    K4,
    MAX_STEP,
    NEXT_V,
    NEXT_X,
    NO_EVENT,
    PENDING_EVENT,
    STANDSTILL,
    Block,
    H,
    V,
    X,
)
from sims.engines.compiled.element_loading_and_recording import shift_time
from sims.engines.compiled.ground_impacts import handle_impact

MAX_EVENTS_PER_STEP = 256
"""Maximum number of events in one step of one element; further events are ignored."""
BREAK_AWAY_TIME_TOLERANCE = 1e-4
"""Time tolerance of break-away, as a fraction of a step."""
REST_SPEED_SHARE = 1e-9
"""Fraction of the speed change in a full step below which a stopped element is at rest."""


def find_event_time(value: float, rate: float, end_value: float, h: float) -> float:
    """Return the seconds until a quantity, such as the height above the ground, becomes zero.

    It is the last root of the parabola p(s) = p + r s - b s^2 with b = (p + h r - q) / h^2 (8),
    which interpolates the value p and the rate r at the beginning of a step of length h, and the
    value q at its end: s = (r + w) / (2 b) = 2 p / (w - r), w = sqrt(r^2 + 4 b p) (9). The error is
    of third order in h; it is corrected when the root is reached.

    Args:
        value: value >= 0 at the beginning.
        rate: rate at the beginning.
        end_value: value < 0 after h seconds.
        h: step size in seconds.
    """
    curvature = (value + h * rate - end_value) / (h * h)  # (8)
    root = np.sqrt(rate * rate + 4.0 * curvature * value)
    # (9), in the form without cancellation.
    seconds = 2.0 * value / (root - rate) if rate < 0.0 else (root + rate) / (2.0 * curvature)
    # Without a root, which only rounding can cause, the event is at the end of the step.
    return float(seconds if abs(seconds) < np.inf else h)


def has_no_pending_event(block: Block, i: int) -> bool:
    """Return whether an event of the element may be sought in the present step.

    It may unless the step leads to a scheduled event already, or has had too many events.

    Args:
        block: buffers of the elements that are integrated together.
        i: slot of the element.
    """
    n = block.n
    return bool(n[PENDING_EVENT, i] == NO_EVENT and n[EVENT_COUNT, i] < MAX_EVENTS_PER_STEP)


def detect_and_schedule_event(block: Block, i: int) -> bool:
    """Return whether an event is within the step just tried, and schedule it.

    Events are: an impact, when the height above the ground becomes negative; a standstill, when the
    speed along the motion changes sign; and a break-away, when the pulling force of a sticking
    element exceeds its friction limit. The step is then repeated up to the time of the event. If it
    was already repeated for an event, that event is handled at its end, so no other one is sought;
    only the time of a break-away is refined until it is accurate enough.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. `block.flags` states what the system has, such as
            dry friction.
        i: index of the slot, the column of the batch element.
    """
    a = block.a
    d = block.flags[DIMENSIONS]
    h = a[H, i]
    has_no_event = has_no_pending_event(block, i)
    has_event = False
    # Impact: the height, which is the last coordinate, falls below the ground.
    if has_no_event and block.flags[BOUNCES] != 0:
        floor = block.ground[FLOOR, block.n[ELEMENT, i]]
        end_value = a[NEXT_X + d - 1, i]
        if end_value < floor:
            height = a[X + d - 1, i] - floor
            rate = a[V + d - 1, i]
            schedule_event(block, i, find_event_time(height, rate, end_value - floor, h), IMPACT)
            has_event = True
    if block.flags[HAS_FRICTION] != 0:
        is_sticking = block.n[IS_STICKING, i] != 0
        # Standstill: the speed along the direction of motion at the beginning becomes negative.
        if has_no_event and not is_sticking:
            end_value = dot(a, NEXT_V, DIRECTION, d, i)
            if end_value < 0.0:
                speed = dot(a, V, DIRECTION, d, i)
                rate = dot(a, K1, DIRECTION, d, i)
                schedule_event(block, i, find_event_time(speed, rate, end_value, h), STANDSTILL)
                has_event = True
        # Break-away of an element that dry friction holds.
        awaits_break_away = block.n[PENDING_EVENT, i] == BREAK_AWAY
        if is_sticking and (has_no_event or awaits_break_away):
            # Pulling force minus friction limit at both ends of the step.
            excess_before = a[EXCESS_BEFORE, i]
            excess_after = a[EXCESS_AFTER, i]
            # A scheduled break-away is checked again with a tolerance, a share of the step, within
            # which the excess is nearly linear.
            max_excess = 0.0
            if awaits_break_away:
                max_excess = BREAK_AWAY_TIME_TOLERANCE * (excess_after - excess_before)
            if excess_after > max_excess:
                # Just after the linear estimate of the zero, so that the excess is not negative.
                seconds = h * (
                    excess_before / (excess_before - excess_after) + 0.1 * BREAK_AWAY_TIME_TOLERANCE
                )
                schedule_event(block, i, seconds, BREAK_AWAY)
                has_event = True
    return has_event


def schedule_event(block: Block, i: int, seconds: float, event: int) -> None:
    """Schedule an event: the step is repeated so that it ends there.

    If two events are in a step, the earlier one is scheduled; the other is found again later.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`.
        i: index of the slot, the column of the batch element.
        seconds: seconds from the beginning of the step to the event.
        event: kind of event: IMPACT, STANDSTILL or BREAK_AWAY.
    """
    # Without a scheduled event, the delay is infinite.
    if seconds < block.a[EVENT_DELAY, i]:
        block.a[EVENT_DELAY, i] = min(max(seconds, 0.0), block.a[H, i])
        block.n[PENDING_EVENT, i] = event
        block.n[EVENT_COUNT, i] += 1


def handle_event(block: Block, i: int) -> None:
    """Apply the event to which the step led.

    An event is an impact with the ground, a standstill of a body with dry friction, or its
    break-away. The step was shortened to end there.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`.
        i: index of the slot, the column of the batch element.
    """
    event = block.n[PENDING_EVENT, i]
    if event == IMPACT:
        handle_impact(block, i, K4)
    elif event == STANDSTILL:
        handle_standstill(block, i)
    # Break-away needs no action: the next step finds that the element slips.
    block.a[EVENT_DELAY, i] = np.inf
    block.n[PENDING_EVENT, i] = NO_EVENT


def handle_standstill(block: Block, i: int) -> None:
    """Stop an element that has nearly lost its speed, where dry friction may then hold it.

    The clock and the state first move to the exact time of standstill. Then the small remaining
    velocity along the former direction of motion is removed; motion across it stays. If what stays
    is negligible, the velocity becomes exactly zero.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. A vector has one row per coordinate: `X + k` is
            that of coordinate k. `block.flags` states what the system has, such as dry friction.
        i: index of the slot, the column of the batch element.
    """
    a = block.a
    d = block.flags[DIMENSIONS]
    # K4 holds the acceleration at the end of the step. A Newton step leads to the time at which
    # the velocity along the direction of motion is zero.
    acceleration = dot(a, K4, DIRECTION, d, i)
    correction = -dot(a, V, DIRECTION, d, i) / acceleration if acceleration < 0.0 else 0.0
    correction = shift_time(block, i, correction)
    for k in range(d):
        a[X + k, i] += correction * a[V + k, i]
        a[V + k, i] += correction * a[K4 + k, i]
    directed_velocity = dot(a, V, DIRECTION, d, i)
    for k in range(d):
        a[V + k, i] -= a[DIRECTION + k, i] * directed_velocity
    # Only an element whose speed is exactly zero can stick.
    friction_coordinate_count = block.flags[FRICTION_COORDINATE_COUNT]
    if (
        compute_norm(a, V, friction_coordinate_count, i)
        <= REST_SPEED_SHARE * compute_norm(a, K4, friction_coordinate_count, i) * a[MAX_STEP, i]
    ):
        for k in range(friction_coordinate_count):
            a[V + k, i] = 0.0
