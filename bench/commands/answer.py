"""How commands answer: in words for a person, or with ``--json`` in one document for a program.

A command is a function of its options and of `say`, which takes a line for a person as it comes,
and returns an `Answer`, which holds the same for a program. One of the two printers here prints the
one or the other; so every command has ``--json``, and faults have one form.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stdout
from pathlib import PurePath
from typing import Any, Literal, NamedTuple, Protocol

Document = dict[str, Any]
"""What JSON can hold, once `plain` has seen it."""
Say = Callable[[str], None]
"""Takes a line for a person."""
FaultKind = Literal["usage", "input", "memory", "interrupted", "internal"]

DONE = 0
"""Exit code of a command that did what was asked."""
WRONG = 1
"""Of one that did, and something in it is not as it should be."""
FAULT = 2
"""Of one that could not begin, or go on."""
INTERRUPTED = 130
"""Of one that a person interrupted, as shells have it."""
EXITS = {
    DONE: "done",
    WRONG: "done, and something failed in it: a run, a check, a claim; or what was asked to make "
    "it so",
    FAULT: "a fault of the input, told in one line; nothing was half-written",
    INTERRUPTED: "interrupted; what was finished is kept",
}
"""Every exit code that there is."""


class Answer(NamedTuple):
    """What a command has to say to a program.

    Attributes:
        document: as the schema of the command's name has it (`simgap schema NAME`).
        code: with which the program ends, one of `EXITS`.
    """

    document: Document
    code: int = DONE


class Printer(Protocol):
    """Prints what commands answer."""

    def say(self, line: str) -> None:
        """Take a line for a person."""
        ...

    def working(self) -> AbstractContextManager[None]:
        """Around the command at work."""
        ...

    def answer(self, answer: Answer) -> None:
        """Print what it has come to."""
        ...

    def fault(self, kind: FaultKind, message: str, code: int) -> None:
        """Print why it came to nothing."""
        ...


class Words:
    """For a person: every line as it comes."""

    def say(self, line: str) -> None:
        """Print it."""
        print(line)

    def working(self) -> AbstractContextManager[None]:
        """Nothing is to be kept from anywhere."""
        return nullcontext()

    def answer(self, answer: Answer) -> None:
        """All of it has been said."""

    def fault(self, kind: FaultKind, message: str, code: int) -> None:  # noqa: ARG002
        """One line on stderr; the traceback of what is internal says more."""
        _warn(kind, message)


class Json:
    """For a program: one document on stdout, and nothing else there."""

    def say(self, line: str) -> None:
        """The document has it too."""

    def working(self) -> AbstractContextManager[None]:
        """Whatever is printed meanwhile goes to stderr."""
        return _stdout_to_stderr()

    def answer(self, answer: Answer) -> None:
        """Print the document."""
        print(text(answer.document))

    def fault(self, kind: FaultKind, message: str, code: int) -> None:
        """Print it in the form of every command; a log of stderr has its line too."""
        _warn(kind, message)
        print(text({"error": {"kind": kind, "message": message, "code": code}}))


def _warn(kind: FaultKind, message: str) -> None:
    if kind != "internal":
        print(f"simgap: {message}", file=sys.stderr)


def text(document: Document) -> str:
    """A document as JSON, laid out so that a person can look at it too."""
    return json.dumps(plain(document), indent=1, allow_nan=False, ensure_ascii=False)


def plain(value: Any) -> Any:
    """A value as JSON has it: paths as texts, tuples as lists, no number for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, tuple | list | set | frozenset):
        return [plain(inner) for inner in value]
    if isinstance(value, PurePath):
        return str(value)
    # Of numpy, whether a number or an array of them.
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    # What a file or a system call gave may hold half a character, which no encoder takes.
    return value.encode("utf-8", "replace").decode() if isinstance(value, str) else value


@contextmanager
def _stdout_to_stderr() -> Iterator[None]:
    """Send to stderr what is printed: by Python, by libraries in C and by worker processes."""
    sys.stdout.flush()
    with redirect_stdout(sys.stderr):
        try:
            descriptor = sys.__stdout__.fileno() if sys.__stdout__ else None
        except (OSError, ValueError):
            descriptor = None
        if descriptor is None:
            yield
            return
        kept = os.dup(descriptor)
        try:
            os.dup2(2, descriptor)
            yield
        finally:
            _flush_c()
            os.dup2(kept, descriptor)
            os.close(kept)


def _flush_c() -> None:
    """Have C print what it has kept: at the program's end it would come to stand in the answer."""
    import ctypes

    try:
        ctypes.CDLL(None).fflush(None)
    except (AttributeError, OSError, TypeError):  # where C's library is not in the program
        return
