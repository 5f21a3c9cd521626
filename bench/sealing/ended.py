"""How a tuner's process may end a run."""

from __future__ import annotations

import signal


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


def how_it_ended(process: str, code: int | None) -> str:
    """How a process ended, in words.

    Args:
        process: what it is called.
        code: its exit code, or minus the number of the signal that killed it; None where it closed
            its pipe and had to be ended.
    """
    if code is None:
        return f"{process} closed its pipe and was ended"
    if code >= 0:
        return f"{process} exited with code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"{process} was killed by {name}"
