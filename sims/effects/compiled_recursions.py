"""Recursions of effects with memory over the steps of a run, compiled once.

A step in Python takes some microseconds, and a recording has up to a hundred thousand steps.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sims.core.simulator import Array
from sims.engines.compiled.array_functions import ArrayFunctions
from sims.engines.compiled.interpreter import nan_maximum, nan_minimum

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
    (result,) = COMPILED.call(step_elements, kind, first, second, begin)
    return result


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


COMPILED = ArrayFunctions(
    __name__,
    "the effects with memory",
    {step_elements: ("#", "ls", "ls", "l1", "ls")},
    can_run_uncompiled=True,
)
