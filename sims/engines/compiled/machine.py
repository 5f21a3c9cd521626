"""The compiled code: loaded from the user's cache, made there the first time.

numba translates the functions (`build`), which takes 20 s; LLVM's machine code is kept
(`kept`) and loaded by llvmlite alone (`native`), in some hundredths of a second and without numba.
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

from sims.engines.compiled import entry, kept, native
from sims.engines.compiled.kinds import Array, Block, Numbers, Program, Table, Work, check

PARTS = (
    *("advance", "build", "clock", "dynamics", "entry", "evaluate", "events", "graph", "kinds"),
    *("lockstep", "native", "pace"),
)
"""Modules of this room on which the code depends."""
RULES = ("batch/stepping.py", "batch/pace.py", "ground.py")
"""And those of the engines."""
_SECONDS = 20
"""What compiling takes, about."""
_lock = Lock()


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

    def march(self, program: Program, work: Work, block: Block, w: int) -> None:
        """See `sims.engines.compiled.lockstep`."""
        self._call(2, program, work, block, w, work.mass, 1.0, work.mass)

    def execution(self, code: Table, first: int, last: int, r: Numbers) -> Callable[[], None]:
        """What runs instructions first to last - 1 on registers, whatever these hold by then.

        Args:
            code: (n, 5), see `Program`.
            first: see above.
            last: see above.
            r: (registers, lanes).

        Raises:
            ValueError: the instructions reach beyond the registers.
        """
        whole = code.flags.c_contiguous and code.dtype == np.int64 and code.shape[1:] == (5,)
        real = r.flags.c_contiguous and r.dtype == np.float64 and r.ndim == 2
        inside = 0 <= first <= last <= len(code) and code[:, 1:].max(initial=0) < len(r)
        if not (whole and real and inside and code.min(initial=0) >= 0):
            raise ValueError("the instructions are not for these registers")
        sizes = [3, first, last, 1, len(code), *[0] * 6, *r.shape]
        keep = (ctypes.c_int64 * entry.SIZES)(*sizes), code, r
        addresses: list[int | None] = [None] * (entry.ARRAYS + 1)
        addresses[0] = ctypes.addressof(keep[0])
        addresses[_CODE], addresses[_REGISTERS] = _address(code), _address(r)
        pointers = [ctypes.c_void_p(address) for address in addresses]

        def run() -> None:
            assert keep  # what the pointers point at
            self._function(*pointers)

        return run

    def _call(
        self, what: int, program: Program, work: Work, block: Block, w: int, spans: Numbers,
        turn: float, parts: Numbers,
    ) -> None:  # fmt: skip
        # Nothing in there looks whether it reaches beyond an array.
        check(program, work, block, w, spans, parts)
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
            *map(_address, arrays),
        )


_Nothing = ctypes.c_char * 0
_names = list(inspect.signature(entry.integrate).parameters)
_CODE, _REGISTERS = _names.index("code_at"), _names.index("r_at")


def _address(array: Array) -> int:
    """Where an array begins; numpy's own way takes four times as long, and there are many."""
    if array.flags.writeable:
        return ctypes.addressof(_Nothing.from_buffer(array.data))
    return int(array.ctypes.data)


def machine() -> Machine | None:
    """The machine, compiled if it never was; None without a compiler or a place to keep it."""
    with _lock:
        return _machine()


@cache
def _machine() -> Machine | None:
    if kept.is_off() or importlib.util.find_spec("llvmlite") is None:
        return None
    # Whatever a compiler that does not fit this Python or its numpy says: it can be done without.
    try:
        data = _data()
        if data is None:
            return None
        return Machine(native.loaded(native.Code.unpacked(data), entry.ARRAYS + 1))
    except Exception as reason:
        text = str(reason) or type(reason).__name__
        _say(f"the batch engine is not compiled, and slower: {text.splitlines()[0]}")
        return None


def _data() -> bytes | None:
    """The code as it is kept, made if it is not; None without numba, which makes it."""
    path = kept.folder() / f"stepping-{_key()}.bin"
    data = kept.read(path)
    if data is None and importlib.util.find_spec("numba") is not None:
        data = kept.made_once(path, _made, _wait)
    return data


def _made() -> bytes:
    _say(f"compiling the batch engine, once after an install: about {_SECONDS} s")
    from sims.engines.compiled.build import built

    return built()


def _wait() -> None:
    _say(f"another process compiles the batch engine, once after an install: {_SECONDS} s at most")


def _say(text: str) -> None:
    """One line."""
    sys.stderr.write(f"simgap: {text}\n")
    sys.stderr.flush()


def _key() -> str:
    """All that the code depends on: sources, compiler, processor."""
    digest = hashlib.sha256()
    for source in sources():
        digest.update(source.read_bytes())
    digest.update(repr(native.processor()).encode())
    return digest.hexdigest()[:24]


def sources() -> list[Path]:
    """The files of which the code is made."""
    here = Path(__file__).parent
    return [here / f"{name}.py" for name in PARTS] + [here.parent / name for name in RULES]
