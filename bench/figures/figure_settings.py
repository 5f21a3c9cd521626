"""Settings of figures in this process: whether PDF files are requested, whether a command runs.

Rendering a PDF takes about as long as rendering the PNG, and most PDF files are never opened. The
commands take ``--pdf``, the functions of `simgap` take ``pdf=True``. Both set it here, so that the
functions between them and the file need not pass it on.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_WANTED: ContextVar[bool] = ContextVar("pdf_wanted", default=False)


@contextmanager
def pdf_figures(wanted: bool = True) -> Iterator[None]:
    """Context in which every figure is also written as PDF.

    Args:
        wanted: Whether to write PDF files; False does not override an outer context with True.
    """
    token = _WANTED.set(wanted or _WANTED.get())
    try:
        yield
    finally:
        _WANTED.reset(token)


def is_pdf_wanted() -> bool:
    """Return whether PDF files are requested."""
    return _WANTED.get()


_command = False


def mark_as_command() -> None:
    """Record that this process runs a command and is not an interactive session."""
    global _command
    _command = True


def is_command() -> bool:
    """Return whether this process runs a command, which shows no docstrings of libraries."""
    return _command
