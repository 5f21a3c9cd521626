"""Exported function of the kernel: it receives pointers and steps the elements."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sims.engines.compiled.data_layout import (
    BLOCK_WIDTH,
    ROWS,
    STATE_ROW_COUNT,
    BatchArrays,
    BlockBuffers,
    ProgramArrays,
)
from sims.engines.compiled.element_stepping import step_block
from sims.engines.compiled.interpreter import run_instructions
from sims.engines.compiled.lockstep_stepping import step_in_lockstep
from sims.engines.compiled.step_size import choose_step_divisions

if TYPE_CHECKING:

    def carray(pointer: Any, shape: Any) -> Any:
        """Return the array at a pointer; the compiler's own function."""


SIZE_ARGUMENT_COUNT = 13
"""Number of integers in the first argument of `kernel_entry`."""
ARRAY_ARGUMENT_COUNT = 22
"""Number of array pointers of `kernel_entry`, including that of the two floating-point numbers."""


def kernel_entry(
    sizes_at: Any,
    reals_at: Any,
    code_at: Any,
    ends_at: Any,
    rows_at: Any,
    out_at: Any,
    flags_at: Any,
    order_at: Any,
    n_at: Any,
    parameters_at: Any,
    mass_at: Any,
    x_at: Any,
    v_at: Any,
    steps_at: Any,
    inputs_at: Any,
    longest_at: Any,
    planned_at: Any,
    ground_at: Any,
    kept_at: Any,
    r_at: Any,
    a_at: Any,
    spans_at: Any,
    parts_at: Any,
) -> None:
    """Run a function of the kernel with arrays given by their addresses.

    The first integer selects the function: `choose_step_divisions` (0), `step_block` (1),
    `step_in_lockstep` (2) or `run_instructions` (3).
    """
    sizes = carray(sizes_at, (SIZE_ARGUMENT_COUNT,))
    if sizes[0] == 3:
        code, r = carray(code_at, (sizes[4], 5)), carray(r_at, (sizes[11], sizes[12]))
        run_instructions(code, sizes[1], sizes[2], r, sizes[12])
        return
    reals = carray(reals_at, (2,))
    lanes = sizes[1]
    chosen = sizes[2]
    d = sizes[3]
    program = ProgramArrays(
        carray(code_at, (sizes[4], 5)),
        carray(ends_at, (4,)),
        carray(rows_at, (11,)),
        carray(out_at, (d,)),
        carray(flags_at, (5,)),
    )
    work = BatchArrays(
        carray(order_at, (chosen,)),
        carray(parameters_at, (chosen, sizes[5])),
        carray(mass_at, (lanes,)),
        carray(x_at, (lanes, d)),
        carray(v_at, (lanes, d)),
        carray(steps_at, (sizes[6], sizes[7])),
        carray(inputs_at, (sizes[8], sizes[9], sizes[7])),
        carray(longest_at, (lanes,)),
        carray(planned_at, (lanes,)),
        carray(ground_at, (4, lanes)),
        sizes[10],
        reals[0],
        carray(kept_at, (lanes, sizes[7] // sizes[10] + 1, 3 * d)),
    )
    block = BlockBuffers(
        carray(r_at, (sizes[11], BLOCK_WIDTH)),
        carray(a_at, (ROWS, BLOCK_WIDTH)),
        carray(n_at, (STATE_ROW_COUNT, BLOCK_WIDTH)),
    )
    w = sizes[12]
    if sizes[0] == 0:
        choose_step_divisions(
            program,
            work,
            block,
            w,
            carray(spans_at, (lanes,)),
            reals[1],
            carray(parts_at, (lanes,)),
        )
    elif sizes[0] == 1:
        step_block(program, work, block, w)
    else:
        step_in_lockstep(program, work, block, w)
