"""Events of one element: impacts, standstill, break-away and step-size control.

A step that contains an event is rejected and repeated up to the event time, which is estimated by
interpolation and corrected to second order afterwards; the state is changed there, and the rest of
the step follows. `i` is the index of a slot. Equation (7) is that of `element_stepping`, equations
of impacts are those of `sims.engines.ground_contact`.

For a quantity with value p and rate r at the beginning of a step of length h, and value q at its
end, the parabola through these values is

    p(s) = p + r s - b s^2,    b = (p + h r - q) / h^2                     (8)

Its root is computed in the form without cancellation (W. H. Press et al., Numerical Recipes, 3rd
edition, 2007, section 5.6):

    s = (r + w) / (2 b) = 2 p / (w - r),    w = sqrt(r^2 + 4 b p)          (9)

With distance d to the event after the second attempt, its rate r and its acceleration a, the event
is

    s = -d / r (1 + d a / (2 r^2))                                         (10)

seconds away, which solves d + r s + a s^2 / 2 = 0 up to terms of third order in d.
"""

from __future__ import annotations

import numpy as np

from sims.engines.compiled.data_layout import (
    AFTER,
    BEFORE,
    BOUNCES,
    DIMENSIONS,
    DRY,
    EVENTS,
    F1,
    F2,
    F3,
    F4,
    FLOOR,
    GOAL,
    GUIDED,
    IMPACT,
    IN_E,
    IN_MU,
    IN_SPEED,
    K1,
    K2,
    K3,
    K4,
    LANE,
    LEAST,
    LEFT,
    LIMIT,
    LONGEST,
    LOOSE,
    MASS,
    NEXT_V,
    NEXT_X,
    NOTHING,
    OUT_E,
    OUT_MU,
    PEAK,
    PUSHED,
    RESTITUTION,
    RESTS,
    RUBBED,
    RUBBING,
    SHORTS,
    STANDSTILL,
    STICKS,
    TRY,
    WAY,
    BatchArrays,
    BlockBuffers,
    FloatArray,
    H,
    ProgramArrays,
    T,
    V,
    X,
)
from sims.engines.compiled.interpreter import nan_maximum, run_instructions
from sims.engines.ground_contact import MAX_SHORT_FLIGHTS, MIN_FLIGHT_SECONDS, SHORT_FLIGHT_SECONDS

MAX_EVENTS_PER_STEP = 256
"""Maximum number of events in one step of one element; further events are ignored."""
FRICTION_NONLINEARITY_TOLERANCE = 6.0 * 0.05
"""Tolerance of six times the nonlinearity (7) of dry friction.

It is a fraction of the largest friction so far: the tail of a Stribeck peak, almost zero at speed,
is strongly nonlinear in relation to itself.
"""
FORCE_NONLINEARITY_TOLERANCE = (6.0 * 0.005) ** 2
"""Tolerance of the square of six times the nonlinearity (7) of the acceleration.

It is a fraction of the square of the largest acceleration so far.
"""
NEGLIGIBLE_ACCELERATION_SHARE = 1e-5
"""Fraction of the largest acceleration so far below which friction is negligible.

Nonlinearity of negligible friction does not shorten a step.
"""
STEP_REDUCTION_FACTOR = 0.25
"""Reduction factor of the length of a step in which forces are too nonlinear."""
MIN_STEP_SHARE = 1.0 / 256.0
"""Fraction of a full step below which steps are not shortened."""
BREAK_AWAY_TIME_TOLERANCE = 1e-4
"""Time tolerance of break-away, as a fraction of a step."""
REST_SPEED_SHARE = 1e-9
"""Fraction of the speed change in a full step below which a stopped element is at rest."""


def dot(a: FloatArray, one: int, other: int, d: int, i: int) -> float:
    """Return the inner product of two vectors.

    Args:
        a: numbers of the slots.
        one: first row of the first vector.
        other: first row of the second vector.
        d: number of dimensions.
        i: index of the slot.
    """
    total = a[one, i] * a[other, i]
    for k in range(1, d):
        total += a[one + k, i] * a[other + k, i]
    return total  # type: ignore[no-any-return]


def compute_norm(a: FloatArray, one: int, d: int, i: int) -> float:
    """Return the magnitude of a vector.

    Args:
        a: numbers of the slots.
        one: first row of the vector.
        d: number of dimensions.
        i: index of the slot.
    """
    if d == 1:
        return abs(a[one, i])  # type: ignore[no-any-return]
    return np.sqrt(dot(a, one, one, d, i))  # type: ignore[no-any-return]


def find_event_time(value: float, rate: float, later: float, h: float) -> float:
    """Return the seconds to the last root of the interpolating parabola.

    The error is of third order in h; it is corrected when the root is reached.

    Args:
        value: value >= 0 at the beginning.
        rate: rate at the beginning.
        later: value < 0 after h seconds.
        h: step size in seconds.
    """
    bend = (value + h * rate - later) / (h * h)  # (8)
    turn = np.sqrt(rate * rate + 4.0 * bend * value)
    # (9): the form that adds numbers of equal sign is used.
    seconds = 2.0 * value / (turn - rate) if rate < 0.0 else (turn + rate) / (2.0 * bend)
    # Without a root, which only rounding can cause, the event is at the end of the step.
    return float(seconds if abs(seconds) < np.inf else h)


def is_too_nonlinear(program: ProgramArrays, block: BlockBuffers, i: int) -> bool:
    """Return whether forces are too nonlinear in the step just tried; set the next step size.

    Args:
        program: program of the system and its effects.
        block: buffers of the slots.
        i: index of the slot.
    """
    a = block.a
    d = program.flags[DIMENSIONS]
    h = a[H, i]
    a[PEAK, i] = nan_maximum(a[PEAK, i], dot(a, K1, K1, d, i))
    sharp = False
    if program.flags[PUSHED] != 0:
        square = 0.0
        for k in range(d):
            outer = a[K1 + k, i] + a[K4 + k, i]
            inner = a[K2 + k, i] + a[K3 + k, i]
            square += (outer - inner) * (outer - inner)
        sharp = square > FORCE_NONLINEARITY_TOLERANCE * a[PEAK, i]
    if program.flags[DRY] != 0:
        most = nan_maximum(compute_norm(a, F1, d, i), compute_norm(a, F4, d, i))
        a[RUBBED, i] = nan_maximum(a[RUBBED, i], most)
        faint = NEGLIGIBLE_ACCELERATION_SHARE * np.sqrt(a[PEAK, i]) * a[MASS, i]
        square = 0.0
        for k in range(d):
            change = a[F1 + k, i] - a[F2 + k, i] - a[F3 + k, i] + a[F4 + k, i]
            square += change * change
        size = abs(change) if d == 1 else np.sqrt(square)
        if block.n[STICKS, i] == 0 and size > FRICTION_NONLINEARITY_TOLERANCE * nan_maximum(
            a[RUBBED, i], faint
        ):
            sharp = True
    if sharp:
        sharp = h > MIN_STEP_SHARE * a[LONGEST, i] and has_no_pending_event(block, i)
    if sharp:
        a[LIMIT, i] = STEP_REDUCTION_FACTOR * h
    elif h >= a[LIMIT, i]:
        # The limit doubles with each accepted step of that length, as the nonlinearity may still be
        # near.
        a[LIMIT, i] = min(2.0 * a[LIMIT, i], a[LONGEST, i])
    return sharp


def has_no_pending_event(block: BlockBuffers, i: int) -> bool:
    """Return whether the element has no pending event and not too many events in its step."""
    return bool(block.n[GOAL, i] == NOTHING and block.n[EVENTS, i] < MAX_EVENTS_PER_STEP)


def detect_event(program: ProgramArrays, work: BatchArrays, block: BlockBuffers, i: int) -> bool:
    """Return whether an event is within the step just tried; schedule the event.

    Args:
        program: program of the system and its effects.
        work: batch of elements.
        block: buffers of the slots.
        i: index of the slot.
    """
    a = block.a
    d = program.flags[DIMENSIONS]
    h = a[H, i]
    watched = has_no_pending_event(block, i)
    found = False
    if watched and program.flags[BOUNCES] != 0:
        floor = work.ground[FLOOR, block.n[LANE, i]]
        later = a[NEXT_X + d - 1, i]
        if later < floor:
            height = a[X + d - 1, i] - floor
            rate = a[V + d - 1, i]
            schedule_event(block, i, find_event_time(height, rate, later - floor, h), IMPACT)
            found = True
    if program.flags[DRY] != 0:
        sticks = block.n[STICKS, i] != 0
        if watched and not sticks:
            later = dot(a, NEXT_V, WAY, d, i)
            if later < 0.0:
                speed = dot(a, V, WAY, d, i)
                rate = dot(a, K1, WAY, d, i)
                schedule_event(block, i, find_event_time(speed, rate, later, h), STANDSTILL)
                found = True
        to_loose = block.n[GOAL, i] == LOOSE
        if sticks and (watched or to_loose):
            before = a[BEFORE, i]
            after = a[AFTER, i]
            # A scheduled break-away is checked again with a tolerance.
            if after > (BREAK_AWAY_TIME_TOLERANCE * (after - before) if to_loose else 0.0):
                seconds = h * (before / (before - after) + 0.1 * BREAK_AWAY_TIME_TOLERANCE)
                schedule_event(block, i, seconds, LOOSE)
                found = True
    return found


def schedule_event(block: BlockBuffers, i: int, seconds: float, goal: int) -> None:
    """Schedule an event at the end of the next step; of two events the first counts.

    Args:
        block: buffers of the slots.
        i: index of the slot.
        seconds: seconds to the event.
        goal: kind of event.
    """
    if seconds < block.a[TRY, i]:
        block.a[TRY, i] = min(max(seconds, 0.0), block.a[H, i])
        block.n[GOAL, i] = goal
        block.n[EVENTS, i] += 1


def handle_event(program: ProgramArrays, work: BatchArrays, block: BlockBuffers, i: int) -> None:
    """Apply the event to which the step led.

    Args:
        program: program of the system and its effects.
        work: batch of elements.
        block: buffers of the slots.
        i: index of the slot.
    """
    goal = block.n[GOAL, i]
    if goal == IMPACT:
        handle_impact(program, work, block, i, K4)
    elif goal == STANDSTILL:
        handle_standstill(program, block, i)
    # Break-away needs no action: the next step finds that the element slips.
    block.a[TRY, i] = np.inf
    block.n[GOAL, i] = NOTHING


def shift_time(block: BlockBuffers, i: int, seconds: float) -> float:
    """Move the element's clock, at most by one step.

    Args:
        block: buffers of the slots.
        i: index of the slot.
        seconds: time correction in seconds; NaN counts as zero.

    Returns:
        The applied correction in seconds.
    """
    step = block.a[LONGEST, i]
    if seconds != seconds:
        seconds = 0.0
    seconds = min(max(seconds, -step), step)
    block.a[T, i] += seconds
    block.a[LEFT, i] = nan_maximum(block.a[LEFT, i] - seconds, 0.0)
    return seconds


def handle_impact(
    program: ProgramArrays, work: BatchArrays, block: BlockBuffers, i: int, k: int
) -> None:
    """Apply the impact to which a step led up to rounding.

    Args:
        program: program of the system and its effects.
        work: batch of elements.
        block: buffers of the slots.
        i: index of the slot.
        k: first row of the acceleration before the impact.
    """
    a = block.a
    d = program.flags[DIMENSIONS]
    floor = work.ground[FLOOR, block.n[LANE, i]]
    high = X + d - 1
    up = V + d - 1
    pull = a[k + d - 1, i]
    rate = a[up, i]
    late = 0.0
    if rate < 0.0:
        late = (floor - a[high, i]) / rate
        late *= 1.0 - 0.5 * late * pull / rate  # (10)
    late = shift_time(block, i, late)
    for j in range(d):
        acceleration = a[k + j, i]
        a[X + j, i] += late * (a[V + j, i] + 0.5 * late * acceleration)
        a[V + j, i] += late * acceleration
    # Exactly on the ground and not moving up, otherwise the next step would contain the same
    # impact.
    a[high, i] = floor
    a[up, i] = clip_to_non_positive(a[up, i])
    compute_rebound_velocity(program, work, block, i, pull)


def clip_to_non_positive(rate: float) -> float:
    """Return the rate if it is negative, otherwise zero; NaN stays NaN."""
    return rate if rate <= 0.0 or rate != rate else 0.0


def compute_rebound_velocity(
    program: ProgramArrays, work: BatchArrays, block: BlockBuffers, i: int, pull: float
) -> None:
    """Compute the velocity after an impact.

    Args:
        program: program of the system and its effects.
        work: batch of elements.
        block: buffers of the slots.
        i: index of the slot.
        pull: upward acceleration before the impact.
    """
    a = block.a
    r = block.r
    d = program.flags[DIMENSIONS]
    rows = program.rows
    lane = block.n[LANE, i]
    up = V + d - 1
    speed = abs(a[up, i])
    # The program runs on all slots up to this one; the results of the others are not used.
    width = i + 1
    for s in range(width):
        r[rows[IN_E], s] = work.ground[RESTITUTION, lane]
        r[rows[IN_MU], s] = work.ground[RUBBING, lane]
        r[rows[IN_SPEED], s] = speed
    run_instructions(program.code, program.ends[2], program.ends[3], r, width)
    e = r[rows[OUT_E], i]
    mu = r[rows[OUT_MU], i]
    leaves = e * speed
    lost = mu * (1.0 + e) * speed
    if is_bouncing_over(block, i, leaves, -pull):
        if e < 1.0:
            lost += mu * (1.0 + e) * leaves / (1.0 - e)
        leaves = 0.0
        block.n[RESTS, i] = 1
    if mu > 0.0:
        square = 0.0
        for j in range(d - 1):
            square += a[V + j, i] * a[V + j, i]
        along = abs(a[V, i]) if d == 2 else np.sqrt(square)
        share = 1.0 - lost / (along if along > 0.0 else 1.0)
        kept = nan_maximum(share, work.ground[LEAST, lane])
        for j in range(d - 1):
            a[V + j, i] *= kept
    a[up, i] = leaves


def is_bouncing_over(block: BlockBuffers, i: int, leaves: float, down: float) -> bool:
    """Return whether bouncing is finished after an impact.

    Args:
        block: buffers of the slots.
        i: index of the slot.
        leaves: rebound speed.
        down: downward acceleration.
    """
    if not down > 0.0:
        block.n[SHORTS, i] = 0
        return False
    flight = 2.0 * leaves / down
    block.n[SHORTS, i] = block.n[SHORTS, i] + 1 if flight < SHORT_FLIGHT_SECONDS else 0
    return bool(flight < MIN_FLIGHT_SECONDS or block.n[SHORTS, i] > MAX_SHORT_FLIGHTS)


def handle_standstill(program: ProgramArrays, block: BlockBuffers, i: int) -> None:
    """Stop the element, which has lost its speed along its direction up to rounding.

    Args:
        program: program of the system and its effects.
        block: buffers of the slots.
        i: index of the slot.
    """
    a = block.a
    d = program.flags[DIMENSIONS]
    slows = dot(a, K4, WAY, d, i)
    late = -dot(a, V, WAY, d, i) / slows if slows < 0.0 else 0.0
    late = shift_time(block, i, late)
    for k in range(d):
        a[X + k, i] += late * a[V + k, i]
        a[V + k, i] += late * a[K4 + k, i]
    along = dot(a, V, WAY, d, i)
    for k in range(d):
        a[V + k, i] -= a[WAY + k, i] * along
    # The speed becomes exactly zero, because only an element with zero speed can stick.
    guided = program.flags[GUIDED]
    if (
        compute_norm(a, V, guided, i)
        <= REST_SPEED_SHARE * compute_norm(a, K4, guided, i) * a[LONGEST, i]
    ):
        for k in range(guided):
            a[V + k, i] = 0.0
