"""What the compiled engine works on, as plain tuples of arrays, and the rows of its tables."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Numbers = NDArray[np.float64]
Row = NDArray[np.float64]
"""One number a lane."""
Table = NDArray[np.int64]

WIDTH = 32
"""Slots of a block: lanes that are stepped side by side."""
LARGEST = 6
"""Coordinates that a system may have."""


class Program(NamedTuple):
    """What a system with some effects computes, as instructions on registers.

    Attributes:
        code: (n, 5) operation, result, three arguments.
        ends: where its parts begin and end: what a lane's parameters settle; forces; impacts.
        rows: registers of t, x, v, inputs, parameters, restitution, friction of the ground and
            speed going in; of dry friction's limit, restitution and friction of
            the ground coming out.
        out: (D,) registers of the force.
        flags: dimensions D; whether dry friction acts, forces of effects act, it bounces; how many
            coordinates, the first ones, dry friction acts on.
    """

    code: Table
    ends: Table
    rows: Table
    out: Table
    flags: Table


class Work(NamedTuple):
    """Lanes of one program; N of them may be chosen out of more, L.

    Attributes:
        order: (N,) which lanes, in the order in which they begin.
        parameters: (N, P) of the program, in that order.
        mass: (L,) generalised inertia.
        x: (L, D) initial position.
        v: (L, D) initial velocity.
        steps: (L or 1, S) seconds.
        inputs: (U, L or 1, S).
        longest: (L,) seconds a step may last.
        planned: (L,) how many steps are planned.
        ground: (4, L) floor, restitution, friction, least share of tangential speed kept.
        every: a state is kept after so many steps.
        patience: a lane is given up that needs so many times the planned steps.
        kept: (L, R, 3 D) the states, to be filled in.
    """

    order: Table
    parameters: Numbers
    mass: Numbers
    x: Numbers
    v: Numbers
    steps: Numbers
    inputs: Numbers
    longest: Numbers
    planned: Numbers
    ground: Numbers
    every: int
    patience: float
    kept: Numbers


class Block(NamedTuple):
    """Room to work in.

    Attributes:
        r: (., WIDTH) registers.
        a: (., WIDTH) numbers of each slot, rows as below.
        n: (., WIDTH) whole numbers of each slot, rows as below.
    """

    r: Numbers
    a: Numbers
    n: Table


# Entries of `Program.rows`.
IN_T, IN_X, IN_V, IN_U, IN_P, IN_E, IN_MU, IN_SPEED, OUT_LIMIT, OUT_E, OUT_MU = range(11)
# Entries of `Program.flags`.
DIMENSIONS, DRY, PUSHED, BOUNCES, GUIDED = range(5)
# Rows of `Work.ground`.
FLOOR, RESTITUTION, RUBBING, LEAST = range(4)
# Rows of `Block.a`: one of each for a slot; then of each vector the first of LARGEST.
(
    T,
    LEFT,
    LIMIT,
    LONGEST,
    PEAK,
    RUBBED,
    TRY,
    H,
    MASS,
    BEFORE,
    AFTER,
    TAKEN,
    STARTS,
    BEND,
    SPARE,
    LEVEL,
    FIRST,
) = range(17)
X, V, K1, K2, K3, K4, NEXT_X, NEXT_V, WAY, F1, F2, F3, F4, ROWS = range(
    FIRST, FIRST + 14 * LARGEST, LARGEST
)
# Rows of `Block.n`.
PLACE, LANE, STEP, GOAL, EVENTS, SHORTS, BEGINS, STICKS, RESTS, IDLE, BUSY, ASKED = range(12)
WHOLE = ASKED + 6

NOTHING, IMPACT, STANDSTILL, LOOSE = range(4)
"""What a slot's next step leads to."""


def room(registers: int) -> Block:
    """A block of this size."""
    r = np.zeros((registers, WIDTH))
    return Block(r, np.zeros((ROWS, WIDTH)), np.zeros((WHOLE, WIDTH), dtype=np.int64))


def check(
    program: Program, work: Work, block: Block, w: int, spans: Numbers, parts: Numbers
) -> None:
    """See that all arrays are as their classes say, for code that does not look.

    Raises:
        ValueError: one is not.
    """
    lanes, d = work.x.shape
    chosen, columns = work.parameters.shape
    steps = work.steps.shape[1]
    rows = program.rows
    whole = [
        *((program.code, (len(program.code), 5)), (program.ends, (4,)), (rows, (11,))),
        *((program.out, (d,)), (program.flags, (5,))),
        *((work.order, (chosen,)), (block.n, (WHOLE, WIDTH))),
    ]
    real = [
        *((work.parameters, (chosen, columns)), (work.x, (lanes, d)), (work.v, (lanes, d))),
        *((work.mass, (lanes,)), (work.longest, (lanes,)), (work.planned, (lanes,))),
        *((spans, (lanes,)), (parts, (lanes,)), (work.ground, (4, lanes))),
        (work.steps, (1 if len(work.steps) == 1 else lanes, steps)),
        (work.inputs, (len(work.inputs), 1 if work.inputs.shape[1] == 1 else lanes, steps)),
        (work.kept, (lanes, steps // work.every + 1, 3 * d)),
        *((block.r, (len(block.r), WIDTH)), (block.a, (ROWS, WIDTH))),
    ]
    for arrays, kind in ((whole, np.int64), (real, np.float64)):
        for array, shape in arrays:
            if array.shape != shape or array.dtype != kind or not array.flags.c_contiguous:
                raise ValueError(f"expected {shape} {kind.__name__}, found {array.shape}")
    groups = rows[IN_V] - rows[IN_X], rows[IN_P] - rows[IN_U], rows[IN_E] - rows[IN_P]
    if (
        groups != (d, len(work.inputs), columns)
        or not (1 <= w <= WIDTH and 1 <= d <= LARGEST and chosen and steps)
        or not 0 <= work.order.min() <= work.order.max() < lanes
        or program.code.max(initial=0) >= len(block.r)
    ):
        raise ValueError("the program is not one for these lanes")
