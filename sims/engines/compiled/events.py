"""What happens to one lane between two steps: impacts, standstill, breaking loose, bends.

The same rules as in `sims.engines.batch.stepping`, `sims.engines.batch.roots` and
`sims.engines.ground`, which state them; the numbers of equations are theirs. `i` is a slot.
"""

from __future__ import annotations

import numpy as np

from sims.engines.batch import stepping
from sims.engines.compiled.evaluate import execute, larger
from sims.engines.compiled.kinds import (
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
    Block,
    H,
    Numbers,
    Program,
    T,
    V,
    Work,
    X,
)
from sims.engines.ground import PATIENCE, SHORT, SHORTEST

MANY = stepping.EVENTS
FRICTION_BEND = 6.0 * stepping.FRICTION_BEND
FORCE_BEND = (6.0 * stepping.FORCE_BEND) ** 2
FAINT = stepping.FAINT
SHORTENED = stepping.SHORTENED
FINEST = stepping.FINEST
PUNCTUAL = stepping.PUNCTUAL
STILL = stepping.STILL


def dot(a: Numbers, one: int, other: int, d: int, i: int) -> float:
    """Inner product of two vectors, from these rows on."""
    total = a[one, i] * a[other, i]
    for k in range(1, d):
        total += a[one + k, i] * a[other + k, i]
    return total  # type: ignore[no-any-return]


def length(a: Numbers, one: int, d: int, i: int) -> float:
    """Magnitude of a vector."""
    if d == 1:
        return abs(a[one, i])  # type: ignore[no-any-return]
    return np.sqrt(dot(a, one, one, d, i))  # type: ignore[no-any-return]


def root(value: float, rate: float, later: float, h: float) -> float:
    """Seconds to the last root of the parabola; see `sims.engines.batch.roots`."""
    bend = (value + h * rate - later) / (h * h)
    turn = np.sqrt(rate * rate + 4.0 * bend * value)
    seconds = 2.0 * value / (turn - rate) if rate < 0.0 else (turn + rate) / (2.0 * bend)
    return float(seconds if abs(seconds) < np.inf else h)


def bent(program: Program, block: Block, i: int) -> bool:
    """Whether forces bend too much in the step just tried; sets how long the next may be."""
    a = block.a
    d = program.flags[DIMENSIONS]
    h = a[H, i]
    a[PEAK, i] = larger(a[PEAK, i], dot(a, K1, K1, d, i))
    sharp = False
    if program.flags[PUSHED] != 0:
        square = 0.0
        for k in range(d):
            outer = a[K1 + k, i] + a[K4 + k, i]
            inner = a[K2 + k, i] + a[K3 + k, i]
            square += (outer - inner) * (outer - inner)
        sharp = square > FORCE_BEND * a[PEAK, i]
    if program.flags[DRY] != 0:
        most = larger(length(a, F1, d, i), length(a, F4, d, i))
        a[RUBBED, i] = larger(a[RUBBED, i], most)
        faint = FAINT * np.sqrt(a[PEAK, i]) * a[MASS, i]
        square = 0.0
        for k in range(d):
            change = a[F1 + k, i] - a[F2 + k, i] - a[F3 + k, i] + a[F4 + k, i]
            square += change * change
        size = abs(change) if d == 1 else np.sqrt(square)
        if block.n[STICKS, i] == 0 and size > FRICTION_BEND * larger(a[RUBBED, i], faint):
            sharp = True
    if sharp:
        sharp = h > FINEST * a[LONGEST, i] and is_open(block, i)
    if sharp:
        a[LIMIT, i] = SHORTENED * h
    elif h >= a[LIMIT, i]:
        # The limit doubles with each step that is made at it: what bent may still be near.
        a[LIMIT, i] = min(2.0 * a[LIMIT, i], a[LONGEST, i])
    return sharp


def is_open(block: Block, i: int) -> bool:
    """Whether it is under way to no event, and not after too many."""
    return bool(block.n[GOAL, i] == NOTHING and block.n[EVENTS, i] < MANY)


def interrupted(program: Program, work: Work, block: Block, i: int) -> bool:
    """Whether something happens within the step just tried; sets what and when."""
    a = block.a
    d = program.flags[DIMENSIONS]
    h = a[H, i]
    watched = is_open(block, i)
    found = False
    if watched and program.flags[BOUNCES] != 0:
        floor = work.ground[FLOOR, block.n[LANE, i]]
        later = a[NEXT_X + d - 1, i]
        if later < floor:
            height = a[X + d - 1, i] - floor
            rate = a[V + d - 1, i]
            expect(block, i, root(height, rate, later - floor, h), IMPACT)
            found = True
    if program.flags[DRY] != 0:
        sticks = block.n[STICKS, i] != 0
        if watched and not sticks:
            later = dot(a, NEXT_V, WAY, d, i)
            if later < 0.0:
                speed = dot(a, V, WAY, d, i)
                rate = dot(a, K1, WAY, d, i)
                expect(block, i, root(speed, rate, later, h), STANDSTILL)
                found = True
        to_loose = block.n[GOAL, i] == LOOSE
        if sticks and (watched or to_loose):
            before = a[BEFORE, i]
            after = a[AFTER, i]
            # On its way it is asked again, a little late being good enough.
            if after > (PUNCTUAL * (after - before) if to_loose else 0.0):
                seconds = h * (before / (before - after) + 0.1 * PUNCTUAL)
                expect(block, i, seconds, LOOSE)
                found = True
    return found


def expect(block: Block, i: int, seconds: float, goal: int) -> None:
    """Note to what and when the next step leads; of two events the first counts."""
    if seconds < block.a[TRY, i]:
        block.a[TRY, i] = min(max(seconds, 0.0), block.a[H, i])
        block.n[GOAL, i] = goal
        block.n[EVENTS, i] += 1


def reach(program: Program, work: Work, block: Block, i: int) -> None:
    """Let happen what a step led to."""
    goal = block.n[GOAL, i]
    if goal == IMPACT:
        strike(program, work, block, i, K4)
    elif goal == STANDSTILL:
        stop(program, block, i)
    # Breaking loose needs nothing done: the next step finds that the lane slips.
    block.a[TRY, i] = np.inf
    block.n[GOAL, i] = NOTHING


def correct(block: Block, i: int, seconds: float) -> float:
    """Move the lane's clock by `seconds`, no longer than a step; by how much it has moved."""
    step = block.a[LONGEST, i]
    if seconds != seconds:
        seconds = 0.0
    seconds = min(max(seconds, -step), step)
    block.a[T, i] += seconds
    block.a[LEFT, i] = larger(block.a[LEFT, i] - seconds, 0.0)
    return seconds


def strike(program: Program, work: Work, block: Block, i: int, k: int) -> None:
    """The impact to which a step led but for rounding; rows k are the acceleration before it."""
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
        late *= 1.0 - 0.5 * late * pull / rate  # (8)
    late = correct(block, i, late)
    for j in range(d):
        acceleration = a[k + j, i]
        a[X + j, i] += late * (a[V + j, i] + 0.5 * late * acceleration)
        a[V + j, i] += late * acceleration
    # On the ground to the last bit and not moving up, or the next step would strike it again.
    a[high, i] = floor
    a[up, i] = smaller_than_nothing(a[up, i])
    thrown(program, work, block, i, pull)


def smaller_than_nothing(rate: float) -> float:
    """At most zero."""
    return rate if rate <= 0.0 or rate != rate else 0.0


def thrown(program: Program, work: Work, block: Block, i: int, pull: float) -> None:
    """What the ground makes of the velocity; `pull` is the acceleration upward."""
    a = block.a
    r = block.r
    d = program.flags[DIMENSIONS]
    rows = program.rows
    lane = block.n[LANE, i]
    up = V + d - 1
    speed = abs(a[up, i])
    # All slots are asked although only this one struck: the numbers of the others are not read.
    width = r.shape[1]
    for s in range(width):
        r[rows[IN_E], s] = work.ground[RESTITUTION, lane]
        r[rows[IN_MU], s] = work.ground[RUBBING, lane]
        r[rows[IN_SPEED], s] = speed
    execute(program.code, program.ends[2], program.ends[3], r, width)
    e = r[rows[OUT_E], i]
    mu = r[rows[OUT_MU], i]
    leaves = e * speed
    lost = mu * (1.0 + e) * speed
    if is_over(block, i, leaves, -pull):
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
        kept = larger(share, work.ground[LEAST, lane])
        for j in range(d - 1):
            a[V + j, i] *= kept
    a[up, i] = leaves


def is_over(block: Block, i: int, leaves: float, down: float) -> bool:
    """Whether bouncing is over, after an impact that would be left with this speed."""
    if not down > 0.0:
        block.n[SHORTS, i] = 0
        return False
    flight = 2.0 * leaves / down
    block.n[SHORTS, i] = block.n[SHORTS, i] + 1 if flight < SHORT else 0
    return bool(flight < SHORTEST or block.n[SHORTS, i] > PATIENCE)


def stop(program: Program, block: Block, i: int) -> None:
    """The lane has lost its speed along its way but for rounding."""
    a = block.a
    d = program.flags[DIMENSIONS]
    slows = dot(a, K4, WAY, d, i)
    late = -dot(a, V, WAY, d, i) / slows if slows < 0.0 else 0.0
    late = correct(block, i, late)
    for k in range(d):
        a[X + k, i] += late * a[V + k, i]
        a[V + k, i] += late * a[K4 + k, i]
    along = dot(a, V, WAY, d, i)
    for k in range(d):
        a[V + k, i] -= a[WAY + k, i] * along
    # Exactly zero, not nearly: only a lane of no speed at all can stick.
    guided = program.flags[GUIDED]
    if length(a, V, guided, i) <= STILL * length(a, K4, guided, i) * a[LONGEST, i]:
        for k in range(guided):
            a[V + k, i] = 0.0
