"""Compile the functions that step elements into one piece of machine code.

The compilation runs in a separate process (`main`). There, numba ignores the user's settings, and
its memory is released afterwards.
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
    ballistic_motion,
    data_layout,
    dynamics,
    element_clock,
    element_stepping,
    events,
    interpreter,
    kernel_entry,
    llvm_code,
    lockstep_stepping,
    step_size,
)

KERNEL_MODULES: tuple[ModuleType, ...] = (
    interpreter,
    events,
    element_clock,
    dynamics,
    element_stepping,
    lockstep_stepping,
    ballistic_motion,
    step_size,
)
"""Modules that contain the compiled functions."""
_WRITTEN_OUT = frozenset(
    {
        *("evaluate_forces", "begin_step", "compute_acceleration", "compute_pulling_force"),
        *("compute_frictionless_acceleration", "try_step", "accept_steps", "next_step"),
        *("set_inputs", "record_and_check_remaining", "detect_possible_events"),
        *("detect_friction_events", "is_too_nonlinear", "has_no_pending_event", "nan_maximum"),
        *("nan_minimum", "record_state", "dot", "compute_norm", "begin_step_1d"),
        "compute_acceleration_1d",
    }
)
"""Functions that are inlined, because a call costs more than their body."""
_START = (
    "import sys; sys.path[:] = {path!r}; "
    "from sims.engines.compiled.kernel_build import main; main()"
)


def build_kernel() -> bytes:
    """Return the packed machine code of the kernel.

    Raises:
        llvm_code.CodeNotLoadableError: the compilation failed; the message is the last line of
            the compiler's output.
    """
    environment = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_")}
    # Everything is optimised once at the end, instead of each function with all its callees.
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
        raise llvm_code.CodeNotLoadableError(
            said[-1] if said else f"its compiler ended: {done.returncode}"
        )
    return done.stdout


def main() -> None:
    """Write the code to the standard output, where `build_kernel` reads it."""
    sys.stdout.buffer.write(llvm_code.compile_llvm(*emit_llvm()).pack())


def emit_llvm() -> tuple[str, str]:
    """Return the LLVM intermediate code of the kernel and the name of its function."""
    import numba as typed

    # numba is only partly typed, and its untyped functions would fail the type check.
    numba: Any = typed
    types = numba.types
    space: dict[str, Any] = {}
    for module in (*KERNEL_MODULES, kernel_entry):
        space.update({k: v for k, v in vars(module).items() if not k.startswith("__")})
    space.update(_make_intrinsics(numba))
    functions = {
        name: thing
        for module in KERNEL_MODULES
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
            # Without reference counting: an atomic counter for each used array takes ten times as
            # long as the computation. Wrappers for calls from Python are not needed.
            _nrt=False,
            no_cpython_wrapper=True,
            no_cfunc_wrapper=True,
        )(FunctionType(functions[name].__code__, space, name))
        # Compiled once, instead of again for each constant argument.
        made.compile(tuple(arguments[p.annotation] for p in given))
        made.disable_compile()
        space[name] = made
    space["carray"] = numba.carray
    bound = FunctionType(kernel_entry.kernel_entry.__code__, space, "integrate")
    made = numba.cfunc(types.void(types.CPointer(types.int64)), error_model="numpy")(bound)
    return made.inspect_llvm(), made.native_name


def _make_intrinsics(numba: Any) -> dict[str, Any]:
    """Return functions that numba itself does not have: addresses as pointers and functions."""
    from llvmlite import ir

    types = numba.types
    word = ir.IntType(64)

    def make_pointer_function(kind: Any, target: Any) -> Any:
        def to_pointer(context: Any, address: Any) -> Any:  # noqa: ARG001
            def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
                return builder.inttoptr(values[0], target.as_pointer())

            return types.CPointer(kind)(types.int64), generate

        return numba.extending.intrinsic(to_pointer)

    def call_external(context: Any, address: Any, part: Any, w: Any) -> Any:  # noqa: ARG001
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
            function = ir.FunctionType(ir.VoidType(), [word, word])
            builder.call(builder.inttoptr(values[0], function.as_pointer()), values[1:])
            return context.get_dummy_value()

        return types.void(types.int64, types.int64, types.int64), generate

    return {
        "call_external": numba.extending.intrinsic(call_external),
        "to_int_pointer": make_pointer_function(types.int64, word),
        "to_real_pointer": make_pointer_function(types.float64, ir.DoubleType()),
    }


def _arguments(numba: Any) -> dict[str, Any]:
    """Return the compiler's types by the names of the annotations."""
    whole, whole_table = (np.zeros((1,) * k, dtype=np.int64) for k in (1, 2))
    row, table, box = (np.zeros((1,) * k) for k in (1, 2, 3))
    alike = {
        "bool": True,
        "int": 1,
        "float": 1.0,
        "Row": row,
        "FloatArray": table,
        "IntTable": whole_table,
        "ProgramArrays": data_layout.ProgramArrays(whole_table, whole, whole, whole, whole),
        "BatchArrays": data_layout.BatchArrays(
            order=whole, parameters=table, mass=row, x=table, v=table, steps=table, inputs=box,
            longest=row, planned=row, ground=table, every=1, patience=1.0, kept=box,
        ),
        "BlockBuffers": data_layout.BlockBuffers(table, table, whole_table),
    }  # fmt: skip
    return {name: numba.typeof(value) for name, value in alike.items()}
