"""A figure that shows itself in a notebook."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO

import matplotlib.artist

from bench.figures.formats import shows_no_help


@contextmanager
def _without_tables_of_properties() -> Iterator[None]:
    """Load Matplotlib without the tables of properties in its docstrings, which take a sixth of the
    time, where nobody can ask for them.
    """
    name, tables = "kwdoc", matplotlib.artist.kwdoc
    if shows_no_help():
        setattr(matplotlib.artist, name, lambda artist: "")  # noqa: ARG005
    try:
        yield
    finally:
        setattr(matplotlib.artist, name, tables)


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
