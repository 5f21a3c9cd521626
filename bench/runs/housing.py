"""Start and reuse the isolated tuner processes of this process, with one fork server."""

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
"""Packages that may be imported before a run: simgap's own and those that it requires.

Other packages that a plugin imports are imported anew in each run, because they could store
information from an earlier run.
"""
_KEPT = 8
"""Maximum number of idle tuners that wait for another run."""

RETRIES = 3
"""Maximum number of attempts at work whose processes are killed externally.

An external kill gives no information about the work itself.
"""

_houses: dict[int, Nursery] = {}
_waiting: OrderedDict[Any, SealedTuner] = OrderedDict()


def nursery() -> Nursery:
    """Return the fork server of this process; it is started at the first call."""
    held = _houses.get(0)
    if held is None or not held.alive:
        # A fork server that was killed externally is closed too, because its folder still exists.
        close()
        held = _houses[0] = Nursery()
    return held


@cache
def seals() -> tuple[str, ...]:
    """Return the active isolation layers of tuner processes here; see `bench.sealing.seals`.

    Raises:
        InputError: no isolated process can be started.
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
    """End all tuner processes of this process, and its fork server."""
    _waiting.clear()
    for house in _houses.values():
        house.close()
    _houses.clear()


def undisturbed(work: Callable[[], Result]) -> Result:
    """Call a function, again if one of its processes was killed externally.

    Args:
        work: function without arguments.

    Returns:
        The result of the function.

    Raises:
        EndedError: processes were killed in each of `RETRIES` attempts.
    """
    for _ in range(RETRIES):
        try:
            return work()
        except KilledError as killed:
            said = str(killed)
    # After several kills the work itself is the more likely cause.
    raise EndedError("crashed", f"{said}, {RETRIES} times")


def tuned_of(entry: Entry) -> Tuned:
    """Return the specification of the tuner of an entry, for an isolated process."""
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
    """Return the known packages that a source file imports, directly or through simgap's tuners.

    The files are parsed; their code does not run.
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
    # A deeply nested file can exceed the limits of the parser.
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
    """Start an isolated tuner for one run or one training, or reuse an idle one.

    Args:
        tuned: specification of the tuner.
        seed: seed of the run.
        isolation: ``run``: the process is ended afterwards; ``tuner``: it serves the next run of
            this tuner with this seed.
        hidden: folders that the process must not access.
        memory: memory limit in MiB; 0 for no limit.
        state: trained weights.

    Yields:
        The isolated tuner.

    Raises:
        EndedError: the tuner cannot be built.
        KilledError: the process was killed externally.
    """
    kept = isolation == "tuner"
    # Weights are hashed only if an idle tuner could have different ones.
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
