"""How a tuner's process may end a run."""

from __future__ import annotations


class EndedError(Exception):
    """A run is over: the tuner failed, or took too long.

    Attributes:
        status: as in status.csv.
        reason: in words; a traceback of the tuner's own where it crashed.
    """

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(reason)
        self.status, self.reason = status, reason

    def __reduce__(self) -> tuple[type[EndedError], tuple[str, str]]:
        # Workers hand errors over pickled, which calls the class with the message alone.
        return EndedError, (self.status, self.reason)


class KilledError(Exception):
    """A process was killed from outside, which says nothing about what it was at."""
