"""Set up a worker process so that it cannot affect the terminal or outlive its parent."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from bench.runs.births import ignore_interrupts
from bench.sealing.kernel import hide_memory

if TYPE_CHECKING:
    from bench.runs.survey import Plugin


def initialise(plugins: Sequence[Plugin], births: Any) -> None:
    """Initialise a worker process.

    It ignores interrupts, discards its output, ends with its parent, and protects its memory from
    other processes.

    Args:
        plugins: plugins to load or to register.
        births: connection on which the worker reports that it has started.
    """
    # Ctrl-C in a terminal reaches every process of the group; only the parent handles it.
    ignore_interrupts()
    # This comes before everything that may fail: an unreported start would look like a busy worker.
    births.send(os.getpid())
    threading.Thread(target=_end_with_parent, daemon=True, name="end-with-parent").start()
    hide_memory()
    from bench.runs.survey import enter

    enter(plugins)
    _silence()


def _silence() -> None:
    """Discard all output: a tuner that prints would disturb the table or fill a disk."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    # The file descriptors are replaced, because C libraries do not use `sys.stdout`.
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    os.close(nowhere)


def _end_with_parent() -> None:
    """End this process when its parent ends, even if a run hangs."""
    from multiprocessing import connection, parent_process

    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        # `sys.exit` would end this thread only.
        os._exit(1)
