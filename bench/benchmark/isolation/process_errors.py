"""Errors that end the run of an isolated process, and the texts that explain them."""

from __future__ import annotations

import re
import signal
from pathlib import Path

ISOLATION_NOTE = (
    "tuners run isolated: no files, no processes, no network; use --trust while developing"
)
"""Note that is added to an error that the isolation of the tuner may have caused."""
_REFUSED_ACCESS_PATTERN = re.compile(
    r"^[\w.]*(PermissionError|BlockingIOError|FileNotFoundError|Connection\w*Error|gaierror"
    r"|BrokenProcessPool|TerminatedWorkerError)\b"
    r"|Permission denied|Operation not permitted|Read-only file system|No such file or directory"
    r"|Resource temporarily unavailable|Function not implemented|No space left on device"
    r"|File too large|Too many open files|can't start new thread|Network is unreachable"
)
"""Pattern of exception lines after the kernel refused a file, a process or a socket."""

_TRACEBACK_FRAME = re.compile(r'File "(?P<file>[^"]+)", line (?P<line>\d+), in (?P<function>\S+)')


class RunEndedError(Exception):
    """A run has ended, because the tuner failed or took too long.

    Attributes:
        status: status as in status.csv.
        reason: reason as text; the tuner's traceback if it crashed.
    """

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(reason)
        self.status, self.reason = status, reason

    def __reduce__(self) -> tuple[type[RunEndedError], tuple[str, str]]:
        # Workers pickle errors; by default unpickling calls the class with the message alone.
        return RunEndedError, (self.status, self.reason)


class KilledExternallyError(Exception):
    """A process was killed externally, which gives no information about its work."""


def with_isolation(reason: str) -> str:
    """Append `ISOLATION_NOTE` to the reason of a failure that the isolation may have caused.

    That is so if an exception in the traceback is about an access that the isolation refuses, such
    as to a file or to the network. Any other reason is returned unchanged.

    Args:
        reason: traceback of an isolated tuner.
    """
    # Lines without indentation are those of exceptions; the others are frames and source code.
    if any(
        _REFUSED_ACCESS_PATTERN.search(line) for line in reason.splitlines() if line[:1].strip()
    ):
        return f"{reason.rstrip()}; {ISOLATION_NOTE}"
    return reason


def without_isolation(reason: str) -> str:
    """Return a reason without the text that `with_isolation` has added."""
    return reason.removesuffix(f"; {ISOLATION_NOTE}")


def describe_exit(process: str, code: int | None) -> str:
    """Describe how a process ended.

    Args:
        process: name of the process.
        code: its exit code, or minus the number of the signal that killed it; None if it closed its
            pipe and had to be killed.
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


def format_failure_reason(reason: str) -> str:
    """Return error and location from a reason, which may be a traceback.

    A traceback becomes one line, ``ValueError: MESSAGE (FILE.py, line 7, in FUNCTION)``; of another
    reason the last line is returned.
    """
    lines = without_isolation(reason.strip()).splitlines() or [""]
    frames = [i for i, line in enumerate(lines) if _TRACEBACK_FRAME.search(line)]
    if not frames:
        return lines[-1].strip()
    # The error message is the first line without indentation after the last frame; it may be
    # followed by pages of text.
    message = next((line for line in lines[frames[-1] + 1 :] if line[:1].strip()), lines[-1])
    file, number, function = _TRACEBACK_FRAME.findall(lines[frames[-1]])[0]
    return f"{message} ({Path(file).name}, line {number}, in {function})"
