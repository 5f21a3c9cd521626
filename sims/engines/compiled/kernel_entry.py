"""Exported function of the kernel: it receives addresses and runs one of the kernel's functions."""

from __future__ import annotations

from typing import Any

from sims.engines.compiled.ballistic_motion import fly_elements
from sims.engines.compiled.data_layout import Block
from sims.engines.compiled.element_stepping import step_elements
from sims.engines.compiled.interpreter import run_instructions
from sims.engines.compiled.intrinsics import carray, to_int_pointer, to_real_pointer

STEP_ELEMENTS, FLY_ELEMENTS, RUN_INSTRUCTIONS = range(3)
"""Functions of the kernel, by the first argument of `kernel_entry`."""
HEADER_WORDS = 4
"""Number of integers before the arrays.

They are the function, the number of slots in use, and the steps between recorded states; or the
first instruction and the index after the last one.
"""
ARRAY_WORDS = 4
"""Number of integers for each array: its address, and its sizes."""
ARRAY_COUNT = 22
"""Number of arrays of a `Block`."""
ARGUMENT_COUNT = HEADER_WORDS + ARRAY_WORDS * ARRAY_COUNT
"""Number of integers in the argument of `kernel_entry`."""


def get_ints(words: Any, k: int) -> Any:
    """Return array k of the argument, integers with one dimension.

    Args:
        words: the argument as 64-bit words: header, then address and lengths of each array.
        k: number of the array.
    """
    at = HEADER_WORDS + ARRAY_WORDS * k
    return carray(to_int_pointer(words[at]), (words[at + 1],))


def get_int_table(words: Any, k: int) -> Any:
    """Return array k of the argument, integers with two dimensions.

    Args:
        words: the argument as 64-bit words, see `get_ints`.
        k: number of the array.
    """
    at = HEADER_WORDS + ARRAY_WORDS * k
    return carray(to_int_pointer(words[at]), (words[at + 1], words[at + 2]))


def get_numbers(words: Any, k: int) -> Any:
    """Return array k of the argument, floating-point numbers with one dimension.

    Args:
        words: the argument as 64-bit words, see `get_ints`.
        k: number of the array.
    """
    at = HEADER_WORDS + ARRAY_WORDS * k
    return carray(to_real_pointer(words[at]), (words[at + 1],))


def get_table(words: Any, k: int) -> Any:
    """Return array k of the argument, floating-point numbers with two dimensions.

    Args:
        words: the argument as 64-bit words, see `get_ints`.
        k: number of the array.
    """
    at = HEADER_WORDS + ARRAY_WORDS * k
    return carray(to_real_pointer(words[at]), (words[at + 1], words[at + 2]))


def get_box(words: Any, k: int) -> Any:
    """Return array k of the argument, floating-point numbers with three dimensions.

    Args:
        words: the argument as 64-bit words, see `get_ints`.
        k: number of the array.
    """
    at = HEADER_WORDS + ARRAY_WORDS * k
    return carray(to_real_pointer(words[at]), (words[at + 1], words[at + 2], words[at + 3]))


def kernel_entry(arguments_at: Any) -> None:
    """Run a function of the kernel.

    The argument is the address of `ARGUMENT_COUNT` integers, in the order in which
    `sims.engines.compiled.kernel` writes them.
    """
    words = carray(arguments_at, (ARGUMENT_COUNT,))
    if words[0] == RUN_INSTRUCTIONS:
        run_instructions(get_int_table(words, 0), words[2], words[3], get_table(words, 1), words[1])
        return
    block = Block(
        get_int_table(words, 0),
        get_ints(words, 1),
        get_ints(words, 2),
        get_ints(words, 3),
        get_ints(words, 4),
        get_ints(words, 5),
        get_ints(words, 6),
        get_table(words, 7),
        get_numbers(words, 8),
        get_table(words, 9),
        get_table(words, 10),
        get_table(words, 11),
        get_box(words, 12),
        get_numbers(words, 13),
        get_numbers(words, 14),
        get_numbers(words, 15),
        get_table(words, 16),
        get_numbers(words, 17),
        get_box(words, 18),
        get_table(words, 19),
        get_table(words, 20),
        get_int_table(words, 21),
        words[2],
        words[1],
    )
    if words[0] == STEP_ELEMENTS:
        step_elements(block)
    else:
        fly_elements(block)
