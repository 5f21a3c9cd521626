"""Compiled kernel of the batch engine: loaded from the user's cache, or compiled once.

numba translates the functions (`build`), which takes 20 s. LLVM's machine code is stored
(`code_cache`)
and loaded with llvmlite alone (`llvm_code`), in a few hundredths of a second and without numba.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import inspect
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from threading import Lock

import numpy as np

from sims.engines.compiled import code_cache, kernel_entry, llvm_code
from sims.engines.compiled.data_layout import (
    Array,
    BatchArrays,
    BlockBuffers,
    FloatArray,
    IntTable,
    ProgramArrays,
    check_array_layout,
)

KERNEL_SOURCE_MODULES = (
    *(
        "element_stepping",
        "kernel_build",
        "element_clock",
        "dynamics",
        "kernel_entry",
        "interpreter",
    ),
    *("events", "expression_graph", "data_layout", "lockstep_stepping", "llvm_code", "step_size"),
)
"""Modules of this package on which the compiled code depends."""
ENGINE_SOURCE_FILES = ("batch/runge_kutta.py", "batch/step_size.py", "ground_contact.py")
"""Files of `sims/engines` on which the compiled code depends."""
_SECONDS = 20
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
        self, program: ProgramArrays, work: BatchArrays, block: BlockBuffers, w: int,
        spans: FloatArray, turn: float, parts: FloatArray,
    ) -> None:  # fmt: skip
        """Choose the number of parts of each step; see `sims.engines.compiled.step_size`.

        Args:
            program: program of the system and its effects.
            work: batch of elements.
            block: buffers of the slots.
            w: number of slots in use.
            spans: (L,) step sizes in seconds.
            turn: maximum phase of an oscillation per step in radians.
            parts: (L,) numbers of parts, updated in place.
        """
        self._call(0, program, work, block, w, spans, turn, parts)

    def step_block(
        self, program: ProgramArrays, work: BatchArrays, block: BlockBuffers, w: int
    ) -> None:
        """Step all elements, each with its own clock; see `sims.engines.compiled.element_stepping`.

        Args:
            program: program of the system and its effects.
            work: batch of elements.
            block: buffers of the slots.
            w: number of slots in use.
        """
        self._call(1, program, work, block, w, work.mass, 1.0, work.mass)

    def step_in_lockstep(
        self, program: ProgramArrays, work: BatchArrays, block: BlockBuffers, w: int
    ) -> None:
        """Step all elements in lockstep; see `sims.engines.compiled.lockstep_stepping`.

        Args:
            program: program of the system and its effects.
            work: batch of elements.
            block: buffers of the slots.
            w: number of slots in use.
        """
        self._call(2, program, work, block, w, work.mass, 1.0, work.mass)

    def make_instruction_runner(
        self, code: IntTable, first: int, last: int, r: FloatArray
    ) -> Callable[[], None]:
        """Return a function that runs instructions on the present values of the registers.

        Args:
            code: (n, 5) instructions; see `ProgramArrays`.
            first: index of the first instruction.
            last: index after the last instruction.
            r: (registers, lanes) registers.

        Returns:
            The function without arguments.

        Raises:
            ValueError: an instruction uses a register that does not exist.
        """
        whole = code.flags.c_contiguous and code.dtype == np.int64 and code.shape[1:] == (5,)
        real = r.flags.c_contiguous and r.dtype == np.float64 and r.ndim == 2
        inside = 0 <= first <= last <= len(code) and code[:, 1:].max(initial=0) < len(r)
        if not (whole and real and inside and code.min(initial=0) >= 0):
            raise ValueError("the instructions are not for these registers")
        sizes = [3, first, last, 1, len(code), *[0] * 6, *r.shape]
        keep = (ctypes.c_int64 * kernel_entry.SIZE_ARGUMENT_COUNT)(*sizes), code, r
        addresses: list[int | None] = [None] * (kernel_entry.ARRAY_ARGUMENT_COUNT + 1)
        addresses[0] = ctypes.addressof(keep[0])
        addresses[_CODE], addresses[_REGISTERS] = _address(code), _address(r)
        pointers = [ctypes.c_void_p(address) for address in addresses]

        def run() -> None:
            assert keep  # the owners of the memory at the pointers
            self._function(*pointers)

        return run

    def _call(
        self, what: int, program: ProgramArrays, work: BatchArrays, block: BlockBuffers, w: int,
        spans: FloatArray, turn: float, parts: FloatArray,
    ) -> None:  # fmt: skip
        # The compiled code does not check array bounds.
        check_array_layout(program, work, block, w, spans, parts)
        lanes, dimensions = work.x.shape
        chosen, columns = work.parameters.shape
        rows = work.inputs.shape[:2]
        sizes = [what, lanes, chosen, dimensions, len(program.code), columns, *work.steps.shape]
        sizes += [*rows, work.every, len(block.r), w]
        arrays = [
            *program,
            *(work.order, block.n, work.parameters, work.mass, work.x, work.v, work.steps),
            *(work.inputs, work.longest, work.planned, work.ground, work.kept),
            *(block.r, block.a, spans, parts),
        ]
        reals = (ctypes.c_double * 2)(work.patience, turn)
        self._function(
            ctypes.byref((ctypes.c_int64 * kernel_entry.SIZE_ARGUMENT_COUNT)(*sizes)),
            ctypes.byref(reals),
            *map(_address, arrays),
        )


_NullArray = ctypes.c_char * 0
_names = list(inspect.signature(kernel_entry.kernel_entry).parameters)
_CODE, _REGISTERS = _names.index("code_at"), _names.index("r_at")


def _address(array: Array) -> int:
    """Return the address of an array; NumPy's own way takes four times as long."""
    if array.flags.writeable:
        return ctypes.addressof(_NullArray.from_buffer(array.data))
    return int(array.ctypes.data)


def get_kernel() -> CompiledKernel | None:
    """Return the compiled kernel, compiled on first use.

    Returns:
        The kernel; None without a compiler or a folder for the cache.
    """
    with _lock:
        return _machine()


@cache
def _machine() -> CompiledKernel | None:
    if code_cache.is_compilation_disabled() or importlib.util.find_spec("llvmlite") is None:
        return None
    # The engine also works without the compiler, so any error of a compiler that does not match
    # this Python or its NumPy is only reported.
    try:
        data = _data()
        if data is None:
            return None
        return CompiledKernel(
            llvm_code.load_machine_code(
                llvm_code.MachineCode.unpack(data), kernel_entry.ARRAY_ARGUMENT_COUNT + 1
            )
        )
    except Exception as reason:
        text = str(reason) or type(reason).__name__
        _say(f"the batch engine is not compiled, and slower: {text.splitlines()[0]}")
        return None


def _data() -> bytes | None:
    """Return the cached code, compiled if necessary; None without numba, which compiles it."""
    path = code_cache.get_cache_folder() / f"stepping-{_key()}.bin"
    data = code_cache.read_cached(path)
    if data is None and importlib.util.find_spec("numba") is not None:
        data = code_cache.make_cached(path, _build_or_load, _wait)
    return data


def _build_or_load() -> bytes:
    _say(f"compiling the batch engine, once after an install: about {_SECONDS} s")
    from sims.engines.compiled.kernel_build import build_kernel

    return build_kernel()


def _wait() -> None:
    _say(f"another process compiles the batch engine, once after an install: {_SECONDS} s at most")


def _say(text: str) -> None:
    """Write one line to the standard error output."""
    sys.stderr.write(f"simgap: {text}\n")
    sys.stderr.flush()


def _key() -> str:
    """Return a hash of everything on which the code depends: sources, compiler, processor."""
    digest = hashlib.sha256()
    for source in list_source_files():
        digest.update(source.read_bytes())
    digest.update(repr(llvm_code.describe_processor()).encode())
    return digest.hexdigest()[:24]


def list_source_files() -> list[Path]:
    """Return the source files from which the code is compiled."""
    here = Path(__file__).parent
    return [here / f"{name}.py" for name in KERNEL_SOURCE_MODULES] + [
        here.parent / name for name in ENGINE_SOURCE_FILES
    ]
