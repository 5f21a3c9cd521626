"""Functions that exist in compiled code only; `kernel_build` replaces these declarations."""

from __future__ import annotations

from typing import Any


def carray(pointer: Any, shape: Any) -> Any:
    """Return the array at a pointer.

    Args:
        pointer: pointer to the first number.
        shape: tuple of the lengths.
    """
    raise NotImplementedError


def to_real_pointer(address: Any) -> Any:
    """Return an address as a pointer to floating-point numbers."""
    raise NotImplementedError


def to_int_pointer(address: Any) -> Any:
    """Return an address as a pointer to 64-bit integers."""
    raise NotImplementedError


def to_short_pointer(address: Any) -> Any:
    """Return an address as a pointer to 32-bit integers."""
    raise NotImplementedError


def to_fixed_tuple(array: Any, size: int) -> Any:
    """Return the first numbers of an array as a tuple.

    Args:
        array: the array.
        size: number of entries, known when it is compiled.
    """
    raise NotImplementedError


def call_external(address: int, part: int, w: int) -> None:
    """Call the C function at an address with two integers.

    Args:
        address: address of the function.
        part: number of the part of a program.
        w: number of slots in use.
    """
    raise NotImplementedError
