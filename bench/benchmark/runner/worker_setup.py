"""Set up a worker process so that it cannot affect the terminal or outlive its parent."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from bench.benchmark.isolation.linux_syscalls import set_not_dumpable
from bench.benchmark.runner.spawn_context import ignore_interrupts

if TYPE_CHECKING:
    from bench.benchmark.runner.plugin_discovery import Plugin


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
