"""Matplotlib figure that displays itself in a notebook."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import matplotlib.artist

from bench.figures.figure_settings import is_command


@contextmanager
def _skip_generated_documentation() -> Iterator[None]:
    """Context that skips the documentation that Matplotlib generates when it is imported.

    The property tables in its docstrings and the signatures of the methods `set` take a quarter of
    the import time. Nothing but documentation depends on them, so the functions that generate them
    are replaced during the import. In an interactive session they are kept.
    """
    artist: Any = matplotlib.artist
    # The second one is private: a later Matplotlib may not have it.
    generators = [(artist, "kwdoc"), (artist.Artist, "_update_set_signature_and_docstring")]
    originals = [
        (owner, name, vars(owner)[name]) for owner, name in generators if name in vars(owner)
    ]
    if is_command():
        for owner, name, _ in originals:
            setattr(owner, name, _return_no_text)
    try:
        yield
    finally:
        for owner, name, original in originals:
            setattr(owner, name, original)


def _return_no_text(*_: object) -> str:
    return ""


with _skip_generated_documentation():
    from matplotlib.figure import Figure


class NotebookFigure(Figure):
    """A figure without pyplot that a notebook's cell displays as an image.

    A notebook displays figures as images only after pyplot has registered them; without pyplot, a
    figure would be shown as a line of text.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Keep the present setting of hinting, which Matplotlib otherwise reads when it draws."""
        super().__init__(*args, **kwargs)
        self._text_hinting = matplotlib.rcParams["text.hinting"]

    def draw(self, renderer: Any) -> None:
        """Draw the figure with the same letters whenever it is drawn."""
        with matplotlib.rc_context({"text.hinting": self._text_hinting}):
            super().draw(renderer)

    def _repr_png_(self) -> bytes:
        file = BytesIO()
        self.savefig(file, format="png", bbox_inches="tight")
        return file.getvalue()
