"""Recursions of effects with memory over the steps of a run, compiled once.

A step in Python takes some microseconds, and a recording has up to a hundred thousand steps.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from sims.core.simulator import Array
from sims.engines.compiled.interpreter import nan_maximum, nan_minimum
from sims.engines.compiled.intrinsics import carray, to_real_pointer
from sims.engines.compiled.kernel import get_address, load_compiled_module

LINEAR, CLAMP, RATE_LIMIT = range(3)
"""Recursions: y' = a y + b; y' = min(max(y, a), b); y' = y + min(max(a - y, -b), b)."""


def run_recursion(kind: int, a: Array, b: Array, start: Array) -> Array:
    """Run a recursion over S steps of L batch elements.

    Args:
        kind: `LINEAR`, `CLAMP` or `RATE_LIMIT`.
        a: (L, S) first operand of each step.
        b: (L, S) second operand of each step.
        start: (L, 1) value before the first step.

    Returns:
        Values (L, S) after each step.
    """
    first, second = (
        np.ascontiguousarray(values, dtype=np.float64) for values in np.broadcast_arrays(a, b)
    )
    begin = np.ascontiguousarray(start, dtype=np.float64).reshape(len(first), 1)
    result = np.empty(first.shape)
    compiled = _load_compiled_recursion()
    if compiled is None:
        step_elements(kind, first, second, begin, result)
    else:
        addresses = [get_address(values) for values in (first, second, begin, result)]
        numbers = np.array([kind, *result.shape, *addresses], dtype=np.int64)
        compiled(get_address(numbers))
    return result


@cache
def _load_compiled_recursion() -> Callable[[int], None] | None:
    """Return the compiled `recursion_entry`; None if numba does not support this Python version."""
    if importlib.util.find_spec("llvmlite") is None:
        return None
    return load_compiled_module(__name__, "recursion_entry", "the effects with memory")


def recursion_entry(arguments_at: Any) -> None:
    """Run a recursion (compiled code only).

    The argument is the address of seven integers: the recursion, L, S, and the addresses of the
    other arguments of `step_elements`.
    """
    numbers = carray(arguments_at, (7,))
    size, steps = numbers[1], numbers[2]
    step_elements(
        numbers[0],
        carray(to_real_pointer(numbers[3]), (size, steps)),
        carray(to_real_pointer(numbers[4]), (size, steps)),
        carray(to_real_pointer(numbers[5]), (size, 1)),
        carray(to_real_pointer(numbers[6]), (size, steps)),
    )


def step_elements(kind: int, a: Any, b: Any, start: Any, result: Any) -> None:
    """Write the values after each step into `result`; arguments as in `run_recursion`."""
    for i in range(result.shape[0]):
        y = start[i, 0]
        for k in range(result.shape[1]):
            if kind == LINEAR:
                y = a[i, k] * y + b[i, k]
            elif kind == CLAMP:
                y = nan_minimum(nan_maximum(y, a[i, k]), b[i, k])
            else:
                y = y + nan_maximum(nan_minimum(a[i, k] - y, b[i, k]), -b[i, k])
            result[i, k] = y
