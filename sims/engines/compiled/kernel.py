"""Compiled kernel of the batch engine: loaded from the user's cache, or compiled once.

numba translates the functions (`kernel_build`), which takes 20 s. The machine code is stored and
loaded with llvmlite alone (`machine_code`), in a few hundredths of a second and without numba.
"""

from __future__ import annotations

import ctypes
import hashlib
import sys
from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from sims.core.simulator import InputError
from sims.engines.compiled import kernel_entry, machine_code, mujoco_callback
from sims.engines.compiled.data_layout import (
    Array,
    BatchArrays,
    BlockBuffers,
    FloatArray,
    IntTable,
    ProgramArrays,
    check_array_layout,
    uses_registers,
)

_MAX_COMPILE_SECONDS = 20
"""Approximate compilation time of the batch engine in seconds, the longest one."""
_PYTHON_MODULES = ("batch_runner.py", "force_program.py", "kernel.py", "numpy_forces.py")
"""Source files of this package on which no compiled code depends."""
_lock = Lock()


class CompiledKernel:
    """Compiled functions of the batch engine.

    Args:
        function: loaded function of `sims.engines.compiled.kernel_entry`.
    """

    def __init__(self, function: Callable[..., None]) -> None:
        self._function = function

    def run(
        self,
        function: int,
        program: ProgramArrays,
        arrays: BatchArrays,
        buffers: BlockBuffers,
        w: int,
    ) -> None:
        """Run one of the functions of `kernel_entry` on all elements.

        Args:
            function: `STEP_ELEMENTS` or `FLY_ELEMENTS`.
            program: program of the system and its effects.
            arrays: batch of elements.
            buffers: buffers of the slots, each of which holds one batch element at a time.
            w: number of slots in use.
        """
        # The compiled code does not check array bounds.
        check_array_layout(program, arrays, buffers, w)
        header = function, w, arrays.steps_per_record, 0
        arguments = _pack_arguments(header, (*program, *arrays[:-1], *buffers))
        self._function(get_address(arguments))

    def make_instruction_runner(
        self, code: IntTable, first: int, last: int, r: FloatArray
    ) -> Callable[[], None]:
        """Return a function that runs instructions on the present values of the registers.

        Args:
            code: (n, 5) instructions; see `ProgramArrays`.
            first: index of the first instruction.
            last: index after the last instruction.
            r: (registers, W) registers.

        Returns:
            The function without arguments.

        Raises:
            ValueError: an instruction uses a register that does not exist.
        """
        has_int_code = code.flags.c_contiguous and code.dtype == np.int64 and code.shape[1:] == (5,)
        has_real_registers = r.flags.c_contiguous and r.dtype == np.float64 and r.ndim == 2
        if not (
            has_int_code
            and has_real_registers
            and 0 <= first <= last <= len(code)
            and uses_registers(code, len(r))
        ):
            raise ValueError("the instructions are not for these registers")
        header = kernel_entry.RUN_INSTRUCTIONS, r.shape[1], first, last
        arguments = _pack_arguments(header, (code, r))
        run: Any = partial(self._function, ctypes.c_void_p(get_address(arguments)))
        run.owners = arguments, code, r  # keeps the memory at the addresses
        return run  # type: ignore[no-any-return]


def _pack_arguments(header: tuple[int, ...], arrays: tuple[Array, ...]) -> IntTable:
    """Return the argument of `kernel_entry`: a header, then address and sizes of each array."""
    arguments = [*header]
    for array in arrays:
        arguments += (get_address(array), *array.shape, *(0,) * (3 - array.ndim))
    arguments += [0] * (kernel_entry.ARGUMENT_COUNT - len(arguments))
    return np.array(arguments, dtype=np.int64)


_NullArray = ctypes.c_char * 0


def get_address(array: Array) -> int:
    """Return the address of an array; NumPy's own way takes four times as long."""
    if array.flags.writeable:
        return ctypes.addressof(_NullArray.from_buffer(array.data))
    return int(array.ctypes.data)


def get_kernel() -> CompiledKernel:
    """Return the compiled kernel, compiled on first use.

    Raises:
        InputError: the compiler or its machine code cannot be used.
    """
    with _lock:
        return _load_kernel()


@cache
def _load_kernel() -> CompiledKernel:
    return CompiledKernel(
        _load_stored(kernel_entry.__name__, "kernel_entry", "the batch engine", 1, {})
    )


def load_callback(offsets: Mapping[str, int]) -> Callable[..., None]:
    """Return the compiled callback of MuJoCo's steps, compiled on first use.

    Args:
        offsets: offset of each field in MuJoCo's data, in words of eight bytes.

    Raises:
        InputError: the compiler or its machine code cannot be used.
    """
    constants = {name.upper(): offset for name, offset in offsets.items()}
    entry = "add_effect_forces"
    with _lock:
        return _load_stored(mujoco_callback.__name__, entry, "the forces of effects", 2, constants)


def load_compiled_module(module: str, entry: str, description: str) -> Callable[[int], None]:
    """Return a function of a module, compiled on first use with all functions that it calls.

    Args:
        module: name of the module.
        entry: name of the function. It receives the address of integers; its code may use the
            functions of `intrinsics`.
        description: what is compiled, for the message to the user.

    Raises:
        InputError: the compiler or its machine code cannot be used.
    """
    with _lock:
        return _load_stored(module, entry, description, 1, {})


def _load_stored(
    module: str, entry: str, description: str, pointers: int, constants: Mapping[str, int]
) -> Callable[..., None]:
    """Return a function whose machine code is in a file of the cache, compiled if necessary.

    Args:
        module: name of the function's module.
        entry: name of the function.
        description: what is compiled, for the message to the user.
        pointers: number of pointer arguments of the function.
        constants: values that replace constants of the module, by name.

    Raises:
        InputError: the compiler or its machine code cannot be used.
    """

    def compile_code() -> bytes:
        """Compile the module with numba, and tell the user why this takes time."""
        _print_line(
            f"compiling {description}, once after an install: up to {_MAX_COMPILE_SECONDS} s"
        )
        from sims.engines.compiled.kernel_build import build_module

        return build_module(module, entry, pointers, constants)

    try:
        data = _get_machine_code(make_cache_name(module, constants), compile_code)
        return machine_code.load_machine_code(machine_code.MachineCode.unpack(data), pointers)
    # A compiler that does not match this Python or its NumPy may raise any error.
    except Exception as error:
        text = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(
            f"{description} cannot be compiled: {text}; expected working versions of numba and"
            " llvmlite: install simgap again with the versions of requirements.lock"
        ) from error


def _get_machine_code(name: str, compile_code: Callable[[], bytes]) -> bytes:
    """Return the machine code: from the file `name` of the cache, or compiled.

    Compilation takes up to 20 s, so the code is stored in the user's cache. If the cache cannot
    be written, each process compiles again.
    """
    folder = machine_code.get_cache_folder()
    path = folder / name
    data = machine_code.read_cached(path)
    if data is not None:
        return data
    try:
        return machine_code.make_cached(path, compile_code, _report_wait)
    except OSError as error:
        _print_line(
            f"machine code cannot be stored in {folder} ({error.strerror or error}), so each"
            " process compiles it; set SIMGAP_COMPILED to a folder that can be written"
        )
        return compile_code()


def _report_wait() -> None:
    """Tell the user that another process is compiling, so that this one waits for its result."""
    _print_line(
        "another process compiles this code, once after an install:"
        f" {_MAX_COMPILE_SECONDS} s at most"
    )


def _print_line(text: str) -> None:
    """Write one line to the standard error output."""
    sys.stderr.write(f"simgap: {text}\n")
    sys.stderr.flush()


def make_cache_name(module: str, constants: Mapping[str, int]) -> str:
    """Return the name of a file of the cache.

    It has a hash of everything on which the code depends: sources, constants, compiler, processor.

    Args:
        module: name of the module.
        constants: values that replace constants of the module, by name.
    """
    digest = hashlib.sha256()
    for source in list_source_files(module):
        digest.update(source.read_bytes())
    digest.update(repr((machine_code.describe_processor(), sorted(constants.items()))).encode())
    return f"{module.rpartition('.')[2]}-{digest.hexdigest()[:24]}.bin"


def list_source_files(module: str) -> list[Path]:
    """Return the source files from which the code of a module is compiled, and those around it."""
    folder = Path(__file__).parent
    files = [path for path in folder.glob("*.py") if path.name not in _PYTHON_MODULES]
    files += [folder.parent / "ground_contact.py", Path(str(sys.modules[module].__file__))]
    return sorted(set(files))
