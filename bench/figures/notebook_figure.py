"""Matplotlib figure that displays itself in a notebook."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO

import matplotlib.artist

from bench.figures.figure_files import is_command


@contextmanager
def _skip_property_tables() -> Iterator[None]:
    """Context that skips the property tables in Matplotlib's docstrings if a command runs.

    They take a sixth of the import time.
    """
    tables = matplotlib.artist.kwdoc
    if is_command():
        matplotlib.artist.kwdoc = _return_no_table
    try:
        yield
    finally:
        matplotlib.artist.kwdoc = tables


def _return_no_table(artist: object) -> str:  # noqa: ARG001
    return ""


with _skip_property_tables():
    from matplotlib.figure import Figure


class NotebookFigure(Figure):
    """A figure without pyplot that a notebook's cell displays as an image.

    A notebook displays figures as images only after pyplot has registered them; without pyplot, a
    figure would be shown as a line of text.
    """

    def _repr_png_(self) -> bytes:
        file = BytesIO()
        self.savefig(file, format="png", bbox_inches="tight")
        return file.getvalue()
