"""A figure that shows itself in a notebook."""

from __future__ import annotations

from io import BytesIO

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
