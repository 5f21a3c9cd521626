"""Spawn worker processes that do not import the user's script and are shielded from Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker, spawn
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any


class WorkerProcess(SpawnProcess):
    """Spawned process that skips the parent's main module and starts with interrupts blocked.

    A worker does not need the main module, because plugins are loaded from their files. With
    multiprocessing's default, a script without ``if __name__ == "__main__"`` would run again in
    each worker.

    Ctrl-C in a terminal reaches every process of the group. A process that is still importing would
    end with a traceback in the middle of the printed table. Interrupts are therefore blocked until
    the process calls `ignore_interrupts`.
    """

    def start(self) -> None:
        """Start the process."""
        # The resource tracker unblocks interrupts after it has started its own process, so it must
        # be running before they are blocked.
        resource_tracker.ensure_running()
        with _block_interrupts(), _leave_out_main_module():
            super().start()


class WorkerContext(SpawnContext):
    """Spawn context of multiprocessing with `WorkerProcess` as its process class."""

    Process = WorkerProcess


_MAIN_MODULE_KEYS = ("init_main_from_name", "init_main_from_path")
"""Keys of multiprocessing's preparation data that make a child import the main module."""
_preparing = threading.RLock()
"""Lock that protects the replacement of `spawn.get_preparation_data`."""


@contextmanager
def _leave_out_main_module() -> Iterator[None]:
    """Prevent processes that this thread spawns from importing the main module.

    multiprocessing has no option for this. The preparation data is made inside ``Popen._launch``,
    so the function that makes it is replaced for the calls of this thread.
    """
    with _preparing:
        original, thread = spawn.get_preparation_data, threading.get_ident()

        def without_main(name: str) -> dict[str, Any]:
            """Return multiprocessing's preparation data for a new process, without the main module.

            Other threads get the unchanged data, because they did not ask for this replacement.
            """
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
def _block_interrupts() -> Iterator[None]:
    """Block SIGINT in this thread; processes started in the block inherit the mask.

    Ctrl-C is sent to all processes of the terminal's group; workers must finish their runs.
    """
    if not hasattr(signal, "pthread_sigmask"):  # on Windows a new process is in no process group
        yield
        return
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)


def ignore_interrupts() -> None:
    """Ignore pending and future interrupts; the parent process handles them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        # Child processes inherit the signal mask, and may need to be interruptible.
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
