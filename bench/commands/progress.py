"""Progress on stderr: bars with an estimate of the time left, and what is being done in words."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from tqdm import tqdm

_TERMINAL_PAUSE = 0.2
"""Seconds between two looks of a bar on a terminal."""
_LOG_PAUSE = 30.0
"""The same in a log, which wants few lines."""
_LOOK = "{desc}: {percentage:3.0f}%|{bar:20}| {elapsed}, about {remaining} left{postfix}"
"""The bar of a search: what is looked at stands behind the estimate."""


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


class Look:
    """What a long search is at: on a terminal a bar with an estimate of the time left, elsewhere a
    line for each part of it.
    """

    def __enter__(self) -> Look:
        self._share, self._what = 0.0, ""
        self._bar: tqdm[NoReturn] | None = None
        if sys.stderr.isatty():
            self._bar = self._drawn()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def _drawn(self) -> tqdm[NoReturn]:
        from tqdm import tqdm

        # The thread that would watch over idle bars: a process with threads cannot fork workers.
        tqdm.monitor_interval = 0
        # A search does not go at an even pace: the estimate is of its mean pace so far.
        return tqdm(
            total=1.0,
            desc="simgap",
            file=sys.stderr,
            dynamic_ncols=True,
            leave=False,
            mininterval=_TERMINAL_PAUSE,
            smoothing=0,
            bar_format=_LOOK,
        )

    def say(self, text: str) -> None:
        """Say what is being done."""
        if self._bar is None:
            print(f"simgap: {text} ...", file=sys.stderr, flush=True)
        else:
            self.show(self._share, text)

    def show(self, share: float, what: str) -> None:
        """Show how far it is, and what is looked at."""
        if self._bar is None:
            return
        # What could not be foreseen makes the share smaller, which would look like going back.
        self._share = max(self._share, share)
        if what != self._what:
            self._what = what
            self._bar.set_postfix_str(what, refresh=False)
        self._bar.update(self._share - self._bar.n)
