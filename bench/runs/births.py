"""Fresh interpreters that no Ctrl-C reaches before they can say that it is not theirs to answer."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.context import SpawnContext, SpawnProcess


class _HeldBack(SpawnProcess):
    """A process that begins with interrupts held back, until `ignore_interrupts` is called in it.

    A terminal's Ctrl-C reaches every process of the group. One that is at its imports, before any
    line of ours has run, would end with a traceback in the midst of the table.
    """

    def start(self) -> None:
        """Start it."""
        # It lets interrupts through again once it has started its own process: so first of all.
        resource_tracker.ensure_running()
        with _interrupts_held_back():
            super().start()


class HeldBackContext(SpawnContext):
    """multiprocessing's spawn context, with processes that interrupts wait for."""

    Process = _HeldBack


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
