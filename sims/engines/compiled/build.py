"""Compiles the functions that step lanes into one piece of machine code."""

from __future__ import annotations

from types import FunctionType, ModuleType
from typing import Any

from sims.engines.compiled import advance, entry, evaluate, events, pace

_MODULES: tuple[ModuleType, ...] = (evaluate, events, advance, pace)
_WRITTEN_OUT = frozenset(
    {
        *("present", "begin", "during", "pulled", "free", "attempt", "make", "go_on", "feel"),
        *("stays", "look", "look_at_friction", "bent", "is_open", "larger", "smaller"),
        *("dot", "length", "begin_on_a_line", "during_on_a_line"),
    }
)
"""Functions that are written out where they are used: a call hands over more than they do."""


def compiled() -> tuple[str, str]:
    """The machine's intermediate code, optimised, and the name of the function in it."""
    import numba
    from numba import types

    # Without counted references: an atomic count for each array looked at takes ten times as long
    # as the numbers.
    options = {"error_model": "numpy", "_nrt": False}
    space: dict[str, Any] = {}
    for module in (*_MODULES, entry):
        space.update({k: v for k, v in vars(module).items() if not k.startswith("__")})
    for module in _MODULES:
        for name, thing in vars(module).items():
            if isinstance(thing, FunctionType) and thing.__module__ == module.__name__:
                bound = FunctionType(thing.__code__, space, name)
                space[name] = numba.njit(forceinline=name in _WRITTEN_OUT, **options)(bound)
    space["carray"] = numba.carray
    whole = types.CPointer(types.int64)
    real = types.CPointer(types.float64)
    kinds = [whole, real, *[whole] * 7, *[real] * (entry.ARRAYS - 8)]
    bound = FunctionType(entry.integrate.__code__, space, "integrate")
    made = numba.cfunc(types.void(*kinds), error_model="numpy")(bound)
    return made.inspect_llvm(), made.native_name
