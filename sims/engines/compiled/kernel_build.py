"""Compile the functions that step elements into one piece of machine code.

The compilation runs in a separate process (`main`). There, numba ignores the user's settings, and
its memory is released afterwards.
"""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from collections.abc import Collection, Mapping, Sequence
from graphlib import TopologicalSorter
from importlib import import_module
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

from sims.engines.compiled import (
    accelerations,
    ballistic_motion,
    data_layout,
    element_clock,
    element_stepping,
    events,
    interpreter,
    kernel_entry,
    lockstep_stepping,
    machine_code,
    mujoco_callback,
    step_size,
)

KERNEL_MODULES: tuple[ModuleType, ...] = (
    interpreter,
    events,
    element_clock,
    accelerations,
    element_stepping,
    lockstep_stepping,
    ballistic_motion,
    step_size,
)
"""Modules that contain the compiled functions."""
_INLINED_FUNCTIONS = frozenset(
    {
        *(
            "evaluate_forces",
            "begin_step",
            "compute_acceleration",
            "compute_force_without_friction",
        ),
        *("compute_frictionless_acceleration", "try_step", "accept_steps", "next_step"),
        *("set_inputs", "record_and_check_remaining", "detect_possible_events"),
        *("detect_friction_events", "is_too_nonlinear", "has_no_pending_event", "nan_maximum"),
        *("nan_minimum", "record_state", "dot", "compute_norm", "begin_step_1d"),
        *("compute_acceleration_1d", "compute_further_coordinates"),
    }
)
"""Functions that are inlined, because a call costs more than their body."""
_START = (
    "import sys; sys.path[:] = {path!r}; "
    "from sims.engines.compiled.kernel_build import main; main(*{arguments!r})"
)


def build_kernel(offsets: Mapping[str, int] | None = None) -> bytes:
    """Return the packed machine code of the kernel, or of MuJoCo's callback.

    Args:
        offsets: for the callback, the offset of each field in MuJoCo's data, in words of eight
            bytes; None for the kernel.

    Raises:
        llvm_code.CodeNotLoadableError: the compilation failed; the message is the last line of
            the compiler's output.
    """
    return _run_compiler(offsets)


def build_module(module: str, entry: str) -> bytes:
    """Return the packed machine code of a function of a module and all functions that it calls.

    Args:
        module: name of the module.
        entry: name of the function, which receives a pointer to integers.

    Raises:
        llvm_code.CodeNotLoadableError: as for `build_kernel`.
    """
    return _run_compiler(None, module, entry)


def _run_compiler(*arguments: Any) -> bytes:
    """Run `main` with these arguments in another process, and return its output."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_")}
    # Everything is optimised once at the end, instead of each function with all its callees.
    environment["NUMBA_OPT"] = "0"
    process = subprocess.run(
        [sys.executable, "-c", _START.format(path=sys.path, arguments=arguments)],
        env=environment,
        capture_output=True,
        stdin=subprocess.DEVNULL,
        check=False,
    )
    if process.returncode:
        error_lines = process.stderr.decode(errors="replace").strip().splitlines()
        raise machine_code.CodeNotLoadableError(
            error_lines[-1] if error_lines else f"its compiler failed: {process.returncode}"
        )
    return process.stdout


def main(offsets: Mapping[str, int] | None = None, module: str = "", entry: str = "") -> None:
    """Write the code to the standard output, where `build_kernel` or `build_module` reads it."""
    if module:
        emitted = emit_module(module, entry)
    else:
        emitted = emit_llvm() if offsets is None else emit_callback(offsets)
    sys.stdout.buffer.write(machine_code.compile_llvm(*emitted).pack())


def emit_llvm() -> tuple[str, str]:
    """Return the LLVM intermediate code of the kernel and the name of its function."""
    import numba as typed

    # numba is only partly typed, and its untyped functions would fail the type check.
    numba: Any = typed
    space = _compile_functions(numba, KERNEL_MODULES)
    space.update(_list_module_names(kernel_entry, excluded=space))
    return _emit_llvm_code(numba, kernel_entry.kernel_entry, space, 1)


def emit_callback(offsets: Mapping[str, int]) -> tuple[str, str]:
    """Return the LLVM intermediate code of MuJoCo's callback and the name of its function.

    Args:
        offsets: offset of each field in MuJoCo's data, in words of eight bytes.
    """
    import numba as typed

    numba: Any = typed
    space = _compile_functions(numba, (interpreter,))
    space.update(_list_module_names(mujoco_callback, excluded=space))
    space |= {name.upper(): offset for name, offset in offsets.items()}
    limits = mujoco_callback.set_friction_limits
    space["set_friction_limits"] = numba.njit(error_model="numpy")(
        FunctionType(limits.__code__, space, "set_friction_limits")
    )
    return _emit_llvm_code(numba, mujoco_callback.add_effect_forces, space, 2)


def emit_module(module: str, entry: str) -> tuple[str, str]:
    """Return the LLVM intermediate code of a function of a module, and the name of the function.

    Args:
        module: name of the module.
        entry: name of the function, which receives a pointer to integers.
    """
    import numba as typed

    numba: Any = typed
    names = _list_module_names(import_module(module))
    space = {**names, **_make_intrinsics(numba), "carray": numba.carray}
    functions = {
        name: value
        for name, value in names.items()
        if isinstance(value, FunctionType) and value.__module__ == module
    }
    # A function is compiled for the types of its arguments when its caller is compiled.
    for name, function in functions.items():
        space[name] = numba.njit(
            error_model="numpy", _nrt=False, no_cpython_wrapper=True, no_cfunc_wrapper=True
        )(FunctionType(function.__code__, space, name))
    return _emit_llvm_code(numba, functions[entry], space, 1)


def _list_module_names(module: ModuleType, excluded: Collection[str] = ()) -> dict[str, Any]:
    """Return the names of a module, without those to keep."""
    return {k: v for k, v in vars(module).items() if not k.startswith("__") and k not in excluded}


def _compile_functions(numba: Any, modules: Sequence[ModuleType]) -> dict[str, Any]:
    """Compile all functions of some modules, callees first.

    A function must be compiled after the functions that it calls, so they are sorted
    topologically.

    Returns:
        The compiled functions and all other names of the modules.
    """
    space: dict[str, Any] = {}
    for module in modules:
        space.update(_list_module_names(module))
    space.update(_make_intrinsics(numba))
    functions = {
        name: value
        for module in modules
        for name, value in vars(module).items()
        if isinstance(value, FunctionType) and value.__module__ == module.__name__
    }
    callees = {name: functions.keys() & f.__code__.co_names for name, f in functions.items()}
    arguments = _get_argument_types(numba)
    for name in TopologicalSorter(callees).static_order():
        parameters = inspect.signature(functions[name]).parameters.values()
        compiled = numba.njit(
            forceinline=name in _INLINED_FUNCTIONS,
            error_model="numpy",
            # Without reference counting: an atomic counter for each used array takes ten times as
            # long as the computation. Wrappers for calls from Python are not needed.
            _nrt=False,
            no_cpython_wrapper=True,
            no_cfunc_wrapper=True,
        )(FunctionType(functions[name].__code__, space, name))
        # Compiled once, instead of again for each constant argument.
        compiled.compile(tuple(arguments[p.annotation] for p in parameters))
        compiled.disable_compile()
        space[name] = compiled
    space["carray"] = numba.carray
    return space


def _emit_llvm_code(
    numba: Any, function: Any, space: dict[str, Any], pointers: int
) -> tuple[str, str]:
    """Return the LLVM intermediate code of a C function without result, and its name."""
    types = numba.types
    bound = FunctionType(function.__code__, space, "integrate")
    arguments = [types.CPointer(types.int64)] * pointers
    compiled = numba.cfunc(types.void(*arguments), error_model="numpy")(bound)
    return compiled.inspect_llvm(), compiled.native_name


def _make_intrinsics(numba: Any) -> dict[str, Any]:
    """Define functions that numba lacks: pointers from addresses, and a call of an address.

    An intrinsic is a function whose LLVM code is generated here. The compiled kernel uses them
    to read arrays of other libraries, and to call Python through a C callback.
    """
    from llvmlite import ir

    types = numba.types
    word = ir.IntType(64)

    def make_pointer_function(kind: Any, target: Any) -> Any:
        """Make a numba function that converts an integer address to a pointer.

        `kind` is the type of the numbers for numba, and `target` the same type for LLVM.
        """

        def to_pointer(context: Any, address: Any) -> Any:  # noqa: ARG001
            """Return the types of the conversion for numba, and the generator of its LLVM code."""

            def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
                return builder.inttoptr(values[0], target.as_pointer())

            return types.CPointer(kind)(types.int64), generate

        return numba.extending.intrinsic(to_pointer)

    def call_external(context: Any, address: Any, part: Any, w: Any) -> Any:  # noqa: ARG001
        """Call the function at an address with two integers, from compiled code (numba intrinsic).

        It returns the types for numba, and a function that generates the LLVM code.
        """

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
            function = ir.FunctionType(ir.VoidType(), [word, word])
            builder.call(builder.inttoptr(values[0], function.as_pointer()), values[1:])
            return context.get_dummy_value()

        return types.void(types.int64, types.int64, types.int64), generate

    return {
        "call_external": numba.extending.intrinsic(call_external),
        "to_int_pointer": make_pointer_function(types.int64, word),
        "to_short_pointer": make_pointer_function(types.int32, ir.IntType(32)),
        "to_real_pointer": make_pointer_function(types.float64, ir.DoubleType()),
    }


def _get_argument_types(numba: Any) -> dict[str, Any]:
    """Return numba's types by the names of annotations, derived from example values."""
    ints, int_table = (np.zeros((1,) * k, dtype=np.int64) for k in (1, 2))
    row, table, box = (np.zeros((1,) * k) for k in (1, 2, 3))
    examples = {
        "bool": True,
        "int": 1,
        "float": 1.0,
        "Row": row,
        "FloatArray": table,
        "IntTable": int_table,
        "ProgramArrays": data_layout.ProgramArrays(int_table, ints, ints, ints, ints),
        "BatchArrays": data_layout.BatchArrays(
            order=ints, parameters=table, mass=row, x=table, v=table, steps=table, inputs=box,
            max_steps=row, planned_counts=row, ground=table, steps_per_record=1, patience=1.0,
            records=box,
        ),
        "BlockBuffers": data_layout.BlockBuffers(table, table, int_table),
    }  # fmt: skip
    return {name: numba.typeof(value) for name, value in examples.items()}
