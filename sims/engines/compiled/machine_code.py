"""Machine code: compile LLVM's intermediate code for the present processor, and load the result."""

from __future__ import annotations

import ctypes
import json
import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

_owners: list[Any] = []
"""Owners of the loaded code, which lives as long as the process."""
_NEVER_CALLED = ("numba_", "NRT_")
"""Prefixes of the names of numba's error handling, which is never called."""


class CodeNotLoadableError(Exception):
    """Machine code cannot be loaded in this process."""


class MachineCode(NamedTuple):
    """Machine code of one function.

    Attributes:
        name: name of the function.
        needs: names of the external symbols that it uses.
        body: object file.
    """

    name: str
    needs: Sequence[str]
    body: bytes

    def pack(self) -> bytes:
        """Return the code as bytes for the cache."""
        return json.dumps([self.name, list(self.needs)]).encode() + b"\0" + self.body

    @classmethod
    def unpack(cls, data: bytes) -> MachineCode:
        """Restore code from the bytes of `pack`."""
        head, body = data.split(b"\0", 1)
        name, symbols = json.loads(head)
        return cls(name, tuple(symbols), body)


def describe_processor() -> list[str]:
    """Return what machine code depends on in addition to its source.

    Returns:
        llvmlite's version, and name and features of the processor.
    """
    import llvmlite
    import llvmlite.binding as llvm

    features = llvm.get_host_cpu_features().flatten()
    return [llvmlite.__version__, llvm.get_host_cpu_name(), features]


def compile_llvm(text: str, name: str) -> MachineCode:
    """Compile LLVM's intermediate code to optimised machine code for the present processor.

    All functions except the named one become internal, so that those that are inlined everywhere
    are not kept. Symbols that are only declared, such as the sine of the C library, are stored by
    name; they are resolved when the code is loaded.

    Args:
        text: LLVM intermediate code.
        name: name of the function that is called from outside.
    """
    import llvmlite.binding as llvm

    module = llvm.parse_assembly(text)
    module.verify()
    for symbol in (*module.functions, *module.global_variables):
        if not symbol.is_declaration and symbol.name != name:
            symbol.linkage = "internal"
    target = _make_target(llvm)
    tuning = llvm.create_pipeline_tuning_options(speed_level=3)
    tuning.loop_vectorization = True
    builder = llvm.create_pass_builder(target, tuning)
    builder.getModulePassManager().run(module, builder)
    symbols = [
        symbol.name
        for symbol in (*module.functions, *module.global_variables)
        if symbol.is_declaration and not symbol.name.startswith("llvm.")
    ]
    return MachineCode(name, symbols, target.emit_object(module))


def load_machine_code(code: MachineCode, pointers: int = 1) -> Callable[..., None]:
    """Load the machine code of a function, and return it as a callable function.

    The code was compiled earlier, perhaps by another process. Only llvmlite is needed to load
    it. Functions of numba's error handling, which is never called, are replaced by one that aborts,
    since numba may not be installed.

    Args:
        code: machine code.
        pointers: number of arguments of the function, which are all pointers.

    Raises:
        CodeNotLoadableError: a required symbol is missing. It is checked here, because LLVM itself
            would end the process.
    """
    import llvmlite.binding as llvm

    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _make_target(llvm))
    abort_function = ctypes.CFUNCTYPE(None)(os.abort)
    for symbol in code.needs:
        if symbol.startswith(_NEVER_CALLED):
            llvm.add_symbol(symbol, ctypes.cast(abort_function, ctypes.c_void_p).value)
        elif not llvm.address_of_symbol(symbol):
            raise CodeNotLoadableError(f"{symbol} is missing")
    engine.add_object_file(llvm.ObjectFileRef.from_data(code.body))
    engine.finalize_object()
    _owners.append((engine, abort_function))  # without a reference, the code would be released
    kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * pointers)
    return kind(engine.get_function_address(code.name))


def _make_target(llvm: Any) -> Any:
    """Return the target machine of the present processor.

    Args:
        llvm: The module `llvmlite.binding`.
    """
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        jit=True,
    )
