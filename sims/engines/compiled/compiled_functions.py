"""Functions on arrays in machine code: loaded from the user's cache, or compiled once.

numba translates the functions (`numba_compilation`), which takes up to 20 s. The machine code is
stored (`machine_code_cache`), and loaded with llvmlite alone (`machine_code`), in a few hundredths
of a second and without numba.
"""

from __future__ import annotations

import ctypes
import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import FunctionType
from typing import Any

import numpy as np

from sims.engines.compiled import intrinsics
from sims.engines.compiled.data_layout import INTEGERS, Array, measure_arrays
from sims.engines.compiled.machine_code_cache import load_stored


class CompiledFunctions:
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
            np.zeros([int(size) if size.isdigit() else sizes[size] for size in shape])
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
            # `COMPILED` is the name of this object in its module.
            self._compiled = load_stored(
                self._module, "COMPILED", self._description, pointers=1, constants={}
            )
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
            if len(parameters) < len(shapes):  # it takes all arguments as one tuple of a class
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
