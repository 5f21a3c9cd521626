"""Start the isolated processes of tuners and diagnosers with one fork server; reuse idle ones."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import Any

from numpy.typing import NDArray

from bench.benchmark.isolation.fork_server_client import ForkServerClient
from bench.benchmark.isolation.process_errors import RunEndedError
from bench.benchmark.isolation.tuner_processes import IsolatedProcess, IsolatedTuner, TunerSpec
from bench.benchmark.problem.experiment_config import TunerEntry
from bench.benchmark.runner.preloadable_packages import find_preloadable_packages, find_source_file
from bench.benchmark.runner.retry_after_kill import retry_if_killed
from bench.core.plugin_registries import Registry, tuners
from sims.core.simulator import InputError

_MAX_WAITING_TUNERS = 8
"""Maximum number of idle tuners that wait for another run."""

_fork_servers: dict[int, ForkServerClient] = {}
"""Fork server of this process, under the key 0; empty before the first use."""
_idle_tuners: OrderedDict[Any, IsolatedTuner] = OrderedDict()
"""Isolated tuners that wait for another run, the one that has waited longest first."""


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
    # A part of an installed package has no plugin file.
    part_class, plugin_file = registry.get(name), registry.place(name)
    # The class here may be a stub, whose attribute `module` names the module with the code.
    module = getattr(part_class, "module", "") or part_class.__module__
    source_file = str(plugin_file) if plugin_file else find_source_file(module)
    return TunerSpec(
        part_class.name,
        module,
        str(plugin_file or ""),
        dict(options or {}),
        find_preloadable_packages(source_file),
    )


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
    # The project's own code may be loaded in advance, that of a plugin never.
    is_builtin = not part.file and part.module.startswith(("bench.", "methods."))
    own_module = [part.module] if is_builtin else []
    return get_fork_server().start_process(
        service,
        [part.file] if part.file else [],
        memory,
        hidden,
        [*modules, *part.modules, *own_module],
    )


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
    # Weights are hashed only if an idle tuner could have different ones. No idle tuner has the key
    # None.
    key = (repr(tuned), seed, hidden, memory, _hash_state(state or {})) if is_reused else None
    tuner = _idle_tuners.pop(key, None)
    if tuner is not None:
        # Its imports were counted in the run that started it.
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
    # The run may have ended the process, for example after a failure.
    elif tuner.child.is_alive:
        _idle_tuners[key] = tuner
        while len(_idle_tuners) > _MAX_WAITING_TUNERS:
            _idle_tuners.popitem(last=False)[1].child.end()


def _hash_state(state: Mapping[str, NDArray[Any]]) -> int:
    return hash(tuple((name, array.tobytes()) for name, array in state.items()))
