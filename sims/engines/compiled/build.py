"""Compiles the functions that step lanes into one piece of machine code.

In a process of its own (`main`): numba is then asked in the same way whatever the user asks of it,
and what it takes of memory is given back.
"""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from graphlib import TopologicalSorter
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

from sims.engines.compiled import (
    advance,
    clock,
    dynamics,
    entry,
    evaluate,
    events,
    kinds,
    lockstep,
    native,
    pace,
)

MODULES: tuple[ModuleType, ...] = (
    evaluate,
    events,
    clock,
    dynamics,
    advance,
    lockstep,
    pace,
)
"""Where the functions are."""
_WRITTEN_OUT = frozenset(
    {
        *("present", "begin", "during", "pulled", "free", "attempt", "make", "go_on", "feel"),
        *("stays", "look", "look_at_friction", "bent", "is_open", "larger", "smaller", "keep"),
        *("dot", "length", "begin_on_a_line", "during_on_a_line"),
    }
)
"""Functions that are written out where they are used: a call hands over more than they do."""
_START = "import sys; sys.path[:] = {path!r}; from sims.engines.compiled.build import main; main()"


def built() -> bytes:
    """The machine's code, packed.

    Raises:
        native.UnusableError: it cannot be made; the message is the last that the compiler said.
    """
    environment = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_")}
    # All of it is optimised at once, at the end, and not each function with all that it calls.
    environment["NUMBA_OPT"] = "0"
    done = subprocess.run(
        [sys.executable, "-c", _START.format(path=sys.path)],
        env=environment,
        capture_output=True,
        stdin=subprocess.DEVNULL,
        check=False,
    )
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().splitlines()
        raise native.UnusableError(said[-1] if said else f"its compiler ended: {done.returncode}")
    return done.stdout


def main() -> None:
    """Write the code to where `built` reads it."""
    sys.stdout.buffer.write(native.made(*translated()).packed())


def translated() -> tuple[str, str]:
    """The machine's intermediate code and the name of the function in it."""
    import numba as typed

    # Half of it has types, and says of the other half that it has none.
    numba: Any = typed
    types = numba.types
    space: dict[str, Any] = {}
    for module in (*MODULES, entry):
        space.update({k: v for k, v in vars(module).items() if not k.startswith("__")})
    functions = {
        name: thing
        for module in MODULES
        for name, thing in vars(module).items()
        if isinstance(thing, FunctionType) and thing.__module__ == module.__name__
    }
    called = {name: functions.keys() & f.__code__.co_names for name, f in functions.items()}
    arguments = _arguments(numba)
    for name in TopologicalSorter(called).static_order():
        given = inspect.signature(functions[name]).parameters.values()
        made = numba.njit(
            forceinline=name in _WRITTEN_OUT,
            error_model="numpy",
            # Without counted references: an atomic count for each array looked at takes ten times
            # as long as the numbers. And without what Python would call it by.
            _nrt=False,
            no_cpython_wrapper=True,
            no_cfunc_wrapper=True,
        )(FunctionType(functions[name].__code__, space, name))
        # Once, and not anew for every constant that it is called with.
        made.compile(tuple(arguments[p.annotation] for p in given))
        made.disable_compile()
        space[name] = made
    space["carray"] = numba.carray
    whole = types.CPointer(types.int64)
    real = types.CPointer(types.float64)
    pointers = [whole, real, *[whole] * 7, *[real] * (entry.ARRAYS - 8)]
    bound = FunctionType(entry.integrate.__code__, space, "integrate")
    made = numba.cfunc(types.void(*pointers), error_model="numpy")(bound)
    return made.inspect_llvm(), made.native_name


def _arguments(numba: Any) -> dict[str, Any]:
    """The compiler's types, by how arguments are annotated."""
    whole, whole_table = (np.zeros((1,) * k, dtype=np.int64) for k in (1, 2))
    row, table, box = (np.zeros((1,) * k) for k in (1, 2, 3))
    alike = {
        "bool": True,
        "int": 1,
        "float": 1.0,
        "Row": row,
        "Numbers": table,
        "Table": whole_table,
        "Program": kinds.Program(whole_table, whole, whole, whole, whole),
        "Work": kinds.Work(
            order=whole, parameters=table, mass=row, x=table, v=table, steps=table, inputs=box,
            longest=row, planned=row, ground=table, every=1, patience=1.0, kept=box,
        ),
        "Block": kinds.Block(table, table, whole_table),
    }  # fmt: skip
    return {name: numba.typeof(value) for name, value in alike.items()}
