"""The compiled code: loaded from the user's cache, made there the first time.

numba translates the functions (`build`), which takes most of a minute; LLVM's machine code is kept
in a file named for all that it depends on, and loaded by llvmlite alone, in some hundredths of a
second and without numba.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from sims.engines.compiled import entry
from sims.engines.compiled.kinds import Block, Numbers, Program, Work

_PARTS = ("advance", "build", "entry", "evaluate", "events", "graph", "kinds", "machine", "pace")
"""Modules on which the code depends."""
_RULES = ("batch/stepping.py", "batch/pace.py", "ground.py")
"""And those of the engines."""
_DIGEST = hashlib.sha256().digest_size
_kept: list[Any] = []
"""What owns the code: it lives as long as the process."""


class Machine:
    """The compiled functions.

    Args:
        function: of `sims.engines.compiled.entry`.
    """

    def __init__(self, function: Callable[..., None]) -> None:
        self._function = function

    def divide(
        self, program: Program, work: Work, block: Block, w: int, spans: Numbers, turn: float,
        parts: Numbers,
    ) -> None:  # fmt: skip
        """See `sims.engines.compiled.pace`."""
        self._call(0, program, work, block, w, spans, turn, parts)

    def advance(self, program: Program, work: Work, block: Block, w: int) -> None:
        """See `sims.engines.compiled.advance`."""
        self._call(1, program, work, block, w, work.mass, 1.0, work.mass)

    def _call(
        self, what: int, program: Program, work: Work, block: Block, w: int, spans: Numbers,
        turn: float, parts: Numbers,
    ) -> None:  # fmt: skip
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
            ctypes.byref((ctypes.c_int64 * entry.SIZES)(*sizes)),
            ctypes.byref(reals),
            *(array.ctypes.data for array in arrays),
        )


@cache
def machine() -> Machine | None:
    """The machine, compiled if it never was; None without a compiler or a place to keep it."""
    off = os.environ.get("SIMGAP_COMPILED") == "off"
    if off or importlib.util.find_spec("llvmlite") is None:
        return None
    path = _folder() / f"stepping-{_key()}.bin"
    code = _read(path)
    if code is None:
        code = _made(path)
    return None if code is None else Machine(_loaded(code))


def _folder() -> Path:
    """Where the code is kept: $SIMGAP_COMPILED, else simgap/ in the user's cache folder."""
    if folder := os.environ.get("SIMGAP_COMPILED"):
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "simgap"


def _key() -> str:
    """All that the code depends on: sources, compiler, processor."""
    import llvmlite.binding as llvm

    here = Path(__file__).parent
    sources = [here / f"{name}.py" for name in _PARTS] + [here.parent / name for name in _RULES]
    digest = hashlib.sha256()
    for source in sources:
        digest.update(source.read_bytes())
    versions = [metadata.version("llvmlite"), llvm.get_host_cpu_name()]
    digest.update(repr([*versions, llvm.get_host_cpu_features().flatten()]).encode())
    return digest.hexdigest()[:24]


def _read(path: Path) -> bytes | None:
    """Code that was kept; None if there is none, or it is damaged."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    code = data[_DIGEST:]
    return code if hashlib.sha256(code).digest() == data[:_DIGEST] else None


def _made(path: Path) -> bytes | None:
    """Compile and keep; None without numba or a place to keep it."""
    if importlib.util.find_spec("numba") is None:
        return None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _alone(path.with_suffix(".lock")):
            # Another process may have made it meanwhile.
            code = _read(path)
            if code is None:
                sys.stderr.write("simgap: compiling the batch engine, once after an install\n")
                sys.stderr.flush()
                code = _object(path)
            return code
    except OSError as reason:
        sys.stderr.write(f"simgap: the batch engine is not compiled: {reason}\n")
        return None


def _object(path: Path) -> bytes:
    """Machine code, kept at `path`."""
    import llvmlite.binding as llvm

    from sims.engines.compiled.build import compiled

    text, name = compiled()
    module = llvm.parse_assembly(text)
    module.verify()
    # A name of our own in place of the translator's.
    code: bytes = name.encode() + b"\0" + _target(llvm).emit_object(module)
    beside = path.with_suffix(f".{os.getpid()}")
    beside.write_bytes(hashlib.sha256(code).digest() + code)
    beside.replace(path)
    return code


def _target(llvm: Any) -> Any:
    """The processor at hand."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        jit=True,
    )


def _loaded(code: bytes) -> Callable[..., None]:
    """The function in kept code."""
    import llvmlite.binding as llvm

    name, machine_code = code.split(b"\0", 1)
    target = _target(llvm)
    # What the translator's error handling calls: no error is ever raised, so nothing calls it.
    process = ctypes.CDLL(None)
    nowhere = ctypes.cast(process.abort, ctypes.c_void_p).value
    for symbol in _UNUSED:
        llvm.add_symbol(symbol, nowhere)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target)
    engine.add_object_file(llvm.ObjectFileRef.from_data(machine_code))
    engine.finalize_object()
    _kept.append(engine)
    pointers = [ctypes.c_void_p] * (2 + entry.ARRAYS - 1)
    return ctypes.CFUNCTYPE(None, *pointers)(engine.get_function_address(name.decode()))


_UNUSED = (
    *("numba_gil_ensure", "numba_gil_release", "numba_unpickle", "numba_do_raise"),
    *("numba_runtime_build_excinfo_struct", "NRT_Free", "NRT_MemInfo_call_dtor"),
)


@contextlib.contextmanager
def _alone(path: Path) -> Iterator[None]:
    """While no other process is in here with this path, where the system knows how to tell."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with path.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
