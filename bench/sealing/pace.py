"""On which processor the two sides of a run work."""

from __future__ import annotations

import ctypes
import os
from time import perf_counter

_QUICK = 5e-4
"""Seconds of an exchange below which it matters where the two sides work."""
_LOOK = 16
"""Exchanges that are measured before that is decided."""
_AGAIN = 1.0
"""Seconds after which it is decided anew: other work may have come to the processor."""


class Pace:
    """Keeps both sides on one processor where they take turns quickly: waking another one up costs
    more than the work.

    Left to itself the kernel spreads the two, which costs 60 us an exchange; on one processor it
    is 8 us. For slow exchanges nothing is gained, and the kernel knows better.
    """

    def __init__(self) -> None:
        self._count, self._since = 0, perf_counter()
        self._home = None if not hasattr(os, "sched_getaffinity") else os.sched_getaffinity(0)
        self._pinned = False

    def step(self) -> int:
        """Count an exchange; the flags that tell the other side where to work, 0 for as before."""
        self._count += 1
        if self._count % _LOOK:
            return 0
        now = perf_counter()
        mean = (now - self._since) / _LOOK
        self._since = now
        if self._pinned and (mean > _QUICK or now > self._until):
            self.release()
            return 255
        if not self._pinned and mean < _QUICK:
            return self._pin(now)
        return 0

    def _pin(self, now: float) -> int:
        processor = _processor()
        if self._home is None or not 0 <= processor < 254:
            return 0
        os.sched_setaffinity(0, {processor})
        self._pinned, self._until = True, now + _AGAIN
        return processor + 1

    def release(self) -> None:
        """Let this side work anywhere again."""
        if self._pinned and self._home is not None:
            os.sched_setaffinity(0, self._home)
            self._pinned = False


def _processor() -> int:
    """The one that this process is on; -1 where that is not known."""
    try:
        return int(ctypes.CDLL(None).sched_getcpu())
    except (AttributeError, OSError):
        return -1
