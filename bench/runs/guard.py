"""What a worker process sets up for itself, so that nothing done in it reaches beyond it."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from sims.base import InputError


def initialise(plugins: Sequence[str], births: Any) -> None:
    """Prepare a worker: interrupts are the parent's to handle, output goes nowhere, no worker
    outlives its parent.

    Args:
        plugins: plugin files to load.
        births: where the worker tells that it is there.
    """
    # A terminal's Ctrl-C reaches every process of the group; the parent alone answers it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # First of all that may fail: a birth that nobody hears of would look like a worker at work.
    births.send(os.getpid())
    threading.Thread(target=_end_with_parent, daemon=True, name="end-with-parent").start()
    from bench.registry import load_plugins

    load_plugins(plugins)
    _silence()


def _silence() -> None:
    """Send what is printed to nowhere: a tuner that prints would spoil the table or fill a disk."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    # The descriptors and not `sys.stdout`: libraries in C write there too.
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    os.close(nowhere)


def _end_with_parent() -> None:
    """End this process when the one that started it is gone, even if a run is hanging."""
    from multiprocessing import connection, parent_process

    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        # Not sys.exit, which would end this thread and leave the run hanging.
        os._exit(1)


@contextmanager
def memory_limit(mebibytes: int) -> Iterator[None]:
    """Within the block this process may take so much memory more than it has; 0 is no limit.

    What is asked for beyond it fails (`MemoryError`). Linux counts private writable memory
    (RLIMIT_DATA), so that mapped files and libraries are free.

    Raises:
        InputError: this system has no such limit.
    """
    if not mebibytes:
        yield
        return
    resource = limits()
    before = resource.getrlimit(resource.RLIMIT_DATA)
    # Beyond what the process has: how large that is depends on the packages it has loaded.
    wanted = _data_bytes() + mebibytes * 2**20
    soft = wanted if before[1] == resource.RLIM_INFINITY else min(wanted, before[1])
    resource.setrlimit(resource.RLIMIT_DATA, (soft, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def limits() -> Any:
    """The module `resource` of a system that limits memory.

    Raises:
        InputError: it does not.
    """
    if not sys.platform.startswith("linux"):
        raise InputError(f"memory: a limit needs Linux, this is {sys.platform}; leave it out")
    import resource

    return resource


def _data_bytes() -> int:
    """Private writable memory of this process, as RLIMIT_DATA counts it."""
    with open("/proc/self/status", encoding="ascii") as lines:
        for line in lines:
            if line.startswith("VmData:"):
                return int(line.split()[1]) * 1024
    return 0
