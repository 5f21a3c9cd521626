"""Cache of machine code on disk: load the stored code of a module, or compile and store it once.

The name of a file contains a hash of everything on which the code depends. One process compiles the
code while the others wait.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from threading import Lock

from sims.core.files import lock_file
from sims.core.simulator import InputError
from sims.engines.compiled import machine_code

_MAX_COMPILE_SECONDS = 20
"""Approximate compilation time of the batch engine in seconds, the longest one."""

_PYTHON_MODULES = ("register_programs.py", "batch_runner.py", "force_program.py")
"""Source files of this package on which no compiled code depends."""

_lock = Lock()
_DIGEST_BYTES = hashlib.sha256().digest_size


def load_stored(
    module: str, entry: str, description: str, pointers: int, constants: Mapping[str, int]
) -> Callable[..., None]:
    """Return a function as machine code: from the user's cache, or compiled now and stored there.

    A lock prevents that two threads compile the same function.

    Args:
        module: name of the function's module.
        entry: name of the function, or of `CompiledFunctions`.
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
        from sims.engines.compiled.numba_compilation import build_module

        return build_module(module, entry, pointers, constants)

    try:
        with _lock:
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
    """Return the machine code: from the user's cache, or compiled and stored there.

    Compilation takes up to 20 s. If the cache cannot be written, each process compiles again.

    Args:
        name: name of the file in the cache.
        compile_code: function that compiles the code.
    """
    folder = get_cache_folder()
    path = folder / name
    data = read_cached(path)
    if data is not None:
        return data
    try:
        return make_cached(path, compile_code, _report_wait)
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
    """Return the name of the cached file with the machine code of a module.

    The name contains a hash of everything on which the code depends: sources, constants, compiler
    and processor. So a change of any of them leads to another file, and old code is never used.

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
    files.append(Path(str(sys.modules[module].__file__)))
    return sorted(set(files))


def get_cache_folder() -> Path:
    """Return the cache folder: $SIMGAP_COMPILED, else simgap/ in the user's cache folder."""
    if stated_folder := os.environ.get("SIMGAP_COMPILED"):
        return Path(stated_folder)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "simgap"


def read_cached(path: Path) -> bytes | None:
    """Return the cached content; None if it does not exist or is damaged."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    content = data[_DIGEST_BYTES:]
    return content if hashlib.sha256(content).digest() == data[:_DIGEST_BYTES] else None


def make_cached(path: Path, make: Callable[[], bytes], report_wait: Callable[[], None]) -> bytes:
    """Return the cached content of a file; if it does not exist, make and store it first.

    If several processes request it, only one makes it, and the others wait for its result.

    Args:
        path: path of the file.
        make: function that makes the content if it does not exist.
        report_wait: called once if another process is making the content.

    Raises:
        OSError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with _hold_lock(path.with_suffix(".lock"), report_wait):
        # Another process may have made it meanwhile.
        content = read_cached(path)
        if content is None:
            content = make()
            _write_atomically(path, content)
    return content


def _write_atomically(path: Path, content: bytes) -> None:
    """Write a file atomically, with the hash of its content in front, by which damage is noticed.

    Args:
        path: path of the file.
        content: content without the hash.
    """
    # The temporary name is fixed, so that the file of a killed process is overwritten by the next.
    partial = path.with_suffix(".part")
    try:
        partial.write_bytes(hashlib.sha256(content).digest() + content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextlib.contextmanager
def _hold_lock(path: Path, report_wait: Callable[[], None]) -> Iterator[None]:
    """Hold an exclusive lock between processes, so that only one of them compiles.

    Without fcntl (Windows) there is no lock, and several processes may compile.

    Args:
        path: path of the lock file.
        report_wait: called before waiting, if another process has the lock.
    """
    with path.open("w") as lock:
        try:
            lock_file(lock)
        except BlockingIOError:
            report_wait()
            lock_file(lock, is_blocking=True)
        yield
