"""Compiled kernel of the batch engine: loaded from the user's cache, or compiled once.

numba translates the functions (`kernel_build`), which takes 20 s. The machine code is stored
and loaded with llvmlite alone (`machine_code`), in a few hundredths of a second and
without numba.
"""

from __future__ import annotations

import ctypes
import hashlib
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from sims.core.simulator import InputError
from sims.engines.compiled import kernel_entry, machine_code
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

KERNEL_SOURCE_MODULES = (
    *("accelerations", "ballistic_motion", "data_layout", "element_clock", "element_stepping"),
    "events",
    *("interpreter", "kernel_build", "kernel_entry", "machine_code", "traced_array"),
    *("lockstep_stepping", "mujoco_callback", "step_size"),
)
"""Modules of this package on which the compiled code depends."""
_COMPILER_MODULES = ("kernel_build", "machine_code")
"""Modules of this package that compile functions of other packages."""
_COMPILE_SECONDS = 20
"""Approximate compilation time in seconds."""
_lock = Lock()


class CompiledKernel:
    """Compiled functions of the batch engine.

    Args:
        function: loaded function of `sims.engines.compiled.kernel_entry`.
    """

    def __init__(self, function: Callable[..., None]) -> None:
        self._function = function

    def choose_step_divisions(
        self, program: ProgramArrays, arrays: BatchArrays, block: BlockBuffers, w: int,
        spans: FloatArray, max_phase: float, divisions: FloatArray,
    ) -> None:  # fmt: skip
        """Choose the number of parts of each step; see `sims.engines.compiled.step_size`.

        Args:
            program: program of the system and its effects.
            arrays: batch of elements.
            block: buffers of the slots.
            w: number of slots in use.
            spans: (L,) step sizes in seconds.
            max_phase: maximum phase of an oscillation per step in radians.
            divisions: (L,) numbers of parts, updated in place.
        """
        function = kernel_entry.CHOOSE_STEP_DIVISIONS
        self._call_function(function, program, arrays, block, w, spans, max_phase, divisions)

    def integrate(
        self,
        function: int,
        program: ProgramArrays,
        arrays: BatchArrays,
        block: BlockBuffers,
        w: int,
    ) -> None:
        """Integrate all elements with one of the functions of `kernel_entry`.

        Args:
            function: `STEP_BLOCK`, `STEP_IN_LOCKSTEP` or `FLY_ELEMENTS`.
            program: program of the system and its effects.
            arrays: batch of elements.
            block: buffers of the slots.
            w: number of slots in use.
        """
        self._call_function(function, program, arrays, block, w, arrays.mass, 1.0, arrays.mass)

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
        arguments = np.zeros(kernel_entry.ARGUMENT_COUNT, dtype=np.int64)
        arguments[:5] = kernel_entry.RUN_INSTRUCTIONS, first, last, 1, len(code)
        arguments[11:14] = len(r), r.shape[1], r.shape[1]
        arguments[kernel_entry.SIZE_COUNT] = get_address(code)
        arguments[kernel_entry.SIZE_COUNT + kernel_entry.INT_ARRAY_COUNT] = get_address(r)
        run: Any = partial(self._function, ctypes.c_void_p(get_address(arguments)))
        run.owners = arguments, code, r  # keeps the memory at the addresses
        return run  # type: ignore[no-any-return]

    def _call_function(
        self, function: int, program: ProgramArrays, arrays: BatchArrays, block: BlockBuffers,
        w: int, spans: FloatArray, max_phase: float, divisions: FloatArray,
    ) -> None:  # fmt: skip
        """Pack all sizes and array addresses into one array, and call the compiled function.

        `function` is the number of the kernel's function, and `w` the number of slots, each
        of which holds one batch element at a time. The order of the arguments is that of
        `kernel_entry`.
        """
        # The compiled code does not check array bounds.
        check_array_layout(program, arrays, block, w, spans, divisions)
        element_count, dimensions = arrays.x.shape
        selected_count, columns = arrays.parameters.shape
        sizes = [
            *(function, element_count, selected_count, dimensions, len(program.code), columns),
            *(*arrays.steps.shape, *arrays.inputs.shape[:2], arrays.steps_per_record),
            *(len(block.r), w, block.r.shape[1]),
        ]
        limits = np.array([arrays.patience, max_phase])
        ints = [*program, arrays.order, block.n]
        reals = [
            *(block.r, block.a, arrays.parameters, arrays.mass, arrays.x, arrays.v, arrays.steps),
            *(arrays.inputs, arrays.max_steps, arrays.planned_counts, arrays.ground),
            *(arrays.records, spans, divisions, limits),
        ]
        arguments = np.array(
            [*sizes, *map(get_address, ints), *map(get_address, reals)], dtype=np.int64
        )
        self._function(get_address(arguments))


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
    return CompiledKernel(_load_function())


def load_compiled_module(
    module: str, entry: str, source: Path, description: str
) -> Callable[[int], None]:
    """Return a function of a module, compiled on first use with all functions that it calls.

    Args:
        module: name of the module, which imports nothing that the compiled functions use.
        entry: name of the function. It receives the address of integers; its code may use
            `carray` and the functions `to_*_pointer` of `kernel_build`.
        source: source file of the module.
        description: what is compiled, for the message to the user.

    Raises:
        InputError: the compiler or its machine code cannot be used.
    """
    compile_sources = [Path(__file__).with_name(f"{name}.py") for name in _COMPILER_MODULES]

    def compile_module() -> bytes:
        """Compile the module with numba, and tell the user why this takes time."""
        _print_line(f"compiling {description}, once after an install: about 10 s")
        from sims.engines.compiled.kernel_build import build_module

        return build_module(module, entry)

    key = _hash_sources([source, *compile_sources])
    with _lock:
        return _load_stored(f"{source.stem}-{key}.bin", compile_module, 1)


def load_callback(offsets: Mapping[str, int]) -> Callable[..., None]:
    """Return the compiled callback of MuJoCo's steps, compiled on first use.

    Args:
        offsets: offset of each field in MuJoCo's data, in words of eight bytes.

    Raises:
        InputError: the compiler or its machine code cannot be used.
    """
    with _lock:
        return _load_function(offsets)


def _load_function(offsets: Mapping[str, int] | None = None) -> Callable[..., None]:
    """Return the function of the kernel, or with offsets the callback, see `load_callback`."""
    name = "stepping" if offsets is None else "callback"
    return _load_stored(
        f"{name}-{_compute_cache_key(offsets)}.bin",
        lambda: _compile_machine_code(offsets),
        1 if offsets is None else 2,
    )


def _load_stored(
    name: str, compile_code: Callable[[], bytes], pointers: int
) -> Callable[..., None]:
    """Return the function whose machine code is in a file of the cache, compiled if necessary.

    Args:
        name: name of the file.
        compile_code: function that compiles the code if the file does not exist.
        pointers: number of pointer arguments of the function.

    Raises:
        InputError: the compiler or its machine code cannot be used.
    """
    try:
        code = machine_code.MachineCode.unpack(_get_machine_code(name, compile_code))
        return machine_code.load_machine_code(code, pointers)
    # A compiler that does not match this Python or its NumPy may raise any error.
    except Exception as error:
        text = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(
            f"the batch engine cannot be compiled: {text}; expected working versions of numba and"
            " llvmlite: install simgap again with the versions of requirements.lock"
        ) from error


def _get_machine_code(name: str, compile_code: Callable[[], bytes]) -> bytes:
    """Return the machine code: from the file `name` of the cache, or compiled.

    Compilation takes about 20 s, so the code is stored in the user's cache. If the cache cannot
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


def _compile_machine_code(offsets: Mapping[str, int] | None) -> bytes:
    """Compile the kernel's machine code with numba, and tell the user why this takes time.

    `offsets` are the positions of fields in MuJoCo's data, for the callback; None for the
    kernel of the batch engine.
    """
    if offsets is None:
        _print_line(
            f"compiling the batch engine, once after an install: about {_COMPILE_SECONDS} s"
        )
    else:
        _print_line("compiling the forces of effects, once after an install: about 10 s")
    from sims.engines.compiled.kernel_build import build_kernel

    return build_kernel(offsets)


def _report_wait() -> None:
    """Tell the user that another process is compiling, so that this one waits for its result."""
    _print_line(
        f"another process compiles this code, once after an install: {_COMPILE_SECONDS} s at most"
    )


def _print_line(text: str) -> None:
    """Write one line to the standard error output."""
    sys.stderr.write(f"simgap: {text}\n")
    sys.stderr.flush()


def _compute_cache_key(offsets: Mapping[str, int] | None = None) -> str:
    """Return a hash of everything on which the code depends: sources, compiler, processor."""
    return _hash_sources(
        list_source_files(), "" if offsets is None else repr(sorted(offsets.items()))
    )


def _hash_sources(sources: Sequence[Path], further_text: str = "") -> str:
    """Return a hash of source files, the compiler, the processor and a further text."""
    digest = hashlib.sha256()
    for source in sources:
        digest.update(source.read_bytes())
    digest.update(repr(machine_code.describe_processor()).encode())
    digest.update(further_text.encode())
    return digest.hexdigest()[:24]


def list_source_files() -> list[Path]:
    """Return the source files from which the code is compiled."""
    folder = Path(__file__).parent
    files = [folder / f"{name}.py" for name in KERNEL_SOURCE_MODULES]
    return [*files, folder.parent / "ground_contact.py"]
