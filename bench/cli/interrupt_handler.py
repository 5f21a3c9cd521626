"""Interrupt handler: the first Ctrl-C requests a clean stop, the second interrupts at once."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable


class InterruptHandler:
    """Context in which the first Ctrl-C requests a stop, and the second one interrupts as usual.

    Args:
        print_line: Prints what the first Ctrl-C does; a line on stderr if None.
    """

    def __init__(self, print_line: Callable[[str], None] | None = None) -> None:
        self._is_stop_requested = False
        self._print_line = print_line or _print_line

    def is_stop_requested(self) -> bool:
        """Return whether a stop has been requested."""
        return self._is_stop_requested

    def __enter__(self) -> InterruptHandler:
        """Handle Ctrl-C from now on, unless another handler is set or this is no main thread."""
        # Python handles signals in the main thread only.
        self._is_main_thread = threading.current_thread() is threading.main_thread()
        # Keep ignoring SIGINT if it is ignored, as for background jobs of a shell.
        if self._is_main_thread and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._announce_early_end)
        return self

    def __exit__(self, *_: object) -> None:
        if self._is_main_thread and signal.getsignal(signal.SIGINT) == self._announce_early_end:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _announce_early_end(self, *_: object) -> None:
        self._is_stop_requested = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self._print_line("stopping with the results so far; Ctrl-C again stops at once")


def _print_line(text: str) -> None:
    print(f"\nsimgap: {text}", file=sys.stderr, flush=True)
