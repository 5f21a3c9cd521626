"""Progress on stderr: bars with an estimate of the time left, and what is being done in words."""

from __future__ import annotations

import sys
from collections.abc import Callable

_TERMINAL_PAUSE = 0.2
"""Seconds between two looks of a bar on a terminal."""
_LOG_PAUSE = 30.0
"""The same in a log, which wants few lines."""


class Bars:
    """Progress bars, one after another; tqdm estimates the time left.

    Args:
        unit: what is counted.
    """

    def __init__(self, unit: str = "run") -> None:
        self._unit = unit
        self._close: Callable[[], None] = lambda: None

    def __enter__(self) -> Bars:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def start(self, title: str, total: int) -> Callable[[], None]:
        """Begin a bar of `total` steps in place of the last one; returns what advances it."""
        from tqdm import tqdm

        self._close()
        bar = tqdm(
            total=total,
            desc=title,
            unit=self._unit,
            file=sys.stderr,
            dynamic_ncols=True,
            mininterval=_TERMINAL_PAUSE if sys.stderr.isatty() else _LOG_PAUSE,
        )
        self._close = bar.close

        def step() -> None:
            bar.update()

        return step


def narrator() -> Callable[[str], None]:
    """What tells what is being done, on one line where stderr is a terminal."""
    # Back to the line's beginning and clear it: what was said last is overwritten.
    last = "\r\x1b[K" if sys.stderr.isatty() else ""

    def say(text: str) -> None:
        end = "" if last else "\n"
        print(f"{last}simgap: {text} ..." if text else last, end=end, file=sys.stderr, flush=True)

    return say
