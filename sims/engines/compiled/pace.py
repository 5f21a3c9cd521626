"""How long steps may be, as `sims.engines.batch.pace` has it, for the lanes of one program."""

from __future__ import annotations

import numpy as np

from sims.engines.batch import pace
from sims.engines.compiled.clock import load
from sims.engines.compiled.dynamics import present
from sims.engines.compiled.evaluate import execute, larger
from sims.engines.compiled.kinds import (
    ASKED,
    DIMENSIONS,
    IN_U,
    IN_V,
    IN_X,
    K1,
    LANE,
    MASS,
    PEAK,
    RUBBED,
    Block,
    Program,
    Row,
    V,
    Work,
    X,
)

NUDGE = pace.NUDGE
DIVISIONS = float(pace.DIVISIONS)
INSTANTS = pace.INSTANTS
SHARE = pace.TURN / pace.DECAY


def divide(
    program: Program, work: Work, block: Block, w: int, spans: Row, turn: float, parts: Row
) -> None:
    """Raise `parts` (L,) to those in which steps of `spans` (L,) seconds must be made; w slots."""
    instants = INSTANTS if work.inputs.shape[0] > 0 else 1
    for first in range(0, work.order.size, w):
        for i in range(w):
            load(program, work, block, i, min(first + i, work.order.size - 1))
            if instants > 1:
                choose(work, block, i)
        execute(program.code, program.ends[0], program.ends[1], block.r, w)
        for instant in range(instants):
            if instants > 1:
                feel_at(program, work, block, w, instant)
            for still in range(2):
                rates(program, work, block, w, still == 1)
                for i in range(min(w, work.order.size - first)):
                    lane = block.n[LANE, i]
                    turned = np.sqrt(block.a[PEAK, i]) * spans[lane]
                    decayed = block.a[RUBBED, i] * spans[lane] * SHARE
                    needed = np.ceil(larger(turned, decayed) / turn)
                    # What is no number tells nothing, and one part will do.
                    if needed > parts[lane]:
                        parts[lane] = min(needed, DIVISIONS)


def choose(work: Work, block: Block, i: int) -> None:
    """Set at which steps of its own a lane's inputs are asked for; waiting does not count."""
    n = block.n
    shared = work.steps.shape[0] == 1
    if shared and i > 0:
        for k in range(INSTANTS):
            n[ASKED + k, i] = n[ASKED + k, 0]
        return
    row = 0 if shared else n[LANE, i]
    steps = work.steps.shape[1]
    total = 0
    for s in range(steps):
        total += work.steps[row, s] > 0.0
    done = 0
    k = 0
    for s in range(steps):
        done += work.steps[row, s] > 0.0
        while k < INSTANTS and done >= np.ceil(k * (1.0 / (INSTANTS - 1)) * total):
            n[ASKED + k, i] = s
            k += 1


def feel_at(program: Program, work: Work, block: Block, w: int, instant: int) -> None:
    """Set the inputs of every lane to those at one of its instants."""
    first = program.rows[IN_U]
    for i in range(w):
        row = block.n[LANE, i] if work.inputs.shape[1] > 1 else 0
        for u in range(work.inputs.shape[0]):
            block.r[first + u, i] = work.inputs[u, row, block.n[ASKED + instant, i]]


def rates(program: Program, work: Work, block: Block, w: int, still: bool) -> None:
    """Largest change of acceleration with position, 1/s^2, into row PEAK, and with velocity, 1/s,
    into row RUBBED.
    """
    a = block.a
    d = program.flags[DIMENSIONS]
    for i in range(w):
        a[PEAK, i] = 0.0
        a[RUBBED, i] = 0.0
        for k in range(d):
            x = work.x[block.n[LANE, i], k]
            v = work.v[block.n[LANE, i], k]
            a[X + k, i] = 0.0 * x if still else x
            a[V + k, i] = 0.0 * v if still else v
    present(program, block, w)
    for k in range(d):
        for i in range(w):
            a[K1 + k, i] = block.r[program.out[k], i]
    for k in range(d):
        changed(program, block, w, k, program.rows[IN_X], PEAK)
        changed(program, block, w, k, program.rows[IN_V], RUBBED)


def changed(program: Program, block: Block, w: int, k: int, register: int, to: int) -> None:
    """Raise row `to` to the change of acceleration with coordinate k of what begins at
    `register`.
    """
    a = block.a
    if to == RUBBED:
        # Beside rest and not across it: what jumps there decays no faster for it.
        for i in range(w):
            block.r[register + k, i] += NUDGE
        execute(program.code, program.ends[1], program.ends[2], block.r, w)
        for i in range(w):
            a[K1 + k, i] = block.r[program.out[k], i]
    for i in range(w):
        block.r[register + k, i] += NUDGE
    execute(program.code, program.ends[1], program.ends[2], block.r, w)
    for i in range(w):
        change = block.r[program.out[k], i] - a[K1 + k, i]
        slope = abs(change / (NUDGE * a[MASS, i]))
        if slope > a[to, i]:
            a[to, i] = slope
    block_row = (X if to == PEAK else V) + k
    for i in range(w):
        block.r[register + k, i] = a[block_row, i]
