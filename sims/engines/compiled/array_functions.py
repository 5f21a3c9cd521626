"""Functions on arrays in machine code: loaded from the user's cache, or compiled once.

numba translates the functions (`kernel_build`), which takes up to 20 s. The machine code is stored
and loaded with llvmlite alone (`machine_code`), in a few hundredths of a second and without numba.
"""

from __future__ import annotations

import ctypes
import hashlib
import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from threading import Lock
from types import FunctionType
from typing import Any

import numpy as np

from sims.core.simulator import InputError
from sims.engines.compiled import intrinsics, machine_code
from sims.engines.compiled.data_layout import INTEGERS, Array, measure_arrays

_MAX_COMPILE_SECONDS = 20
"""Approximate compilation time of the batch engine in seconds, the longest one."""
_PYTHON_MODULES = ("array_programs.py", "batch_runner.py", "force_program.py")
"""Source files of this package on which no compiled code depends."""
_lock = Lock()


class ArrayFunctions:
    """Functions on arrays of a module, compiled on first use into one piece of machine code."""

    def __init__(
        self,
        module: str,
        description: str,
        shapes: Mapping[Callable[..., None], Sequence[str]],
    ) -> None:
        """Store which functions to compile; compilation happens at their first use.

        Args:
            module: name of the module, which holds this object under the name ``COMPILED``.
            description: what is compiled, for messages to the user.
            shapes: shapes of the arguments of each function, one letter for each dimension. Equal
                letters are equal sizes, and ``#`` marks integers (see `data_layout`). A function
                with one parameter receives all arguments as one tuple, whose class is its
                annotation.
        """
        self._module, self._description = module, description
        self._shapes = dict(shapes)
        self._compiled: Callable[..., None] | None = None

    def call(self, function: Callable[..., None], *arguments: Any) -> list[Array]:
        """Run a function on the given arguments, and return the arrays that it fills in.

        Compiled functions cannot allocate memory. So the arrays for the results, which are the last
        parameters of a function, are allocated here, with zeros. Their sizes follow from the
        letters that the shapes of the given arguments have in common with theirs.

        Args:
            function: one of the functions.
            arguments: first arguments: contiguous arrays and integers. Arrays may be changed.

        Raises:
            ValueError: an array has another shape, type or memory layout than declared.
        """
        shapes = self._shapes[function]
        sizes = measure_arrays(shapes[: len(arguments)], arguments)
        results = [
            np.zeros([int(a) if a.isdigit() else sizes[a] for a in shape])
            for shape in shapes[len(arguments) :]
        ]
        self._bind(function, sizes, (*arguments, *results))()
        return results

    def bind(self, function: Callable[..., None], *arguments: Any) -> Callable[[], None]:
        """Check the arguments of a function once, and return a call of it without arguments.

        The call reads and writes the memory of these arrays, so it can be repeated cheaply after
        their values have changed.

        Args:
            function: one of the functions.
            arguments: all of its arguments, see `call`.

        Raises:
            ValueError: an array has another shape, type or memory layout than declared.
        """
        # Measuring checks the arrays; the compiled code itself does not check array bounds.
        return self._bind(function, measure_arrays(self._shapes[function], arguments), arguments)

    def _bind(
        self, function: Callable[..., None], sizes: Mapping[str, int], arguments: tuple[Any, ...]
    ) -> Callable[[], None]:
        """Return a call of a function on arguments whose shapes are already checked, see `bind`.

        All functions are compiled into one entry (`make_entry`), which has a single argument: the
        address of an array of integers. They are the number of the function, the sizes of its
        arrays, and then each argument: the address of an array, or an integer itself.

        Args:
            function: One of the functions of this object.
            sizes: Sizes of the arguments by letter of their shapes.
            arguments: Arrays and integers.
        """
        words = np.array(
            [
                list(self._shapes).index(function),
                *sizes.values(),
                *(get_address(a) if isinstance(a, np.ndarray) else a for a in arguments),
            ],
            dtype=np.int64,
        )
        run: Any = partial(self.load(), ctypes.c_void_p(get_address(words)))
        run.owners = words, arguments  # keeps the memory at the addresses
        return run  # type: ignore[no-any-return]

    def load(self) -> Callable[..., None]:
        """Return the machine code of `make_entry`, compiled on first use.

        Raises:
            InputError: the compiler or its machine code cannot be used.
        """
        if self._compiled is None:
            self._compiled = load_stored(self._module, "COMPILED", self._description, 1, {})
        return self._compiled

    def make_entry(self) -> FunctionType:
        """Generate the Python function that numba compiles: one entry for all functions.

        Its source text is written here and executed. It reads the array of integers that `_bind`
        makes (``words``): the number of the function, the sizes in the order of their letters, and
        each argument. It turns addresses into arrays of these sizes, and calls the function. For
        example, a function ``scale(x, k)`` of shapes ``n`` and ``#`` becomes::

            def entry(address):
                words = carray(address, (4,))
                if words[0] == 0:
                    n = words[1]
                    scale(carray(to_real_pointer(words[2]), (n, )), words[3])
        """
        count = max(map(_count_words, self._shapes.values()))
        lines = ["def entry(address):", f"    words = carray(address, ({count},))"]
        space: dict[str, Any] = {**vars(intrinsics), "__name__": self._module}
        for index, (function, shapes) in enumerate(self._shapes.items()):
            letters = _list_letters(shapes)
            lines.append(f"    if words[0] == {index}:")
            lines += [f"        {letter} = words[{k}]" for k, letter in enumerate(letters, 1)]
            arguments = ", ".join(
                _format_argument(shape, f"words[{k}]")
                for k, shape in enumerate(shapes, 1 + len(letters))
            )
            parameters = list(inspect.signature(function).parameters.values())
            if len(parameters) < len(shapes):
                kind = parameters[0].annotation
                space[kind] = getattr(sys.modules[function.__module__], kind)
                arguments = f"{kind}({arguments})"
            lines.append(f"        {function.__name__}({arguments})")
            space[function.__name__] = function
        exec("\n".join(lines), space)
        entry: FunctionType = space["entry"]
        return entry


def _list_letters(shapes: Sequence[str]) -> list[str]:
    """Return the letters of shapes in the order in which they first occur."""
    return [letter for letter in dict.fromkeys("".join(shapes)) if letter.isalpha()]


def _count_words(shapes: Sequence[str]) -> int:
    """Return the number of integers that a call with arguments of these shapes needs."""
    return 1 + len(_list_letters(shapes)) + len(shapes)


def _format_argument(shape: str, word: str) -> str:
    """Return the source text with which the compiled entry reads one argument of a function.

    Args:
        shape: shape of the argument: `INTEGERS` for an integer, otherwise an array.
        word: source text of the number that the entry receives for it: the integer itself, or the
            address of the array.
    """
    if shape == INTEGERS:
        return word
    kind = "int" if shape.startswith(INTEGERS) else "real"
    sizes = "".join(f"{size}, " for size in shape.removeprefix(INTEGERS))
    return f"carray(to_{kind}_pointer({word}), ({sizes}))"


_NullArray = ctypes.c_char * 0


def get_address(array: Array) -> int:
    """Return the address of an array; NumPy's own way takes four times as long."""
    if array.flags.writeable:
        return ctypes.addressof(_NullArray.from_buffer(array.data))
    return int(array.ctypes.data)


def load_stored(
    module: str, entry: str, description: str, pointers: int, constants: Mapping[str, int]
) -> Callable[..., None]:
    """Return a function as machine code: from the user's cache, or compiled now and stored there.

    A lock prevents that two threads compile the same function.

    Args:
        module: name of the function's module.
        entry: name of the function, or of `ArrayFunctions`.
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
    files += [folder.parent / "ground_contact.py", Path(str(sys.modules[module].__file__))]
    return sorted(set(files))
