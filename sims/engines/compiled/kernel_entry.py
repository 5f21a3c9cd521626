"""Exported function of the kernel: it receives addresses and runs one of the kernel's functions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sims.engines.compiled.ballistic_motion import fly_elements
from sims.engines.compiled.data_layout import (
    NUMBER_ROW_COUNT,
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

    def to_real_pointer(address: int) -> Any:
        """Return an address as a pointer to floating-point numbers; an intrinsic function."""

    def to_int_pointer(address: int) -> Any:
        """Return an address as a pointer to integers; an intrinsic function."""


CHOOSE_STEP_DIVISIONS, STEP_BLOCK, STEP_IN_LOCKSTEP, FLY_ELEMENTS, RUN_INSTRUCTIONS = range(5)
"""Functions of the kernel, by the first argument of `kernel_entry`."""
SIZE_COUNT = 14
"""Number of integers before the addresses in the argument of `kernel_entry`."""
INT_ARRAY_COUNT = 7
"""Number of arrays of integers, which are the first."""
REAL_ARRAY_COUNT = 15
"""Number of arrays of floating-point numbers."""
ARGUMENT_COUNT = SIZE_COUNT + INT_ARRAY_COUNT + REAL_ARRAY_COUNT
"""Number of integers in the argument of `kernel_entry`."""


def kernel_entry(arguments_at: Any) -> None:
    """Run a function of the kernel.

    The argument is the address of `ARGUMENT_COUNT` integers: the function, sizes, and the addresses
    of all arrays, in the order in which `sims.engines.compiled.kernel` writes them.
    """
    sizes = carray(arguments_at, (ARGUMENT_COUNT,))
    ints = sizes[SIZE_COUNT:]
    reals = sizes[SIZE_COUNT + INT_ARRAY_COUNT :]
    code = carray(to_int_pointer(ints[0]), (sizes[4], 5))
    width = sizes[13]
    w = sizes[12]
    r = carray(to_real_pointer(reals[0]), (sizes[11], width))
    if sizes[0] == RUN_INSTRUCTIONS:
        run_instructions(code, sizes[1], sizes[2], r, w)
        return
    element_count = sizes[1]
    selected_count = sizes[2]
    d = sizes[3]
    steps = sizes[7]
    steps_per_sample = sizes[10]
    limits = carray(to_real_pointer(reals[14]), (2,))
    program = ProgramArrays(
        code,
        carray(to_int_pointer(ints[1]), (4,)),
        carray(to_int_pointer(ints[2]), (11,)),
        carray(to_int_pointer(ints[3]), (d,)),
        carray(to_int_pointer(ints[4]), (5,)),
    )
    arrays = BatchArrays(
        carray(to_int_pointer(ints[5]), (selected_count,)),
        carray(to_real_pointer(reals[2]), (selected_count, sizes[5])),
        carray(to_real_pointer(reals[3]), (element_count,)),
        carray(to_real_pointer(reals[4]), (element_count, d)),
        carray(to_real_pointer(reals[5]), (element_count, d)),
        carray(to_real_pointer(reals[6]), (sizes[6], steps)),
        carray(to_real_pointer(reals[7]), (sizes[8], sizes[9], steps)),
        carray(to_real_pointer(reals[8]), (element_count,)),
        carray(to_real_pointer(reals[9]), (element_count,)),
        carray(to_real_pointer(reals[10]), (4, element_count)),
        steps_per_sample,
        limits[0],
        carray(to_real_pointer(reals[11]), (element_count, steps // steps_per_sample + 1, 3 * d)),
    )
    block = BlockBuffers(
        r,
        carray(to_real_pointer(reals[1]), (NUMBER_ROW_COUNT, width)),
        carray(to_int_pointer(ints[6]), (STATE_ROW_COUNT, width)),
    )
    if sizes[0] == CHOOSE_STEP_DIVISIONS:
        spans = carray(to_real_pointer(reals[12]), (element_count,))
        divisions = carray(to_real_pointer(reals[13]), (element_count,))
        choose_step_divisions(program, arrays, block, w, spans, limits[1], divisions)
    elif sizes[0] == STEP_BLOCK:
        step_block(program, arrays, block, w)
    elif sizes[0] == STEP_IN_LOCKSTEP:
        step_in_lockstep(program, arrays, block, w)
    else:
        fly_elements(program, arrays, block)
