"""Where a process has the tuners live that it drives: one nursery, and the tuners that serve more
than one run.
"""

from __future__ import annotations

import ast
import importlib.util
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from numpy.typing import NDArray

from bench.problem.experiment import Entry
from bench.registry import tuners
from bench.sealing.children import Nursery
from bench.sealing.ended import EndedError, KilledError
from bench.sealing.outside import SealedTuner, Tuned
from sims.base import InputError

Result = TypeVar("Result")

_KNOWN = (
    "bench", "botorch", "cma", "gpytorch", "linear_operator", "methods", "nlopt", "numpy", "pandas",
    "pysindy", "sbi", "scipy", "sims", "skopt", "sklearn", "statsmodels", "torch",
)  # fmt: skip
"""Packages that may be loaded ahead of a run: simgap's own and those that it requires. What else a
plugin imports is imported anew in each run: it could remember what an earlier one has seen.
"""
_KEPT = 8
"""Tuners that wait for another run at a time."""

RETRIES = 3
"""How often work is begun whose processes are killed from outside, which says nothing about it."""

_houses: dict[int, Nursery] = {}
_waiting: OrderedDict[Any, SealedTuner] = OrderedDict()


def nursery() -> Nursery:
    """The nursery of this process, begun when it is first needed."""
    held = _houses.get(0)
    if held is None or not held.alive:
        # Also one that was killed from outside, which leaves a folder.
        close()
        held = _houses[0] = Nursery()
    return held


@cache
def seals() -> tuple[str, ...]:
    """The seals that hold around a tuner's process on this machine; see `bench.sealing.seals`.

    Raises:
        InputError: no such process can be started.
    """
    try:
        return undisturbed(_seals)
    except EndedError as ended:
        raise InputError(
            f"no tuner can have a process of its own here: {ended}; mend that, or give --trust for "
            "tuners that you know"
        ) from None


def _seals() -> tuple[str, ...]:
    child = nursery().start("bench.sealing.inside:serve")
    try:
        child.ready()
        return tuple(child.seals)
    finally:
        child.end()


def close() -> None:
    """End every tuner's process of this one."""
    _waiting.clear()
    for house in _houses.values():
        house.close()
    _houses.clear()


def undisturbed(work: Callable[[], Result]) -> Result:
    """What `work` gives; it is begun again where one of its processes was killed from outside.

    Raises:
        EndedError: that happened again and again.
    """
    for _ in range(RETRIES):
        try:
            return work()
        except KilledError as killed:
            said = str(killed)
    # By then it is more likely its own doing.
    raise EndedError("crashed", f"{said}, {RETRIES} times")


def tuned_of(entry: Entry) -> Tuned:
    """Which tuner an entry stands for, wherever its code is."""
    kind = tuners.get(entry.tuner)
    place = tuners.place(entry.tuner)
    module = getattr(kind, "module", "") or kind.__module__
    ahead = ahead_of(str(place) if place else _file_of(module)) if place or module else ()
    return Tuned(kind.name, module, str(place or ""), dict(entry.options), ahead)


def _file_of(module: str) -> str:
    top = module.partition(".")[0]
    if top not in _KNOWN:
        return ""
    spec = importlib.util.find_spec(module)
    return (spec.origin or "") if spec else ""


@cache
def ahead_of(file: str) -> tuple[str, ...]:
    """The packages that a source file imports anywhere in it, as far as they are known, and those
    that these of this project import: they are read, and nothing of the file is run.
    """
    wanted: dict[str, None] = {}
    files = [file]
    while files:
        for name in _imported(files.pop()):
            if name.partition(".")[0] in _KNOWN and name not in wanted:
                wanted[name] = None
                if name.startswith("methods."):
                    files.append(_file_of(name))
    return tuple(wanted)


def _imported(file: str) -> list[str]:
    try:
        tree = ast.parse(Path(file).read_bytes())
    # Deep enough a file is more than the parser can take.
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return []
    names: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.append(node.module)
    return names


@contextmanager
def housed(
    tuned: Tuned,
    seed: int,
    isolation: str,
    hidden: tuple[str, ...] = (),
    memory: int = 0,
    state: Mapping[str, NDArray[Any]] | None = None,
) -> Iterator[SealedTuner]:
    """A tuner in its process, for one run or one training.

    Args:
        tuned: which one.
        seed: of the run.
        isolation: run: it is ended afterwards; tuner: it serves the next run of this tuner with
            this seed.
        hidden: folders that it must not reach.
        memory: MiB that it may take; 0 for no limit.
        state: what it has learned.

    Raises:
        EndedError: it cannot be built.
        KilledError: it was killed from outside.
    """
    kept = isolation == "tuner"
    # Weights are hashed only where a tuner may wait that has others.
    key = (repr(tuned), seed, hidden, memory, _digest(state or {})) if kept else None
    tuner = _waiting.pop(key, None)
    if tuner is not None:
        tuner.import_seconds = 0.0
    if tuner is None or not tuner.child.alive:
        house = nursery()
        house.load(
            [*tuned.modules, *([tuned.module] if tuned.module.startswith("methods.") else [])]
        )
        files = [tuned.file] if tuned.file else []
        child = house.start("bench.sealing.inside:serve", files, memory, hidden)
        try:
            tuner = SealedTuner(child, tuned, state)
        except BaseException:
            child.end()
            raise
    try:
        yield tuner
    except BaseException:
        tuner.child.end()
        raise
    if not kept:
        tuner.child.end()
    elif tuner.child.alive:
        _waiting[key] = tuner
        while len(_waiting) > _KEPT:
            _waiting.popitem(last=False)[1].child.end()


def _digest(state: Mapping[str, NDArray[Any]]) -> int:
    return hash(tuple((name, array.tobytes()) for name, array in state.items()))
