"""Pin a worker and its tuner's process to one processor while they exchange messages quickly."""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress
from time import perf_counter

_FAST_EXCHANGE_SECONDS = 5e-4
"""Duration of an exchange in seconds below which both sides should share a processor."""
_MEASURED_EXCHANGES = 16
"""Number of exchanges that are measured before a decision."""
_REMEASURE_SECONDS = 1.0
"""Seconds after which the decision is repeated, because other work may use the processor."""
_ANY_PROCESSOR_FLAG = 255
"""Flag that lets the other side run on any processor; flags are one byte."""


class AffinityController:
    """Controller that pins both sides of a run to one processor while they alternate quickly.

    For fast exchanges, waking another processor costs more than the work. The kernel by default
    uses two processors, which costs 60 us per exchange; on one processor it is 8 us. For slow
    exchanges there is no gain, and the choice is left to the kernel.
    """

    def __init__(self) -> None:
        """Begin without a pin; times are those of `perf_counter` in seconds."""
        self._exchange_count = 0
        # Beginning of the present block of exchanges, whose mean duration is measured.
        self._measured_since = perf_counter()
        self._is_pinned = False
        self._pinned_until = 0.0
        # Not every system states on which processors a process may run.
        self._original_processors = (
            os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
        )

    def record_exchange(self) -> int:
        """Count an exchange of messages, and return a flag that tells the other side where to run.

        After every `_MEASURED_EXCHANGES` exchanges, their mean duration decides: fast exchanges pin
        both sides to one processor, slow ones release them. A pin is also released after some time,
        to measure without it.

        Returns:
            0 for no change, `_ANY_PROCESSOR_FLAG`, or n + 1 for processor n.
        """
        self._exchange_count += 1
        # The decision is made when a further block of exchanges is complete.
        if self._exchange_count % _MEASURED_EXCHANGES:
            return 0
        now = perf_counter()
        mean_seconds = (now - self._measured_since) / _MEASURED_EXCHANGES
        self._measured_since = now
        if self._is_pinned and (mean_seconds > _FAST_EXCHANGE_SECONDS or now > self._pinned_until):
            self.release_affinity()
            return _ANY_PROCESSOR_FLAG
        if not self._is_pinned and mean_seconds < _FAST_EXCHANGE_SECONDS:
            return self._pin_to_current_processor(now)
        return 0

    def _pin_to_current_processor(self, now: float) -> int:
        """Pin this side to the processor that it uses now, until `now` plus `_REMEASURE_SECONDS`.

        Returns:
            The flag for the other side, the number of the processor + 1; 0 (no change) if the
            processor is unknown or its number does not fit into the flag.
        """
        processor = _read_current_processor()
        if self._original_processors is None or not 0 <= processor < _ANY_PROCESSOR_FLAG - 1:
            return 0
        os.sched_setaffinity(0, {processor})
        self._is_pinned, self._pinned_until = True, now + _REMEASURE_SECONDS
        return processor + 1

    def release_affinity(self) -> None:
        """Allow this side to run on its original processors again."""
        if self._is_pinned and self._original_processors is not None:
            os.sched_setaffinity(0, self._original_processors)
            self._is_pinned = False


def _read_current_processor() -> int:
    """Return the number of the processor that runs this process; -1 if unknown."""
    try:
        return int(ctypes.CDLL(None).sched_getcpu())
    except (AttributeError, OSError):
        return -1


def set_processor(flag: int) -> None:
    """Run this process where the harness runs, because alternating is faster on one processor.

    Args:
        flag: result of `AffinityController.record_exchange`, not 0: the number of the processor
            plus one, or `_ANY_PROCESSOR_FLAG`.
    """
    processors = range(os.cpu_count() or 1) if flag == _ANY_PROCESSOR_FLAG else {flag - 1}
    with suppress(OSError, AttributeError):
        os.sched_setaffinity(0, processors)
