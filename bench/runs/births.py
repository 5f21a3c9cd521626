"""Worker processes in fresh interpreters: they do not import the user's script, and no Ctrl-C
reaches them before they have said that it is the parent's to answer.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker, spawn
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any


class WorkerProcess(SpawnProcess):
    """A spawned process that does not import the parent's main module, and that starts with
    interrupts held back until it calls `ignore_interrupts`.

    A worker needs nothing of the main module: plugins are loaded by their files. Without this,
    multiprocessing would run a script that has no ``if __name__ == "__main__"`` again in each
    worker.

    A terminal's Ctrl-C reaches every process of the group. A process that is still importing would
    end with a traceback in the midst of the table.
    """

    def start(self) -> None:
        """Start it."""
        # The resource tracker lets interrupts through again once it has started its own process,
        # so it must be running before they are held back.
        resource_tracker.ensure_running()
        with _interrupts_held_back(), _main_module_left_out():
            super().start()


class WorkerContext(SpawnContext):
    """multiprocessing's spawn context with `WorkerProcess` as its process."""

    Process = WorkerProcess


_MAIN_MODULE_KEYS = ("init_main_from_name", "init_main_from_path")
"""Keys of multiprocessing's preparation data that make a child import the main module."""
_preparing = threading.RLock()
"""Held while `spawn.get_preparation_data` is replaced."""


@contextmanager
def _main_module_left_out() -> Iterator[None]:
    """Within the block, processes that this thread spawns do not import the main module.

    multiprocessing has no option for this. The preparation data is made inside ``Popen._launch``,
    so the function that makes it is replaced for the calls of this thread.
    """
    with _preparing:
        original, thread = spawn.get_preparation_data, threading.get_ident()

        def without_main(name: str) -> dict[str, Any]:
            data: dict[str, Any] = original(name)
            if threading.get_ident() == thread:
                for key in _MAIN_MODULE_KEYS:
                    data.pop(key, None)
            return data

        spawn.get_preparation_data = without_main
        try:
            yield
        finally:
            spawn.get_preparation_data = original


@contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Within the block SIGINT waits for this thread; what it starts inherits that."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows, where a new process is of no group
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def ignore_interrupts() -> None:
    """Leave interrupts to the parent: those that waited, and all that come."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        # What this process starts inherits the mask, and may well want to be interrupted.
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
