"""How a tuner's process may end a run."""

from __future__ import annotations

import re
import signal

ISOLATED = "tuners run isolated: no files, no processes, no network; use --trust while developing"
"""What is added to the error of a tuner that the isolation has refused something."""
_REFUSED = re.compile(
    r"^[\w.]*(PermissionError|BlockingIOError|FileNotFoundError|Connection\w*Error|gaierror"
    r"|BrokenProcessPool|TerminatedWorkerError)\b"
    r"|Permission denied|Operation not permitted|Read-only file system|No such file or directory"
    r"|Resource temporarily unavailable|Function not implemented|No space left on device"
    r"|File too large|Too many open files|can't start new thread|Network is unreachable"
)
"""What the line of an exception says where the kernel refused a file, a process or a socket."""


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


def with_isolation(reason: str) -> str:
    """Return a reason with `ISOLATED` at its end, where the isolation may be the cause.

    Args:
        reason: a traceback of an isolated tuner.
    """
    # The lines at the margin are those of exceptions; the others are frames and source code.
    if any(_REFUSED.search(line) for line in reason.splitlines() if line[:1].strip()):
        return f"{reason.rstrip()}; {ISOLATED}"
    return reason


def without_isolation(reason: str) -> str:
    """Return a reason without what `with_isolation` has added."""
    return reason.removesuffix(f"; {ISOLATED}")


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
