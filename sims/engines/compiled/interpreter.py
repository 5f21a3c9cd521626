"""Vector interpreter of force programs: each instruction is one loop over the slots of a block.

The functions are compiled once for all programs (`numba_compilation`). A register is a row, a slot
a column. Forces that cannot be written as instructions are evaluated by a function
of Python, which an instruction calls by its address (`sims.engines.compiled.register_programs`).
Sine, cosine and exponential are computed in the same way for every element, with the argument
reductions and coefficients of fdlibm (Sun Microsystems, 1993): x = k pi/2 + r with |r| <= pi/4, and
x = k ln 2 + r with |r| <= ln 2 / 2,

    sin r = r + r^3 (S1 + ...),    cos r = 1 - r^2/2 + r^4 (C1 + ...)      (1)
    exp r = 1 + r + r c / (2 - c),    c = r - r^2 (P1 + ...)               (2)
"""

from __future__ import annotations

import numpy as np

from sims.engines.compiled.data_layout import Block, FloatArray, IntTable
from sims.engines.compiled.intrinsics import call_external
from sims.engines.compiled.traced_array import EXTERNAL, OPERATION_CODES

ROUNDING_OFFSET = 6755399441055744.0
"""Number whose addition and subtraction rounds to the nearest integer: 1.5 * 2^52."""
TWO_OVER_PI = 2.0 / np.pi
HALF_PI_HIGH = 1.57079632673412561417e00
"""First 33 bits of pi/2; multiples up to 2^20 are exact."""
HALF_PI_MIDDLE = 6.07710050630396597660e-11
"""Second 33 bits of pi/2."""
HALF_PI_LOW = 2.02226624879595063154e-21
"""Remainder of pi/2 after the first 66 bits."""
MAX_REDUCED_ANGLE = 1e5
"""Largest angle in radians for the reduction; beyond it the library's sine is used."""

INVERSE_LN_2 = 1.44269504088896338700e00
"""Inverse of ln 2."""
LN_2_HIGH = 6.93147180369123816490e-01
"""First 32 bits of ln 2."""
LN_2_LOW = 1.90821492927058770002e-10
"""Remainder of ln 2 after the first 32 bits."""
MAX_EXPONENT = 700.0
"""Largest argument of the exponential; beyond it the library's exponential is used."""
EXPONENT_BIT_OFFSET = ROUNDING_OFFSET + 1023.0
"""Number whose sum with an integer k has the exponent of 2^k in its last bits."""

(
    ADD, SUBTRACT, MULTIPLY, DIVIDE, NEGATIVE, ABSOLUTE, SQRT, MAXIMUM, MINIMUM, WHERE, SIN, COS,
    EXP, POWER, LESS, LESS_EQUAL, EQUAL, NOT_EQUAL, AND, OR, NOT, SIGN, TAN, TANH, ARCTAN,
    ARCTAN2, LOG, EXPM1, LOG1P, FLOOR, CEIL, RINT, SINH, COSH, ARCSIN, ARCCOS, HYPOT, COPYSIGN,
) = OPERATION_CODES.values()  # fmt: skip
"""Codes of the operations, in the order of `traced_array.OPERATIONS`."""


def nan_maximum(a: float, b: float) -> float:
    """Return the maximum as `numpy.maximum`: NaN if an argument is NaN.

    Args:
        a: first number.
        b: second number.
    """
    return a if a >= b or a != a else b


def nan_minimum(a: float, b: float) -> float:
    """Return the minimum as `numpy.minimum`: NaN if an argument is NaN.

    Args:
        a: first number.
        b: second number.
    """
    return a if a <= b or a != a else b


def evaluate_sine(r: FloatArray, o: int, a: int, w: int, quarter_turns: float) -> None:
    """Compute the sine or cosine of a row of registers, as fdlibm does.

    An own version computes every element in the same way, and is vectorised over slots. The
    argument is split into k quarter turns and a remainder, x = k pi/2 + y with |y| <= pi/4.
    Polynomials give sin y and cos y (1); whether k is odd selects one of them, and k modulo 4 its
    sign. Angles that are too large for this splitting are left to the library's function.

    Args:
        r: registers (rows, slots).
        o: row of the result.
        a: row of the argument in radians.
        w: number of slots in use.
        quarter_turns: number of quarter turns: 0 for sine, 1 for cosine.
    """
    is_large = False
    for i in range(w):
        x = r[a, i]
        k = (x * TWO_OVER_PI + ROUNDING_OFFSET) - ROUNDING_OFFSET  # rounded to an integer
        y = ((x - k * HALF_PI_HIGH) - k * HALF_PI_MIDDLE) - k * HALF_PI_LOW
        z = y * y
        # Coefficients of fdlibm, from S6 to S1 and from C6 to C1.
        s = -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10
        s = -1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 + z * s)
        s = -1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * s)
        sine = y + y * z * s
        c = 2.08757232129817482790e-09 + z * -1.13596475577881948265e-11
        c = 2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + z * c)
        c = 4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * c)
        cosine = 1.0 - (0.5 * z - z * z * c)  # (1)
        k = k + quarter_turns
        half_quarters = 0.5 * k
        is_odd = half_quarters != (half_quarters + ROUNDING_OFFSET) - ROUNDING_OFFSET
        quarter = k - 4.0 * ((0.25 * k + ROUNDING_OFFSET) - ROUNDING_OFFSET)  # -2 to 2
        value = cosine if is_odd else sine
        # The signs of sin (y + k pi/2): negative in the third and fourth quarter turn.
        flips = quarter == 2.0 or quarter == -2.0 or quarter == -1.0
        r[o, i] = -value if flips else value
        is_large |= not abs(x) <= MAX_REDUCED_ANGLE
    if is_large:
        for i in range(w):
            if not abs(r[a, i]) <= MAX_REDUCED_ANGLE:
                r[o, i] = np.sin(r[a, i]) if quarter_turns == 0.0 else np.cos(r[a, i])


def evaluate_exponential(r: FloatArray, o: int, a: int, w: int) -> None:
    """Compute the exponential of a row of registers, as fdlibm does.

    The argument is split as x = k ln 2 + y with |y| <= ln 2 / 2. Then exp x = 2^k exp y, where
    exp y = 1 + y + y c / (2 - c) with a polynomial c in y^2 (2), and 2^k is made by writing k into
    the exponent bits of a number. Arguments that are too large are left to the library's function.

    Args:
        r: registers (rows, slots).
        o: row of the result.
        a: row of the argument.
        w: number of slots in use.
    """
    is_large = False
    for i in range(w):
        x = r[a, i]
        k = (x * INVERSE_LN_2 + ROUNDING_OFFSET) - ROUNDING_OFFSET  # rounded to an integer
        high = x - k * LN_2_HIGH
        low = k * LN_2_LOW
        y = high - low
        z = y * y
        # Coefficients of fdlibm, from P5 to P1.
        c = -1.65339022054652515390e-06 + z * 4.13813679705723846039e-08
        c = -2.77777777770155933842e-03 + z * (6.61375632143793436117e-05 + z * c)
        c = y - z * (1.66666666666666019037e-01 + z * c)
        value = 1.0 - ((low - y * c / (2.0 - c)) - high)  # (2)
        scale = np.int64(np.float64(k + EXPONENT_BIT_OFFSET).view(np.int64) << 52).view(np.float64)
        r[o, i] = value * scale
        is_large |= not abs(x) <= MAX_EXPONENT
    if is_large:
        for i in range(w):
            if not abs(r[a, i]) <= MAX_EXPONENT:
                r[o, i] = np.exp(r[a, i])


def run_instructions(code: IntTable, first: int, last: int, r: FloatArray, w: int) -> None:
    """Run the instructions from `first` to `last` - 1 of a force program on the registers.

    An instruction has five numbers: the operation `op`, the row `o` of the result, and the rows
    `a`, `b` and `c` of up to three arguments. It is applied to all slots in use. Each operation has
    its own loop over the slots, which the compiler can vectorise.

    Args:
        code: (n, 5) instructions.
        first: index of the first instruction.
        last: index after the last instruction.
        r: registers (rows, slots): a row for each value of the program, a column for each element.
        w: number of slots in use.
    """
    for n in range(first, last):
        op = code[n, 0]
        o = code[n, 1]
        a = code[n, 2]
        b = code[n, 3]
        c = code[n, 4]
        if op == ADD:
            for i in range(w):
                r[o, i] = r[a, i] + r[b, i]
        elif op == SUBTRACT:
            for i in range(w):
                r[o, i] = r[a, i] - r[b, i]
        elif op == MULTIPLY:
            for i in range(w):
                r[o, i] = r[a, i] * r[b, i]
        elif op == DIVIDE:
            for i in range(w):
                r[o, i] = r[a, i] / r[b, i]
        elif op == NEGATIVE:
            for i in range(w):
                r[o, i] = -r[a, i]
        elif op == ABSOLUTE:
            for i in range(w):
                r[o, i] = abs(r[a, i])
        elif op == SQRT:
            for i in range(w):
                r[o, i] = np.sqrt(r[a, i])
        elif op == MAXIMUM:
            for i in range(w):
                r[o, i] = nan_maximum(r[a, i], r[b, i])
        elif op == MINIMUM:
            for i in range(w):
                r[o, i] = nan_minimum(r[a, i], r[b, i])
        elif op == WHERE:
            for i in range(w):
                yes = r[b, i]
                no = r[c, i]
                r[o, i] = yes if r[a, i] != 0.0 else no
        elif op == SIN:
            evaluate_sine(r, o, a, w, quarter_turns=0.0)
        elif op == COS:
            evaluate_sine(r, o, a, w, quarter_turns=1.0)
        elif op == EXP:
            evaluate_exponential(r, o, a, w)
        elif op == EXTERNAL:
            # Here b and c are not rows, but the part of the program and the function's address.
            call_external(c, b, w)
        else:
            run_rare_instruction(op, r, o, a, b, w)


def run_part(block: Block, part: int) -> None:
    """Run one part of the force program on all slots in use, which hold one element each.

    Entries `part` and `part + 1` of `block.ends` are the bounds of its instructions.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`.
        part: `CONSTANTS`, `FORCES` or `IMPACTS`.
    """
    run_instructions(block.code, block.ends[part], block.ends[part + 1], block.r, block.w)


def run_rare_instruction(op: int, r: FloatArray, o: int, a: int, b: int, w: int) -> None:
    """Run an instruction that is not one of the common ones in `run_instructions`.

    Comparisons give 1 for true and 0 for false. There is one loop over slots for all operations,
    because these instructions are too rare to need vector code.

    Args:
        op: operation code.
        r: registers.
        o: row of the result.
        a: row of the first argument.
        b: row of the second argument.
        w: number of slots in use.
    """
    for i in range(w):
        x = r[a, i]
        y = r[b, i]  # not used by operations of one argument
        if op == POWER:
            z = np.power(x, y)
        elif op == LESS:
            z = 1.0 if x < y else 0.0
        elif op == LESS_EQUAL:
            z = 1.0 if x <= y else 0.0
        elif op == EQUAL:
            z = 1.0 if x == y else 0.0
        elif op == NOT_EQUAL:
            z = 1.0 if x != y else 0.0
        elif op == AND:
            z = 1.0 if x != 0.0 and y != 0.0 else 0.0
        elif op == OR:
            z = 1.0 if x != 0.0 or y != 0.0 else 0.0
        elif op == NOT:
            z = 1.0 if x == 0.0 else 0.0
        elif op == SIGN:
            z = np.sign(x)
        elif op == TAN:
            z = np.tan(x)
        elif op == TANH:
            z = np.tanh(x)
        elif op == ARCTAN:
            z = np.arctan(x)
        elif op == ARCTAN2:
            z = np.arctan2(x, y)
        elif op == LOG:
            z = np.log(x)
        elif op == EXPM1:
            z = np.expm1(x)
        elif op == LOG1P:
            z = np.log1p(x)
        elif op == FLOOR:
            z = np.floor(x)
        elif op == CEIL:
            z = np.ceil(x)
        elif op == RINT:
            z = np.rint(x)
        elif op == SINH:
            z = np.sinh(x)
        elif op == COSH:
            z = np.cosh(x)
        elif op == ARCSIN:
            z = np.arcsin(x)
        elif op == ARCCOS:
            z = np.arccos(x)
        elif op == HYPOT:
            z = np.hypot(x, y)
        else:
            z = np.copysign(x, y)
        r[o, i] = z
