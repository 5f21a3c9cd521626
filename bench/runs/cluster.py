"""Makes runs on a Dask cluster: each in a process of its own on the worker's machine, as
`bench.runs.pools` makes them here.

A cluster's worker is never asked to run a method itself: it keeps one isolated process and hands
the run on, so that a method that hangs, dies or fills memory costs its own run and no worker. A
worker that is lost costs nothing: what it was at is sent to another. Plugin files and trained
weights travel with the calls; recordings and environment variables (SIMGAP_DATA) must be there on
the workers' machines.
"""

from __future__ import annotations

import hashlib
import logging
import multiprocessing
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from bench.runs.pools import Call, LocalPool, LostError
from bench.runs.sources import rooms, versions
from bench.runs.survey import Plugin
from bench.runs.training import Training, folder, train
from sims.base import InputError
from sims.files import first_line, write

_PATIENCE = 20.0
"""Seconds without a scheduler after which it counts as lost."""
_AHEAD = 3
"""Calls for each thread of the cluster that are under way; so many results wait here at most."""
_ASKED = 3
"""How often workers are asked for their code where some are lost meanwhile."""
_LOSSES = 20
"""Workers that one call may lose before the cluster is taken to be the cause."""

Files = tuple[tuple[str, bytes], ...]
"""Name and content of files."""
Luggage = tuple[tuple[Plugin, bytes], ...]
"""Plugins and the contents of their files; of an installed one there is none."""


@runtime_checkable
class Travelling(Protocol):
    """An argument of a call that names files, which must be there where the call is made."""

    def files(self) -> Sequence[Path]:
        """The files, of different names."""
        ...

    def moved(self, places: Mapping[Path, Path]) -> Travelling:
        """The argument where its files have other places."""
        ...


class ClusterPool:
    """The cluster with the scheduler at `address`, e.g. ``tcp://10.0.0.5:8786``.

    Raises:
        InputError: the package is not installed, nobody answers, or the workers have other code
            than this process.
    """

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise InputError(
                'a cluster needs the package distributed (pip install -e ".[cluster]")'
            ) from None
        # What is lost is said here, in one line.
        for name in [*logging.root.manager.loggerDict, "asyncio"]:
            if name.split(".")[0] in ("distributed", "tornado", "asyncio"):
                logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        self.address = address
        try:
            self._client = Client(address, timeout=10.0, set_as_default=False)
        # Dask asserts that the event loop of an earlier, failed client is still running.
        except (OSError, ValueError, TypeError, ImportError, AssertionError) as error:
            raise InputError(
                f"{address}: no Dask scheduler answers there ({first_line(error)})"
            ) from None
        self._plugins: Luggage = ()
        self._sent_files: dict[Path, Any] = {}
        self._check()

    def _check(self) -> None:
        threads = self._client.nthreads()
        if not threads:
            raise InputError(
                f"{self.address}: has no workers; start some: dask worker {self.address}"
            )
        here = (rooms(), versions())
        try:
            there = self._identities()
        except Exception as error:  # whatever a worker without our modules makes of the call
            raise InputError(
                f"{self.address}: its workers lack simgap ({first_line(error)})"
            ) from None
        others = [worker for worker, answer in there.items() if answer != here]
        if others:
            raise InputError(
                f"{self.address}: worker {others[0]} has other code or package versions than this "
                "process; install the same on both"
            )

    def _identities(self) -> dict[str, Any]:
        """What each worker says of its code.

        Raises:
            Exception: one could not say anything.
        """
        for _ in range(_ASKED):
            there: dict[str, Any] = self._client.run(_identity, on_error="return")
            # A worker that is lost while it is asked says nothing about its code.
            if not any(isinstance(answer, OSError) for answer in there.values()):
                break
        answers = {w: answer for w, answer in there.items() if not isinstance(answer, OSError)}
        for answer in answers.values():
            if isinstance(answer, BaseException):
                raise answer
        return answers

    def load(self, plugins: Sequence[Plugin]) -> None:
        """Make these plugins known to the workers; before the first call."""
        self._plugins = tuple((p, Path(p.path).read_bytes() if p.path else b"") for p in plugins)

    def __enter__(self) -> ClusterPool:
        return self

    def __exit__(self, *_: object) -> None:
        closing = threading.Thread(target=self._client.close, kwargs={"timeout": 5}, daemon=True)
        closing.start()  # in a thread: closing waits long for a scheduler that is gone
        closing.join(timeout=10)

    def results(self, calls: Sequence[Call], seconds: float) -> Iterator[tuple[int, Any]]:
        """Place and result (or exception) of each call, as they end; see
        `bench.runs.pools.LocalPool`.

        Raises:
            LostError: the scheduler is gone; what had no end by then is not made.
        """
        from distributed import CancelledError, KilledWorker

        waiting: dict[Any, int] = {}
        # How many workers each call has lost, and the calls that are to be made again.
        losses: dict[int, int] = {}
        following = iter(range(len(calls)))
        again: list[int] = []
        try:
            while True:
                ahead = _AHEAD * max(sum(self._client.nthreads().values()), 1)
                while (
                    len(waiting) < ahead
                    and (place := again.pop() if again else next(following, None)) is not None
                ):
                    waiting[self._submit(calls[place], seconds)] = place
                if not waiting:
                    return
                for future in self._done(list(waiting)):
                    place = waiting.pop(future)
                    ended = future.status
                    error = future.exception() if ended in ("error", "cancelled") else None
                    killed = isinstance(error, KilledWorker | CancelledError)
                    # A worker that is lost says nothing about the call it was at.
                    if killed or ended in ("lost", "cancelled"):
                        losses[place] = losses.get(place, 0) + 1
                        if losses[place] > _LOSSES:
                            raise LostError(
                                f"cluster {self.address}: lost {_LOSSES} workers on one run"
                            )
                        again.append(place)
                        continue
                    result = error if error is not None else self._received(future.result())
                    # Results stay on the cluster for as long as somebody holds their future.
                    future.release()
                    yield place, result
        except (OSError, TimeoutError, CancelledError) as error:
            raise LostError(
                f"cluster {self.address}: the scheduler is gone ({type(error).__name__})"
            ) from None

    def _done(self, futures: list[Any]) -> list[Any]:
        """The futures that are done, at least one of them; asks now and then whether the scheduler
        is still there.
        """
        from distributed import CancelledError, wait

        while True:
            try:
                with self._client.as_current():
                    wait(futures, timeout=2.0, return_when="FIRST_COMPLETED")
            # A cancelled one is done, and made again if the scheduler lives.
            except (TimeoutError, CancelledError):
                self._there()
            if done := [future for future in futures if future.done()]:
                self._there()
                return done

    def _there(self) -> None:
        """Raise unless the scheduler answers within a while."""
        if self._client.status != "running":
            raise OSError(f"connection {self._client.status}")
        self._client.sync(self._client.scheduler.identity, callback_timeout=_PATIENCE)

    def _submit(self, call: Call, seconds: float) -> Any:
        function, arguments = call
        travelling = [argument for argument in arguments if isinstance(argument, Travelling)]
        paths = [path for argument in travelling for path in argument.files()]
        contents = [self._sent(path) for path in paths]
        return self._client.submit(
            on_worker, function, arguments, seconds, self._plugins, paths, contents, pure=False
        )

    def _sent(self, path: Path) -> Any:
        """The name and content of a file, held by the cluster once, whoever needs it.

        A task gives it, since scattered data are gone with the worker that held them, and a task is
        made again.
        """
        if path not in self._sent_files:
            content = (path.name, path.read_bytes())
            self._sent_files[path] = self._client.submit(_itself, content, pure=False)
        return self._sent_files[path]

    def _received(self, result: Any) -> Any:
        """What a worker sent; trained weights are put into this machine's cache."""
        kind, value, content = result
        if kind == "weights":
            path = folder() / value.path.name
            _keep(path, content)
            return replace(value, path=path)
        return value


def _keep(path: Path, content: bytes) -> None:
    """Write a file that is not there yet, whole or not at all."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path, content)


def _itself(content: tuple[str, bytes]) -> tuple[str, bytes]:
    return content


def _identity() -> tuple[str, str]:
    """Hashes of the code and the package versions of a worker."""
    return rooms(), versions()


_pools: dict[tuple[int, str], LocalPool] = {}


def on_worker(
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
    seconds: float,
    plugins: Luggage,
    paths: Sequence[Path],
    contents: Sequence[tuple[str, bytes]],
) -> tuple[str, Any, bytes]:
    """Runs on a cluster's worker: makes the call in an isolated process of this machine.

    Args:
        function: what to call.
        arguments: of the call; files that they name lie on the machine that asks.
        seconds: soft limit of the call.
        plugins: that the process loads or knows of, and their files' contents.
        paths: places of the files there.
        contents: their names and contents, in the same order.

    Returns:
        What the call gave ("value") or the error that ended it, or a training and the content of
        its file ("weights").
    """
    if paths:
        # In one folder: a recording's description is looked for beside its table.
        folder_here = _unpacked(tuple(contents))
        places = {path: folder_here / name for path, (name, _) in zip(paths, contents, strict=True)}
        arguments = tuple(
            argument.moved(places) if isinstance(argument, Travelling) else argument
            for argument in arguments
        )
    key = (threading.get_ident(), repr(plugins))
    if key not in _pools:
        # Dask's workers are daemons, which may not have children for fear that these outlive them;
        # ours do not.
        multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
        _pools[key] = LocalPool(1)
        # Each in a folder of its own, so that a file is the same whatever else there is.
        _pools[key].load([_here(plugin, content) for plugin, content in plugins])
    ((_, result),) = _pools[key].results([(function, arguments)], seconds)
    if function is train and isinstance(result, Training):
        return "weights", result, result.path.read_bytes()
    return "value", result, b""


def _here(plugin: Plugin, content: bytes) -> Plugin:
    """The plugin with its file on this machine."""
    if not plugin.path:
        return plugin
    name = Path(plugin.path).name
    return replace(plugin, path=str(_unpacked(((name, content),)) / name))


def _unpacked(files: Files) -> Path:
    """A folder on this machine that holds these files under their own names."""
    hashed = hashlib.sha256()
    for name, content in files:
        hashed.update(name.encode() + hashlib.sha256(content).digest())
    place = Path(tempfile.gettempdir()) / f"simgap-{hashed.hexdigest()[:16]}"
    for name, content in files:
        _keep(place / name, content)
    return place
