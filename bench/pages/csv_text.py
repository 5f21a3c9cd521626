"""Format tables as CSV text that is safe to open in a spreadsheet."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence


def format_csv(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Format a table as CSV.

    Args:
        head: Names of the columns.
        rows: Rows.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    # A spreadsheet would run text that begins like a formula, and names come from files.
    writer.writerows([_escape_formula(cell) for cell in row] for row in rows)
    return text.getvalue()


def _escape_formula(cell: object) -> object:
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(("=", "+", "-", "@")) else cell
