"""Functions that exist in compiled code only: declarations, and their definitions for numba."""

from __future__ import annotations

from typing import Any


def carray(pointer: Any, shape: Any) -> Any:
    """Return the array at a pointer.

    Args:
        pointer: pointer to the first number.
        shape: tuple of the lengths.
    """
    raise NotImplementedError


def to_real_pointer(address: Any) -> Any:
    """Return an address as a pointer to floating-point numbers."""
    raise NotImplementedError


def to_int_pointer(address: Any) -> Any:
    """Return an address as a pointer to 64-bit integers."""
    raise NotImplementedError


def to_short_pointer(address: Any) -> Any:
    """Return an address as a pointer to 32-bit integers."""
    raise NotImplementedError


def to_fixed_tuple(array: Any, size: int) -> Any:
    """Return the first numbers of an array as a tuple.

    Args:
        array: the array.
        size: number of entries, known when it is compiled.
    """
    raise NotImplementedError


def call_external(address: int, part: int, w: int) -> None:
    """Call the C function at an address with two integers.

    Args:
        address: address of the function.
        part: number of the part of a program.
        w: number of slots in use.
    """
    raise NotImplementedError


def make_intrinsics(numba: Any) -> dict[str, Any]:
    """Return the compiled versions of the functions of this module, by name.

    An intrinsic is a function whose LLVM code is generated here. The compiled code uses them to
    read arrays of other libraries, and to call Python through a C callback. numba calls such a
    function during compilation, with the types of the arguments; the function returns the signature
    and a generator of the LLVM code.

    Args:
        numba: the module numba.
    """
    from llvmlite import ir
    from numba.np.unsafe.ndarray import to_fixed_tuple

    types = numba.types
    word = ir.IntType(64)  # integer of 64 bits, which also holds an address

    def make_pointer_function(kind: Any, target: Any) -> Any:
        """Make a numba function that converts an integer address to a pointer.

        Args:
            kind: type of the numbers at the address, for numba.
            target: the same type for LLVM.
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

        Args:
            context: typing context of numba.
            address: type of the address.
            part: type of the first integer.
            w: type of the second integer.
        """

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
            function = ir.FunctionType(ir.VoidType(), [word, word])
            builder.call(builder.inttoptr(values[0], function.as_pointer()), values[1:])
            return context.get_dummy_value()

        return types.void(types.int64, types.int64, types.int64), generate

    return {
        "carray": numba.carray,
        "to_fixed_tuple": to_fixed_tuple,
        "call_external": numba.extending.intrinsic(call_external),
        "to_int_pointer": make_pointer_function(types.int64, word),
        "to_short_pointer": make_pointer_function(types.int32, ir.IntType(32)),
        "to_real_pointer": make_pointer_function(types.float64, ir.DoubleType()),
    }
