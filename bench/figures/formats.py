"""Which files a figure is written as: PNG always, PDF on demand.

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
    """Write every figure as a PDF too, for the duration of the context.

    Args:
        wanted: False writes none; a context inside one that asks for PDF files still writes them.
    """
    token = _WANTED.set(wanted or _WANTED.get())
    try:
        yield
    finally:
        _WANTED.reset(token)


def is_pdf_wanted() -> bool:
    """Whether a PDF file is asked for."""
    return _WANTED.get()


_command = False


def mark_as_command() -> None:
    """Record that this process runs a command and is no interactive session."""
    global _command
    _command = True


def is_command() -> bool:
    """Whether this process runs a command, which shows no docstrings of libraries."""
    return _command
