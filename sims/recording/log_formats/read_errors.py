"""Convert the many kinds of errors that libraries raise for damaged files to one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sims.core.simulator import InputError


@contextmanager
def convert_read_errors(path: Path, kind: str, hint: str = "") -> Iterator[None]:
    """Convert all errors of the library that reads a file.

    Args:
        path: Path of the file.
        kind: Kind of the file with its article, for the message.
        hint: Advice at the end of the message.

    Raises:
        InputError: The file cannot be read; the message is one line.
    """
    try:
        yield
    except InputError:
        raise
    except MemoryError:
        raise make_memory_error(path) from None
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: not {kind} that can be read: {reason[:300]}{hint}") from None


def make_memory_error(path: Path) -> InputError:
    """Make the error for a file whose content seems too large; a damaged one may state any size."""
    return InputError(f"{path}: the file is damaged, or its content does not fit into memory")
