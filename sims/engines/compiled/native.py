"""Machine code: made of LLVM's intermediate code, and loaded, by llvmlite alone."""

from __future__ import annotations

import ctypes
import json
import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

_owners: list[Any] = []
"""What owns loaded code: it lives as long as the process."""
_NEVER_CALLED = ("numba_", "NRT_")
"""With which names begin of the translator's own error handling: no error is ever raised."""


class UnusableError(Exception):
    """Machine code that cannot be loaded here."""


class Code(NamedTuple):
    """Machine code of one function.

    Attributes:
        name: of the function.
        needs: names of what it calls.
        body: an object file.
    """

    name: str
    needs: Sequence[str]
    body: bytes

    def packed(self) -> bytes:
        """As it is kept."""
        return json.dumps([self.name, list(self.needs)]).encode() + b"\0" + self.body

    @classmethod
    def unpacked(cls, data: bytes) -> Code:
        """From what was kept."""
        head, body = data.split(b"\0", 1)
        name, needs = json.loads(head)
        return cls(name, tuple(needs), body)


def processor() -> list[str]:
    """What code depends on beside its source: llvmlite's version, name and abilities of the
    processor.
    """
    import llvmlite
    import llvmlite.binding as llvm

    features = llvm.get_host_cpu_features().flatten()
    return [llvmlite.__version__, llvm.get_host_cpu_name(), features]


def made(text: str, name: str) -> Code:
    """Machine code of intermediate code, for the processor at hand."""
    import llvmlite.binding as llvm

    module = llvm.parse_assembly(text)
    module.verify()
    for thing in (*module.functions, *module.global_variables):
        if not thing.is_declaration and thing.name != name:
            thing.linkage = "internal"  # so that nothing is kept that is written out everywhere
    target = _target(llvm)
    tuning = llvm.create_pipeline_tuning_options(speed_level=3)
    tuning.loop_vectorization = True
    builder = llvm.create_pass_builder(target, tuning)
    builder.getModulePassManager().run(module, builder)
    needs = [
        thing.name
        for thing in (*module.functions, *module.global_variables)
        if thing.is_declaration and not thing.name.startswith("llvm.")
    ]
    return Code(name, needs, target.emit_object(module))


def loaded(code: Code, pointers: int) -> Callable[..., None]:
    """The function, of so many pointers.

    Raises:
        UnusableError: something that it calls is not there; LLVM would end the process.
    """
    import llvmlite.binding as llvm

    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target(llvm))
    nowhere = ctypes.CFUNCTYPE(None)(os.abort)
    for symbol in code.needs:
        if symbol.startswith(_NEVER_CALLED):
            llvm.add_symbol(symbol, ctypes.cast(nowhere, ctypes.c_void_p).value)
        elif not llvm.address_of_symbol(symbol):
            raise UnusableError(f"{symbol} is missing")
    engine.add_object_file(llvm.ObjectFileRef.from_data(code.body))
    engine.finalize_object()
    _owners.append((engine, nowhere))
    kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * pointers)
    return kind(engine.get_function_address(code.name))


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
