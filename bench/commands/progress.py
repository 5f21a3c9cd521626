"""Progress bars of comparisons."""

from __future__ import annotations

import sys
from collections.abc import Callable


class Bars:
    """Progress bars on stderr, one after another; tqdm estimates the time left."""

    def __enter__(self) -> Bars:
        self._close: Callable[[], None] = lambda: None
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def start(self, title: str, total: int) -> Callable[[], None]:
        """Begin a bar of `total` steps; returns what advances it."""
        from tqdm import tqdm

        self._close()
        pause = 0.5 if sys.stderr.isatty() else 30.0  # a log wants few lines
        bar = tqdm(
            total=total,
            desc=title,
            unit="run",
            file=sys.stderr,
            dynamic_ncols=True,
            mininterval=pause,
        )
        self._close = bar.close

        def step() -> None:
            bar.update()

        return step
