"""A figure that shows itself in a notebook."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO

import matplotlib.artist

from bench.figures.formats import is_command


@contextmanager
def _without_tables_of_properties() -> Iterator[None]:
    """Load Matplotlib without the tables of properties in its docstrings in a command: they take a
    sixth of the time of the import.
    """
    tables = matplotlib.artist.kwdoc
    if is_command():
        matplotlib.artist.kwdoc = _no_table
    try:
        yield
    finally:
        matplotlib.artist.kwdoc = tables


def _no_table(artist: object) -> str:  # noqa: ARG001
    return ""


with _without_tables_of_properties():
    from matplotlib.figure import Figure


class Picture(Figure):
    """A figure that pyplot does not know of, and that a notebook's cell shows all the same.

    A notebook shows figures as pictures only after pyplot has told it how; one that was made
    without pyplot would be shown as a line of text.
    """

    def _repr_png_(self) -> bytes:
        file = BytesIO()
        self.savefig(file, format="png", bbox_inches="tight")
        return file.getvalue()
