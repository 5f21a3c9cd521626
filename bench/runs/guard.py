"""What a worker process sets up for itself, so that nothing done in it reaches beyond it."""

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
    """Prepare a worker: interrupts are the parent's to handle, output goes nowhere, no worker
    outlives its parent, and nobody reads its memory.

    Args:
        plugins: to load, or to know of.
        births: where the worker tells that it is there.
    """
    # A terminal's Ctrl-C reaches every process of the group; the parent alone answers it.
    ignore_interrupts()
    # First of all that may fail: a birth that nobody hears of would look like a worker at work.
    births.send(os.getpid())
    threading.Thread(target=_end_with_parent, daemon=True, name="end-with-parent").start()
    hide_memory()
    from bench.runs.survey import enter

    enter(plugins)
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
