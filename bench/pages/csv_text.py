"""Tables as CSV text that a spreadsheet opens safely."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence


def csv_text(head: Sequence[str], found: Iterable[Sequence[object]]) -> str:
    """Write a table with these columns as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    # What begins like a formula is one to a spreadsheet; names are from files.
    writer.writerows([_plain(cell) for cell in row] for row in found)
    return text.getvalue()


def _plain(cell: object) -> object:
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(("=", "+", "-", "@")) else cell
