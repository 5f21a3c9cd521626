"""Start worker processes that import no user script, ignore Ctrl-C, and use one thread.

Processes share the cores, and sums are reproducible with one thread.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker, spawn
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import TYPE_CHECKING, Any

from bench.benchmark.isolation.linux_syscalls import set_not_dumpable

if TYPE_CHECKING:
    from bench.benchmark.runner.plugin_discovery import Plugin


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


def initialise_worker(plugins: Sequence[Plugin], start_sender: Any) -> None:
    """Initialise a worker process.

    It ignores interrupts, discards its output, ends with its parent, and protects its memory from
    other processes.

    Args:
        plugins: plugins to load or to register.
        start_sender: connection on which the worker reports that it has started.
    """
    # Ctrl-C in a terminal reaches every process of the group; only the parent handles it.
    ignore_interrupts()
    # This comes before everything that may fail: an unreported start would look like a busy worker.
    start_sender.send(os.getpid())
    threading.Thread(target=_end_with_parent, daemon=True, name="end-with-parent").start()
    set_not_dumpable()
    from bench.benchmark.runner.plugin_discovery import register_plugins

    register_plugins(plugins)
    _discard_output()


def _discard_output() -> None:
    """Discard all output: a tuner that prints would disturb the table or fill a disk."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    # The file descriptors are replaced, because C libraries do not use `sys.stdout`.
    null_device = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null_device, 1)
    os.dup2(null_device, 2)
    os.close(null_device)


def _end_with_parent() -> None:
    """End this process when its parent ends, even if a run hangs."""
    from multiprocessing import connection, parent_process

    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        # `sys.exit` would end this thread only.
        os._exit(1)


THREAD_COUNT_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that set the number of threads of numerical libraries."""


@contextmanager
def limit_to_one_thread() -> Iterator[None]:
    """Limit numerical libraries to one thread within the block, as in a worker."""
    from threadpoolctl import threadpool_limits

    # The variables are for libraries loaded within the block; threadpoolctl limits loaded ones.
    for name in THREAD_COUNT_VARIABLES:
        os.environ.setdefault(name, "1")
    with threadpool_limits(limits=1):
        yield
