"""Run calls on a Dask cluster, each one in an isolated process on the worker's machine.

`runner.worker_pools` does the same on this machine. A worker of the cluster never runs a tuner
itself.
It has one isolated process and passes the call on, so that a tuner that hangs, dies or fills memory
fails its own run and does not stop the worker. If a worker is lost, its calls are sent to another
worker. Plugin files and trained weights are sent with the calls. Recordings and environment
variables (SIMGAP_DATA) must exist on the workers' machines.
"""

from __future__ import annotations

import hashlib
import logging
import multiprocessing
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from bench.benchmark.runner.plugin_inspection import Plugin
from bench.benchmark.runner.run_fingerprint import hash_package_versions, hash_source_folders
from bench.benchmark.runner.trained_weights import TrainingResult, get_weights_folder
from bench.benchmark.runner.tuner_training import train_or_load
from bench.benchmark.runner.worker_pools import Call, LocalPool, PoolLostError
from sims.core.files import get_first_line, write_atomically
from sims.core.simulator import InputError

_SCHEDULER_TIMEOUT_SECONDS = 20.0
"""Seconds without an answer after which the scheduler counts as lost."""
_QUEUED_CALLS_PER_THREAD = 3
"""Number of calls in progress per thread of the cluster.

It also limits the number of results that wait in this process.
"""
_WORKER_CHECK_ATTEMPTS = 3
"""Maximum number of attempts to compare the workers' code if workers are lost meanwhile."""
_MAX_LOST_WORKERS_PER_CALL = 20
"""Maximum number of workers that one call may lose before the pool is given up."""

FileContents = tuple[tuple[str, bytes], ...]
"""Names and contents of files."""
PluginContents = tuple[tuple[Plugin, bytes], ...]
"""Plugins and the contents of their files; the content is empty for an installed plugin."""
CONNECTION_TIMEOUT = 10.0
"""Time to wait for the scheduler's answer, s."""


@runtime_checkable
class Transferable(Protocol):
    """Argument of a call that refers to files, which must exist where the call is executed."""

    def list_files(self) -> Sequence[Path]:
        """Return the paths of the files, which must have different names."""
        ...

    def relocate(self, new_paths: Mapping[Path, Path]) -> Transferable:
        """Return a copy that refers to other paths.

        Args:
            new_paths: new path of each file by its present path.
        """
        ...


class ClusterPool:
    """Pool of the workers of a Dask cluster.

    Args:
        address: address of the scheduler, for example ``tcp://10.0.0.5:8786``.

    Raises:
        InputError: the package is not installed, no scheduler answers, or the workers have other
            code than this process.
    """

    def __init__(self, address: str) -> None:
        """Connect to the scheduler, and check that the workers have the code of this process.

        Args:
            address: Address of the Dask scheduler, such as "tcp://host:8786".
        """
        try:
            from distributed import Client
        except ImportError:
            raise InputError(
                'a cluster needs the package distributed (pip install -e ".[cluster]")'
            ) from None
        # Dask's own log messages are suppressed; this class reports lost workers in one line.
        for name in [*logging.root.manager.loggerDict, "asyncio"]:
            if name.split(".")[0] in ("distributed", "tornado", "asyncio"):
                # No message has a level above CRITICAL.
                logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        self.address = address
        try:
            self._client = Client(address, timeout=CONNECTION_TIMEOUT, set_as_default=False)
        # Dask asserts that the event loop of an earlier, failed client is still running.
        except (OSError, ValueError, TypeError, ImportError, AssertionError) as error:
            raise InputError(
                f"{address}: no Dask scheduler answers there ({get_first_line(error)})"
            ) from None
        self._plugins: PluginContents = ()
        self._sent_files: dict[Path, Any] = {}
        self._check_workers()

    def _check_workers(self) -> None:
        """Raise an error unless there are workers, all with the code and packages of this process.

        Other code could give other results, and the id of a run states the code of this process.

        Raises:
            InputError: there are no workers, or one has other code or package versions.
        """
        threads = self._client.nthreads()
        if not threads:
            raise InputError(
                f"{self.address}: has no workers; start some: dask worker {self.address}"
            )
        local_identity = (hash_source_folders(), hash_package_versions())
        try:
            identities = self._hash_workers()
        except Exception as error:  # any error of a worker that lacks our modules
            raise InputError(
                f"{self.address}: its workers lack simgap ({get_first_line(error)})"
            ) from None
        differing_workers = [
            worker for worker, answer in identities.items() if answer != local_identity
        ]
        if differing_workers:
            raise InputError(
                f"{self.address}: worker {differing_workers[0]} has other code or package versions "
                "than this process; install the same on both"
            )

    def _hash_workers(self) -> dict[str, Any]:
        """Return hashes of code and package versions by worker, which must equal those here.

        Lost workers are left out; if one is lost during the call, it is repeated a few times.

        Raises:
            Exception: a worker failed to compute them.
        """
        for _ in range(_WORKER_CHECK_ATTEMPTS):
            worker_answers: dict[str, Any] = self._client.run(_hash_this_worker, on_error="return")
            # A worker that is lost during the call gives no information about its code.
            if not any(isinstance(answer, OSError) for answer in worker_answers.values()):
                break
        answers = {
            worker: answer
            for worker, answer in worker_answers.items()
            if not isinstance(answer, OSError)
        }
        for answer in answers.values():
            if isinstance(answer, BaseException):
                raise answer
        return answers

    def load_plugins(self, plugins: Sequence[Plugin]) -> None:
        """Register plugins for the workers; must be called before the first call."""
        self._plugins = tuple((p, Path(p.path).read_bytes() if p.path else b"") for p in plugins)

    def __enter__(self) -> ClusterPool:
        return self

    def __exit__(self, *_: object) -> None:
        closing_thread = threading.Thread(
            target=self._client.close, kwargs={"timeout": 5}, daemon=True
        )
        closing_thread.start()  # in a thread, because closing waits long for a lost scheduler
        closing_thread.join(timeout=10)

    def iterate_results(self, calls: Sequence[Call], seconds: float) -> Iterator[tuple[int, Any]]:
        """Execute calls on the cluster, and iterate over their results in the order they end.

        A few calls for each thread are queued at a time. A call whose worker is lost is submitted
        again, because the loss gives no information about the call; if it loses too many workers,
        the pool is given up. See also `bench.benchmark.runner.worker_pools.LocalPool`.

        Args:
            calls: functions with their arguments.
            seconds: soft time limit of one call.

        Yields:
            Index of the call, and its result or exception.

        Raises:
            PoolLostError: the scheduler is lost; calls that have not ended are not executed.
        """
        from distributed import CancelledError, KilledWorker

        # Index of each submitted call by its future.
        waiting: dict[Any, int] = {}
        # Indices of the calls to be submitted; calls that are submitted again come first.
        pending = deque(range(len(calls)))
        # Number of workers that each call has lost, by index of the call.
        lost_workers: dict[int, int] = {}
        try:
            while True:
                thread_count = max(sum(self._client.nthreads().values()), 1)
                while pending and len(waiting) < _QUEUED_CALLS_PER_THREAD * thread_count:
                    index = pending.popleft()
                    waiting[self._submit_call(calls[index], seconds)] = index
                if not waiting:
                    return
                for future in self._wait_for_results(list(waiting)):
                    index = waiting.pop(future)
                    end_status = future.status
                    error = future.exception() if end_status in ("error", "cancelled") else None
                    killed = isinstance(error, KilledWorker | CancelledError)
                    # The loss of a worker gives no information about the call.
                    if killed or end_status in ("lost", "cancelled"):
                        lost_workers[index] = lost_workers.get(index, 0) + 1
                        if lost_workers[index] > _MAX_LOST_WORKERS_PER_CALL:
                            raise PoolLostError(
                                f"cluster {self.address}: lost {_MAX_LOST_WORKERS_PER_CALL} "
                                "workers on one run"
                            )
                        pending.appendleft(index)
                        continue
                    result = error if error is not None else self._receive_result(future.result())
                    # The cluster stores a result until its future is released.
                    future.release()
                    yield index, result
        except (OSError, TimeoutError, CancelledError) as error:
            raise PoolLostError(
                f"cluster {self.address}: the scheduler cannot be reached ({type(error).__name__})"
            ) from None

    def _wait_for_results(self, futures: list[Any]) -> list[Any]:
        """Wait until at least one future is done, and return all that are.

        It checks regularly whether the scheduler still answers.

        Args:
            futures: Futures of Dask that have not been returned yet.
        """
        from distributed import CancelledError, wait

        while True:
            try:
                with self._client.as_current():
                    wait(futures, timeout=2.0, return_when="FIRST_COMPLETED")
            # A cancelled future is done; its call is repeated if the scheduler is still running.
            except (TimeoutError, CancelledError):
                self._check_scheduler()
            if done_futures := [future for future in futures if future.done()]:
                self._check_scheduler()
                return done_futures

    def _check_scheduler(self) -> None:
        """Raise an error unless the scheduler answers within `_SCHEDULER_TIMEOUT_SECONDS`."""
        if self._client.status != "running":
            raise OSError(f"connection {self._client.status}")
        self._client.sync(
            self._client.scheduler.identity, callback_timeout=_SCHEDULER_TIMEOUT_SECONDS
        )

    def _submit_call(self, call: Call, seconds: float) -> Any:
        """Submit one call to the cluster, and return its future.

        The files that its arguments refer to are sent with it. The workers may have no common file
        system, so the content of files such as trained weights is sent.

        Args:
            call: function with its arguments.
            seconds: soft time limit of the call.

        Returns:
            Future of Dask for the result of `run_on_worker`.
        """
        function, arguments = call
        transferable = [argument for argument in arguments if isinstance(argument, Transferable)]
        paths = [path for argument in transferable for path in argument.list_files()]
        contents = [self._send_file(path) for path in paths]
        # `pure=False`: Dask must not return the result of an earlier, equal call.
        return self._client.submit(
            run_on_worker, function, arguments, seconds, self._plugins, paths, contents, pure=False
        )

    def _send_file(self, path: Path) -> Any:
        """Send name and content of a file to the cluster, once for all calls.

        It is stored as the result of a task: scattered data would be lost with the worker that
        stores them, whereas a task is executed again.

        Args:
            path: Local file.

        Returns:
            Future of its name and content, which tasks take as an argument.
        """
        if path not in self._sent_files:
            content = (path.name, path.read_bytes())
            self._sent_files[path] = self._client.submit(_return_content, content, pure=False)
        return self._sent_files[path]

    def _receive_result(self, result: Any) -> Any:
        """Return the value of a worker's result; trained weights are written to the local cache.

        Args:
            result: kind, value and content of a file, from `run_on_worker`.

        Returns:
            The value; for a training with the path of the weights on this machine.
        """
        kind, value, content = result
        if kind == "weights":
            path = get_weights_folder() / value.path.name
            _write_if_absent(path, content)
            return replace(value, path=path)
        return value


def _write_if_absent(path: Path, content: bytes) -> None:
    """Write a file atomically if it does not exist."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, content)


def _return_content(content: tuple[str, bytes]) -> tuple[str, bytes]:
    return content


def _hash_this_worker() -> tuple[str, str]:
    """Return hashes of a worker's code and package versions."""
    return hash_source_folders(), hash_package_versions()


_pools: dict[tuple[int, str], LocalPool] = {}
"""Pool of one process for each thread of this worker and each set of plugins."""


def run_on_worker(
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
    seconds: float,
    plugins: PluginContents,
    paths: Sequence[Path],
    contents: Sequence[tuple[str, bytes]],
) -> tuple[str, Any, bytes]:
    """Execute a call in an isolated process of this machine; runs on a worker of the cluster.

    The files that the call needs were sent with it. They are written into a folder here, and their
    paths in the arguments are replaced. Each thread of the worker has one process, which stays for
    the next calls with the same plugins.

    Args:
        function: function to call.
        arguments: arguments of the call; paths in them refer to the client's machine.
        seconds: soft time limit of the call.
        plugins: plugins that the process loads or registers, and the contents of their files.
        paths: paths of the files on the client's machine.
        contents: names and contents of these files, in the same order.

    Returns:
        Kind, value and content. The kind is "value" for the result of the call or the error that
        ended it, with empty content; or "weights" for a training, with the content of its file,
        which the client cannot read from this machine.
    """
    if paths:
        # All files are in one folder, because a recording's description must be next to its table.
        folder_here = _write_hashed_folder(tuple(contents))
        new_paths = {
            path: folder_here / name for path, (name, _) in zip(paths, contents, strict=True)
        }
        arguments = tuple(
            argument.relocate(new_paths) if isinstance(argument, Transferable) else argument
            for argument in arguments
        )
    key = (threading.get_ident(), repr(plugins))
    if key not in _pools:
        # Dask's workers are daemonic processes, which may not have children because these could
        # outlive them. The processes of this pool end with their parent.
        multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
        _pools[key] = LocalPool(1)
        # Each plugin has its own folder, so that its path does not depend on other plugins.
        _pools[key].load_plugins(
            [_write_plugin_file(plugin, content) for plugin, content in plugins]
        )
    # One call gives exactly one pair of index and result.
    ((_, result),) = _pools[key].iterate_results([(function, arguments)], seconds)
    if function is train_or_load and isinstance(result, TrainingResult):
        return "weights", result, result.path.read_bytes()
    return "value", result, b""


def _write_plugin_file(plugin: Plugin, content: bytes) -> Plugin:
    """Write a plugin file with this content on this worker's machine.

    Returns the plugin with the path of the new file; a plugin without a file is returned unchanged.
    """
    if not plugin.path:
        return plugin
    name = Path(plugin.path).name
    return replace(plugin, path=str(_write_hashed_folder(((name, content),)) / name))


def _write_hashed_folder(files: FileContents) -> Path:
    """Write files into a folder of this machine that is named by their hash; return the folder.

    Equal files give the same folder, so that each worker writes them only once.
    """
    hashed = hashlib.sha256()
    for name, content in files:
        hashed.update(name.encode() + hashlib.sha256(content).digest())
    folder = Path(tempfile.gettempdir()) / f"simgap-{hashed.hexdigest()[:16]}"
    for name, content in files:
        _write_if_absent(folder / name, content)
    return folder
