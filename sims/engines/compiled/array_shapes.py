"""Shapes of the arrays that compiled functions receive, as texts.

A shape has one letter per dimension: equal letters are equal sizes in a call, and a digit is a
fixed size. Numbers are of double precision; the prefix `INTEGERS` declares 64-bit integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
INTEGERS = "#"
"""Prefix of the shapes of integer arrays, and the shape of an integer argument."""


def measure_arrays(shapes: Sequence[str], arguments: Sequence[Any]) -> dict[str, int]:
    """Return the sizes of arrays by the letters of their shapes.

    Args:
        shapes: shapes of the arrays.
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
