"""Progress bars on stderr with an estimate of the remaining time, for work of counted steps."""

from __future__ import annotations

import sys
from collections.abc import Callable

_TERMINAL_REFRESH_SECONDS = 0.2
"""Minimum time between two updates of a bar on a terminal, in seconds."""
_LOG_REFRESH_SECONDS = 30.0
"""Minimum time between two lines in a log, in seconds."""


class ProgressBars:
    """Progress bars, one after another; tqdm estimates the remaining time.

    Args:
        unit: What is counted.
    """

    def __init__(self, unit: str = "run") -> None:
        self._unit = unit
        self._close: Callable[[], None] = lambda: None

    def __enter__(self) -> ProgressBars:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def start_bar(self, title: str, total: int) -> Callable[[], None]:
        """Begin a bar that replaces the previous one.

        Args:
            title: Text in front of the bar.
            total: Number of steps.

        Returns:
            Function that advances the bar by one step.
        """
        from tqdm import tqdm

        self._close()
        bar = tqdm(
            total=total,
            desc=title,
            unit=self._unit,
            file=sys.stderr,
            dynamic_ncols=True,
            mininterval=_TERMINAL_REFRESH_SECONDS if sys.stderr.isatty() else _LOG_REFRESH_SECONDS,
        )
        self._close = bar.close

        def step() -> None:
            bar.update()

        return step
