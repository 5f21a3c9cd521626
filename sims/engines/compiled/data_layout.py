"""Data layout of the compiled engine: tuples of arrays, and the rows of its tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sims.engines.compiled.traced_array import EXTERNAL

Array = NDArray[Any]
INTEGERS = "#"
"""Prefix of the shapes of integer arrays, and the shape of an integer argument."""


def measure_arrays(shapes: Sequence[str], arguments: Sequence[Any]) -> dict[str, int]:
    """Check arrays against declared shapes, and return the size that each letter stands for.

    A shape has one character for each dimension: a digit is a fixed size, and equal letters must
    have equal sizes in all arrays. For example, ``ld`` and ``l`` are an array (l, d) and another
    one with the same number l of rows. A prefix ``#`` marks integers instead of floating-point
    numbers; ``#`` alone is an integer argument, which is skipped. The machine code relies on this
    check, since it does not check array bounds.

    Args:
        shapes: shapes of the arguments.
        arguments: arrays, and integers where the shape is `INTEGERS`.

    Raises:
        ValueError: an array has another shape, type or memory layout than declared.
    """
    sizes: dict[str, int] = {}
    for shape, array in zip(shapes, arguments, strict=True):
        if shape == INTEGERS:
            continue
        letters = shape.removeprefix(INTEGERS)
        kind = np.int64 if shape.startswith(INTEGERS) else np.float64
        expected = tuple(
            int(letter) if letter.isdigit() else sizes.setdefault(letter, size)
            for letter, size in zip(letters, array.shape, strict=False)
        )
        if (
            array.shape != expected
            or array.ndim != len(letters)
            or array.dtype != kind
            or not array.flags.c_contiguous
        ):
            raise ValueError(
                f"expected a contiguous array of shape {expected} of {kind.__name__}, got"
                f" {array.dtype} of shape {array.shape}"
            )
    return sizes


def make_example(shape: str) -> Any:
    """Return an example of an argument with this shape."""
    if shape == INTEGERS:
        return 1
    kind = np.int64 if shape.startswith(INTEGERS) else np.float64
    return np.zeros((1,) * len(shape.removeprefix(INTEGERS)), dtype=kind)


FloatArray = NDArray[np.float64]
Row = NDArray[np.float64]
"""Array with one number per batch element."""
IntTable = NDArray[np.int64]

BLOCK_WIDTH = 32
"""Number of slots of a block: elements that are stepped together."""
MAX_COORDINATES = 15
"""Maximum number of coordinates of a system."""


class ProgramArrays(NamedTuple):
    """Force program of a system with some effects: instructions on registers.

    Attributes:
        code: (n, 5) operation, result register, three argument registers.
        ends: (4,) boundaries of its parts: values that depend on parameters alone; forces; impacts.
        rows: (11,) input registers of t, x, v, inputs, parameters, restitution, friction of the
            ground and speed; output registers of the limit of dry friction, restitution and
            friction of the ground.
        out: (D,) registers of the force.
        flags: (6,) number of dimensions D; whether dry friction acts; whether forces of effects
            act, or the system's own force may change sharply; whether it bounces; number of
            coordinates, counted from the first, on which dry friction acts; whether the system has
            hidden states, or its own force may change sharply.
    """

    code: IntTable
    ends: IntTable
    rows: IntTable
    out: IntTable
    flags: IntTable


class BatchArrays(NamedTuple):
    """Batch elements of one program; N of them are selected out of L.

    Attributes:
        order: (N,) selected elements.
        parameters: (N, P) parameters of the program, in the order of `order`.
        mass: (L,) generalised inertia.
        x: (L, D) initial position.
        v: (L, D) initial velocity.
        steps: (L or 1, S) step sizes in seconds.
        inputs: (U, L or 1, S) inputs.
        max_steps: (L,) longest step in seconds; it is shortened where steps are divided.
        planned_counts: (L,) number of planned steps.
        divisions: (L,) minimum numbers of parts into which steps are divided, whole and at most
            `step_size.MAX_STEP_DIVISIONS`; they are raised where an element moves fast.
        ground: (4, L) floor, restitution, friction, minimum remaining fraction of tangential speed.
        limits: (2,) maximum number of steps of an element, as a multiple of the planned ones, and
            maximum phase of an oscillation per step in radians.
        records: (L, R, 3 D) recorded states, to be filled in.
        steps_per_record: number of steps between recorded states.
    """

    order: IntTable
    parameters: FloatArray
    mass: FloatArray
    x: FloatArray
    v: FloatArray
    steps: FloatArray
    inputs: FloatArray
    max_steps: FloatArray
    planned_counts: FloatArray
    divisions: FloatArray
    ground: FloatArray
    limits: FloatArray
    records: FloatArray
    steps_per_record: int


class BlockBuffers(NamedTuple):
    """Buffers of a block.

    Attributes:
        r: (., W) registers.
        a: (., W) floating-point numbers of each slot; rows as below.
        n: (., W) integers of each slot; rows as below.
    """

    r: FloatArray
    a: FloatArray
    n: IntTable


class Block(NamedTuple):
    """Argument of the compiled functions: `ProgramArrays`, `BatchArrays` and `BlockBuffers`.

    A slot is a column of the buffers that holds one batch element.

    Attributes:
        w: number of slots in use.
    """

    code: IntTable
    ends: IntTable
    rows: IntTable
    out: IntTable
    flags: IntTable
    order: IntTable
    parameters: FloatArray
    mass: FloatArray
    x: FloatArray
    v: FloatArray
    steps: FloatArray
    inputs: FloatArray
    max_steps: FloatArray
    planned_counts: FloatArray
    divisions: FloatArray
    ground: FloatArray
    limits: FloatArray
    records: FloatArray
    r: FloatArray
    a: FloatArray
    n: IntTable
    steps_per_record: int
    w: int


BLOCK_SHAPES = (
    *("#i5", "#4", "#q", "#d", "#6", "#s", "sp", "l", "ld", "ld", "kt", "ujt"),
    *("l", "l", "l", "4l", "2", "lyz", "rw", "aw", "#nw", "#", "#"),
)
"""Shapes of the arrays of `Block`, see `measure_arrays`.

d coordinates, s of l elements, t steps, u inputs, p parameters, w slots, y records of z numbers, r
registers, q entries of `rows`, i instructions, a and n rows of the buffers; k and j are 1 or l.
"""
CONSTANTS, FORCES, IMPACTS = range(3)
"""Parts of a force program; part k begins at entry k of `ProgramArrays.ends`."""
# Entries of `ProgramArrays.rows`.
IN_T, IN_X, IN_V, IN_U, IN_P, IN_E, IN_MU, IN_SPEED, OUT_LIMIT, OUT_E, OUT_MU = range(11)
# Entries of `ProgramArrays.flags`.
(
    DIMENSIONS,
    HAS_FRICTION,
    HAS_FORCES,
    BOUNCES,
    FRICTION_COORDINATE_COUNT,
    HAS_HIDDEN_STATES,
) = range(6)
# Rows of `BatchArrays.ground`.
FLOOR, RESTITUTION, GROUND_FRICTION, MIN_REMAINING_SHARE = range(4)
# Entries of `BatchArrays.limits`.
PATIENCE, MAX_PHASE = range(2)
# Rows of `BlockBuffers.a`: first the rows with one number per slot, then the first row of each
# vector. MAX_ACCELERATION is the square of the largest acceleration so far. EXCESS_BEFORE and
# EXCESS_AFTER are the force minus the limit of dry friction at the ends of a step, and H is the
# step size.
(
    T,
    REMAINING_TIME,
    STEP_LIMIT,
    MAX_STEP,
    MAX_ACCELERATION,
    MAX_FRICTION,
    EVENT_DELAY,
    H,
    MASS,
    EXCESS_BEFORE,
    EXCESS_AFTER,
    STEP_COUNT,
    STEP_START,
    FLOOR_LEVEL,
    FIRST_VECTOR,
) = range(15)
X, V, K1, K2, K3, K4, NEXT_X, NEXT_V, DIRECTION, F1, F2, F3, F4, NUMBER_ROW_COUNT = range(
    FIRST_VECTOR, FIRST_VECTOR + 14 * MAX_COORDINATES, MAX_COORDINATES
)
# Rows of `BlockBuffers.n`.
(
    ORDER_INDEX,
    ELEMENT,
    STEP_INDEX,
    PENDING_EVENT,
    EVENT_COUNT,
    SHORT_FLIGHT_COUNT,
    IS_STEP_START,
    IS_STICKING,
    IS_RESTING,
    IS_IDLE,
    SAMPLED_STEP,
) = range(11)
STATE_ROW_COUNT = SAMPLED_STEP + 6

NO_EVENT, IMPACT, STANDSTILL, BREAK_AWAY = range(4)
"""Event to which a slot's next step leads."""


def allocate_block(registers: FloatArray) -> BlockBuffers:
    """Allocate the buffers of a block with these registers (., W)."""
    width = registers.shape[1]
    return BlockBuffers(
        registers,
        np.zeros((NUMBER_ROW_COUNT, width)),
        np.zeros((STATE_ROW_COUNT, width), dtype=np.int64),
    )


def check_block(block: Block) -> None:
    """Check that the arrays of a block match, because machine code does not check array bounds.

    First their shapes must agree with `BLOCK_SHAPES`. Then the registers of the program must have
    room for the inputs, the records for all sample times, every selected element must exist, and
    instructions may use only existing registers.

    Raises:
        ValueError: an array is not as specified.
    """
    # Sizes by the letters of `BLOCK_SHAPES`: d coordinates, l elements of which s are selected, t
    # steps, u inputs, p parameters, w slots, y records of z numbers, r registers, q entries of
    # `rows`, a and n rows of the buffers; k rows of steps and j rows of inputs.
    sizes = measure_arrays(BLOCK_SHAPES, block)
    d, elements, steps, rows = sizes["d"], sizes["l"], sizes["t"], block.rows
    # Numbers of registers for positions, inputs and parameters. They are consecutive groups, and
    # `rows` has the first register of each, so that a group ends where the next one begins.
    register_counts = rows[IN_V] - rows[IN_X], rows[IN_P] - rows[IN_U], rows[IN_E] - rows[IN_P]
    record_sizes = steps // block.steps_per_record + 1, 3 * d
    if (
        register_counts != (d, sizes["u"], sizes["p"])
        or (sizes["y"], sizes["z"]) != record_sizes
        or (sizes["q"], sizes["a"], sizes["n"]) != (11, NUMBER_ROW_COUNT, STATE_ROW_COUNT)
        # Inputs and steps are those of each element, or the same for all.
        or not {sizes["j"], sizes["k"]} <= {1, elements}
        or not (1 <= block.w <= sizes["w"] and 1 <= d <= MAX_COORDINATES and sizes["s"] and steps)
        or not 0 <= block.order.min() <= block.order.max() < elements
        or not uses_registers(block.code, sizes["r"])
    ):
        raise ValueError("the force program does not match the arrays of the batch")


def uses_registers(code: IntTable, count: int) -> bool:
    """Return whether all instructions use only existing registers.

    Calls of external functions are not checked: their arguments are addresses, not registers.

    Args:
        code: (n, 5) n instructions: operation, register of the result, registers of arguments.
        count: number of registers.
    """
    is_external = code[:, 0] == EXTERNAL
    # The initial values are those for a program without instructions.
    return bool(code.min(initial=0) >= 0 and code[~is_external, 1:].max(initial=-1) < count)
