"""Start and reuse the isolated tuner processes of this process, with one fork server."""

from __future__ import annotations

import ast
import importlib.util
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from numpy.typing import NDArray

from bench.benchmark.isolation.isolation_layers import KilledExternallyError, RunEndedError
from bench.benchmark.isolation.tuner_processes import (
    ForkServerClient,
    IsolatedProcess,
    IsolatedTuner,
    TunerSpec,
)
from bench.benchmark.problem.experiment import TunerEntry
from bench.core.plugin_registries import Registry, tuners
from sims.core.simulator import InputError

Result = TypeVar("Result")

_PRELOADABLE_PACKAGES = (
    "bench", "botorch", "cma", "gpytorch", "linear_operator", "methods", "nlopt", "numpy", "pandas",
    "pysindy", "sbi", "scipy", "sims", "skopt", "sklearn", "statsmodels", "torch",
)  # fmt: skip
"""Packages that may be imported before a run: simgap's own and those that it requires.

Other packages that a plugin imports are imported anew in each run, because they could store
information from an earlier run.
"""
_MAX_WAITING_TUNERS = 8
"""Maximum number of idle tuners that wait for another run."""

MAX_RETRIES = 3
"""Maximum number of attempts at work whose processes are killed externally.

An external kill gives no information about the work itself.
"""

NOT_REPRODUCIBLE_REASON = "it was killed, and the repeated training requested other simulations"
"""Reason of a training or run that cannot be repeated."""

_fork_servers: dict[int, ForkServerClient] = {}
_idle_tuners: OrderedDict[Any, IsolatedTuner] = OrderedDict()


def get_fork_server() -> ForkServerClient:
    """Return the fork server of this process; it is started at the first call."""
    server = _fork_servers.get(0)
    if server is None or not server.is_alive:
        # A fork server that was killed externally is closed too, because its folder still exists.
        close_isolated_processes()
        server = _fork_servers[0] = ForkServerClient()
    return server


@cache
def list_active_isolation_layers() -> tuple[str, ...]:
    """Return the active isolation layers of tuner processes here; see `isolation.isolation_layers`.

    Raises:
        InputError: no isolated process can be started.
    """
    try:
        return retry_if_killed(_find_active_layers)
    except RunEndedError as ended:
        raise InputError(
            f"tuners cannot run in a process of their own here: {ended}; repair that, or use "
            "--trust for tuners that you trust"
        ) from None


def _find_active_layers() -> tuple[str, ...]:
    """Start an isolated process, and return the names of the isolation layers that it has applied.

    The process is used for nothing else: only a real start shows what the kernel permits.
    """
    child = get_fork_server().start_process("bench.benchmark.isolation.tuner_server:serve_requests")
    try:
        child.wait_until_ready()
        return tuple(child.seals)
    finally:
        child.end()


def close_isolated_processes() -> None:
    """End the idle tuner processes that this process keeps for reuse, and its fork servers."""
    while _idle_tuners:
        _idle_tuners.popitem()[1].child.end()
    while _fork_servers:
        _fork_servers.popitem()[1].close()


def retry_if_killed(work: Callable[[], Result]) -> Result:
    """Call a function, again if one of its processes was killed externally.

    Args:
        work: function without arguments.

    Returns:
        The result of the function.

    Raises:
        RunEndedError: processes were killed in each of `MAX_RETRIES` attempts.
    """
    for _ in range(MAX_RETRIES):
        try:
            return work()
        except KilledExternallyError as killed:
            message = str(killed)
    # After several kills the work itself is the more likely cause.
    raise RunEndedError("crashed", f"{message}, {MAX_RETRIES} times")


class RepeatedRequests:
    """Requests of work that is repeated if its process is killed externally.

    The repeated work must make the same requests. Otherwise a tuner that causes its own kill could
    repeat its run until the result is good.
    """

    def __init__(self) -> None:
        self._earlier: list[bytes] = []
        self._place = 0

    def restart(self) -> None:
        """Begin the work, or begin it again."""
        self._place = 0

    def check(self, request: bytes) -> None:
        """Store a new request, or compare it with the one before the kill.

        Raises:
            RunEndedError: it differs from the one before the kill.
        """
        if self._place == len(self._earlier):
            self._earlier.append(request)
        elif self._earlier[self._place] != request:
            raise RunEndedError("crashed", NOT_REPRODUCIBLE_REASON)
        self._place += 1


def make_tuner_spec(entry: TunerEntry) -> TunerSpec:
    """Return where the code of a tuner is, and what its isolated process preloads."""
    return make_part_spec(tuners, entry.tuner, entry.options)


def make_part_spec(
    registry: Registry[Any], name: str, options: Mapping[str, Any] | None = None
) -> TunerSpec:
    """Return where the code of a tuner or diagnoser is, and what its isolated process preloads.

    The code is not imported here. Without preloading, the packages that it imports would be
    imported again for each run.

    Args:
        registry: registry of the part.
        name: registered name.
        options: options with which it is built.
    """
    kind, file = registry.get(name), registry.place(name)
    module = getattr(kind, "module", "") or kind.__module__
    preloaded = (
        find_preloadable_packages(str(file) if file else _find_source_file(module))
        if file or module
        else ()
    )
    return TunerSpec(kind.name, module, str(file or ""), dict(options or {}), preloaded)


def start_part_process(
    part: TunerSpec,
    service: str,
    memory: int = 0,
    hidden: tuple[str, ...] = (),
    modules: Iterable[str] = (),
) -> IsolatedProcess:
    """Start an isolated process that can load a tuner or diagnoser.

    Args:
        part: specification of the part.
        service: module and function that the process runs, see `ForkServerClient.start_process`.
        memory: memory limit in MiB; 0 for no limit.
        hidden: folders that the process must not access.
        modules: modules that the fork server loads first, in addition to those of the part.
    """
    is_builtin = not part.file and part.module.startswith(("bench.", "methods."))
    own_module = [part.module] if is_builtin else []
    return get_fork_server().start_process(
        service,
        [part.file] if part.file else [],
        memory,
        hidden,
        [*modules, *part.modules, *own_module],
    )


def _find_source_file(module: str) -> str:
    """Return the source file of a module of a package that the fork server may import in advance.

    Empty for modules of other packages, such as plugins: locating them could execute their code.
    """
    top = module.partition(".")[0]
    if top not in _PRELOADABLE_PACKAGES:
        return ""
    spec = importlib.util.find_spec(module)
    return (spec.origin or "") if spec else ""


@cache
def find_preloadable_packages(file: str) -> tuple[str, ...]:
    """Return the known packages that a source file imports, directly or through simgap's tuners.

    The fork server imports them once, so that not every run has to. The files are only parsed;
    code of a plugin must not run here.
    """
    packages: dict[str, None] = {}
    files = [file]
    while files:
        for name in _list_imported_modules(files.pop()):
            if name.partition(".")[0] in _PRELOADABLE_PACKAGES and name not in packages:
                packages[name] = None
                if name.startswith("methods."):
                    files.append(_find_source_file(name))
    return tuple(packages)


def _list_imported_modules(file: str) -> list[str]:
    """List the modules that a source file imports anywhere, without executing it.

    Relative imports are left out. A file that cannot be read or parsed gives an empty list; its
    error is reported when the tuner is built.
    """
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
def start_isolated_tuner(
    tuned: TunerSpec,
    seed: int,
    isolation: str,
    hidden: tuple[str, ...] = (),
    memory: int = 0,
    state: Mapping[str, NDArray[Any]] | None = None,
) -> Iterator[IsolatedTuner]:
    """Start an isolated tuner for one run or one training, or reuse an idle one.

    A process that failed, or that serves one run only, is ended afterwards; others wait for the
    next run of the same tuner, seed, memory limit and weights. If too many wait, the one that has
    waited longest is ended.

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
        RunEndedError: the tuner cannot be built.
        KilledExternallyError: the process was killed externally.
    """
    is_reused = isolation == "tuner"
    # Weights are hashed only if an idle tuner could have different ones.
    key = (repr(tuned), seed, hidden, memory, _hash_state(state or {})) if is_reused else None
    tuner = _idle_tuners.pop(key, None)
    if tuner is not None:
        tuner.import_seconds = 0.0
    if tuner is None or not tuner.child.is_alive:
        child = start_part_process(
            tuned, "bench.benchmark.isolation.tuner_server:serve_requests", memory, hidden
        )
        try:
            tuner = IsolatedTuner(child, tuned, state)
        except BaseException:
            child.end()
            raise
    try:
        yield tuner
    except BaseException:
        tuner.child.end()
        raise
    if not is_reused:
        tuner.child.end()
    elif tuner.child.is_alive:
        _idle_tuners[key] = tuner
        while len(_idle_tuners) > _MAX_WAITING_TUNERS:
            _idle_tuners.popitem(last=False)[1].child.end()


def _hash_state(state: Mapping[str, NDArray[Any]]) -> int:
    return hash(tuple((name, array.tobytes()) for name, array in state.items()))
