"""Compiled functions of the batch engine: integration of a batch, and instructions on registers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from sims.engines.compiled import mujoco_callback
from sims.engines.compiled.compiled_functions import CompiledFunctions
from sims.engines.compiled.data_layout import (
    BLOCK_SHAPES,
    BatchArrays,
    Block,
    BlockBuffers,
    FloatArray,
    IntTable,
    ProgramArrays,
    check_block,
    uses_registers,
)
from sims.engines.compiled.element_stepping import step_elements
from sims.engines.compiled.interpreter import run_instructions
from sims.engines.compiled.machine_code_cache import load_stored

COMPILED = CompiledFunctions(
    __name__,
    "the batch engine",
    {
        step_elements: BLOCK_SHAPES,
        run_instructions: ("#i5", "#", "#", "rw", "#"),
    },
)


def integrate_elements(
    program: ProgramArrays,
    arrays: BatchArrays,
    buffers: BlockBuffers,
    w: int,
) -> None:
    """Integrate all elements of a batch.

    Args:
        program: program of the system and its effects.
        arrays: batch of elements.
        buffers: buffers of the slots, each of which holds one batch element at a time.
        w: number of slots in use.

    Raises:
        ValueError: an array is not as specified.
    """
    # `Block` has its integers last, and `steps_per_record` is the last field of `arrays`.
    fields: tuple[Any, ...] = *program, *arrays[:-1], *buffers, arrays.steps_per_record, w
    block = Block(*fields)
    check_block(block)
    COMPILED.bind(step_elements, *block)()


def make_instruction_runner(
    code: IntTable, first: int, last: int, r: FloatArray
) -> Callable[[], None]:
    """Return a function that runs instructions on the present values of the registers.

    Machine code does not check array bounds, so the instructions are checked once, here.

    Args:
        code: (n, 5) n instructions; see `ProgramArrays`.
        first: index of the first instruction.
        last: index after the last instruction.
        r: (registers, W) registers of W slots.

    Returns:
        The function without arguments.

    Raises:
        ValueError: an instruction uses a register that does not exist.
    """
    run = COMPILED.bind(run_instructions, code, first, last, r, r.shape[1])
    if not (0 <= first <= last <= len(code) and uses_registers(code, len(r))):
        raise ValueError("the instructions are not for these registers")
    return run


def load_callback(offsets: Mapping[str, int]) -> Callable[..., None]:
    """Return the compiled callback of MuJoCo's steps, compiled on first use.

    Args:
        offsets: offset of each field in MuJoCo's data, in words of eight bytes.

    Raises:
        InputError: the compiler or its machine code cannot be used.
    """
    # The compiler replaces the module's constants, such as QPOS, by these offsets.
    constants = {name.upper(): offset for name, offset in offsets.items()}
    return load_stored(
        mujoco_callback.__name__,
        "add_effect_forces",
        "the forces of effects",
        pointers=2,  # MuJoCo's model and data
        constants=constants,
    )
