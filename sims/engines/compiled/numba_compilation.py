"""Compile a function, with all functions that it calls, into one piece of machine code.

The compilation runs in a separate process (`main`). There, numba ignores the user's settings, and
its memory is released afterwards.
"""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from collections.abc import Mapping
from importlib import import_module
from types import FunctionType
from typing import Any

from sims.engines.compiled import intrinsics, machine_code
from sims.engines.compiled.data_layout import BLOCK_SHAPES, Block, make_example

_INLINED_FUNCTIONS = frozenset(
    {
        *("evaluate_forces", "begin_step", "compute_acceleration"),
        *("compute_force_without_friction", "compute_frictionless_acceleration", "try_step"),
        *("next_step", "set_inputs", "record_and_check_remaining"),
        "shorten_if_nonlinear",
        *("has_no_pending_event", "nan_maximum", "nan_minimum", "record_state", "dot"),
        *("compute_norm", "begin_step_1d", "compute_acceleration_1d"),
        *("compute_further_coordinates", "run_part"),
    }
)
"""Functions that are inlined, because a call costs more than their body."""
_START = (
    "import sys; sys.path[:] = {path!r}; "
    "from sims.engines.compiled.numba_compilation import main; main(*{arguments!r})"
)


def build_module(module: str, entry: str, pointers: int, constants: Mapping[str, int]) -> bytes:
    """Compile a function of a module, with all functions that it calls, in a separate process.

    There numba ignores the user's settings, and its memory is released afterwards. The process
    runs `main`, and writes the machine code to its standard output.

    Args:
        module: name of the module.
        entry: name of the function, which receives pointers to integers, or of `CompiledFunctions`.
        pointers: number of these pointers.
        constants: values that replace constants of the module, by name.

    Returns:
        The machine code as bytes, see `MachineCode.pack`.

    Raises:
        machine_code.CodeNotLoadableError: the compilation failed; the message is the last line of
            the compiler's output.
    """
    environment = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_")}
    # Everything is optimised once at the end, instead of each function with all its callees.
    environment["NUMBA_OPT"] = "0"
    arguments = module, entry, pointers, dict(constants)
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


def main(module: str, entry: str, pointers: int, constants: Mapping[str, int]) -> None:
    """Compile a function, and write its machine code to the standard output.

    `build_module` starts this in a separate process, and reads the output. numba translates the
    function and those that it calls to LLVM code, which becomes machine code in one piece.

    Args:
        module: name of the module.
        entry: name of the function, or of a `CompiledFunctions` object, which generates it.
        pointers: number of the function's arguments, which are pointers to integers.
        constants: numbers that replace global constants of the module, by name.
    """
    import numba as typed

    # numba is only partly typed, and its untyped functions would fail the type check.
    numba: Any = typed
    entry_function = getattr(import_module(module), entry)
    if not isinstance(entry_function, FunctionType):
        entry_function = entry_function.make_entry()
    space = _compile_functions(numba, entry_function, constants)
    types = numba.types
    arguments = [types.CPointer(types.int64)] * pointers
    # The function's code with the compiled functions in place of its global names.
    bound = FunctionType(entry_function.__code__, space, "integrate")
    compiled = numba.cfunc(types.void(*arguments), error_model="numpy")(bound)
    code = machine_code.compile_llvm(compiled.inspect_llvm(), compiled.native_name)
    sys.stdout.buffer.write(code.pack())


def list_called_functions(function: FunctionType) -> list[FunctionType]:
    """Return the functions that a function calls, and those that they call, callees first.

    These are the global functions whose names its byte code contains. Intrinsics are left out,
    because they have no Python code to compile.
    """
    functions: dict[FunctionType, None] = {}
    for name in function.__code__.co_names:
        callee = function.__globals__.get(name)
        if isinstance(callee, FunctionType) and callee.__module__ != intrinsics.__name__:
            functions |= dict.fromkeys([*list_called_functions(callee), callee])
    return list(functions)


def _compile_functions(
    numba: Any, entry: FunctionType, constants: Mapping[str, int]
) -> dict[str, Any]:
    """Compile all functions that a function calls, and return the global names for its own code.

    The callees are compiled first, in one common name space: there each name stands for the
    compiled function, so that callers use it instead of the Python function.

    Args:
        numba: the module.
        entry: function whose callees are compiled.
        constants: numbers that replace global constants, by name.
    """
    functions = list_called_functions(entry)
    space: dict[str, Any] = {}
    for function in (*functions, entry):
        space.update(function.__globals__)
    space.update(constants)
    space.update(intrinsics.make_intrinsics(numba))
    types = _get_argument_types(numba)
    for function in functions:
        name = function.__name__
        parameters = inspect.signature(function).parameters.values()
        compiled = numba.njit(
            forceinline=name in _INLINED_FUNCTIONS,
            # Without reference counting a function cannot make arrays, so its caller makes them.
            inline="always" if "carray" in function.__code__.co_names else "never",
            error_model="numpy",
            # Without reference counting: an atomic counter for each used array takes ten times as
            # long as the computation. Wrappers for calls from Python are not needed.
            _nrt=False,
            no_cpython_wrapper=True,
            no_cfunc_wrapper=True,
        )(FunctionType(function.__code__, space, name))
        if all(p.annotation in types for p in parameters):
            # Compiled once, instead of again for each constant argument.
            compiled.compile(tuple(types[p.annotation] for p in parameters))
            compiled.disable_compile()
        space[name] = compiled
    return space


def _get_argument_types(numba: Any) -> dict[str, Any]:
    """Return numba's types by the names of annotations, derived from example values.

    Args:
        numba: The module numba, which is imported on first use.
    """
    examples = {
        "bool": True,
        "int": 1,
        "float": 1.0,
        "FloatArray": make_example("ij"),
        "IntTable": make_example("#ij"),
        "Block": Block(*map(make_example, BLOCK_SHAPES)),
    }
    return {name: numba.typeof(value) for name, value in examples.items()}
