"""Tables that a reader sorts, filters, copies and saves: `DataGrid`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from bench.pages import html_elements
from bench.pages.html_elements import safe
from bench.pages.page_table import Table, is_missing
from bench.pages.text_format import format_number

if TYPE_CHECKING:
    import pandas as pd

INITIAL_ROWS = 15
"""Number of rows that a page shows without its script, and initially with it."""


@dataclass(frozen=True)
class GridColumn:
    """A displayed column.

    Attributes:
        name: Name in the table.
        head: Head with unit; empty for the name.
        digits: Significant digits of numbers; 0 for text.
        says: Description, shown over the head.
    """

    name: str
    head: str = ""
    digits: int = 0
    says: str = ""


@dataclass(frozen=True)
class DataGrid:
    """A table to work with.

    Attributes:
        name: Name in the page's address and ids: letters, digits and hyphens.
        title: Title above the table, also for screen readers.
        table: Name of the table in the page.
        columns: Displayed columns; a saved file has all columns.
        filters: Columns of which a reader chooses a value.
        only: Initial choices, by column of `filters`.
        sort: Column of the initial order, descending if followed by ``,down``; empty to keep the
            order.
        switch: Column of names that legends switch on and off; empty for none.
        marked: A column, and the beginning of its text in highlighted rows; empty for none.
        lights: Column of names by which rows are highlighted together with everything of the same
            name on the page.
        links: Column of addresses to which the first displayed column links; empty for none. Such
            an address is a path relative to the page, quoted (`urllib.parse.quote`).
    """

    name: str
    title: str
    table: str
    columns: tuple[GridColumn, ...]
    filters: tuple[str, ...] = ()
    only: Mapping[str, str] = field(default_factory=dict)
    sort: str = ""
    switch: str = ""
    marked: tuple[str, ...] = ()
    lights: str = ""
    links: str = ""

    def build_spec(self) -> dict[str, Any]:
        """Build the grid's JSON specification for the page's script."""
        return {**asdict(self), "few": INITIAL_ROWS}

    def to_html(self, frame: pd.DataFrame | Table) -> str:
        """Render the table for a page without script: the first rows of the initial choice.

        Args:
            frame: The table that the page contains as CSV.
        """
        table = (
            frame
            if isinstance(frame, Table)
            else Table({str(name): frame[name].tolist() for name in frame})
        )
        part = table.rows()
        for name, value in self.only.items():
            part = [row for row in part if str(row[name]) == value]
        if self.sort:
            name, _, way = self.sort.partition(",")
            missing = [row for row in part if is_missing(row[name])]
            part = [row for row in part if not is_missing(row[name])]
            part = sorted(part, key=lambda row: row[name], reverse=way == "down") + missing
        heads = [
            f"{html_elements.NUMERIC_HEADING_PREFIX * bool(c.digits)}{safe(c.head or c.name)}"
            for c in self.columns
        ]
        shown = part[:INITIAL_ROWS]
        rows = [self._cells(row) for row in shown]
        marks = ["found" if self._stands_out(row) else "" for row in shown]
        more = len(part) - INITIAL_ROWS
        note = html_elements.make_paragraph(f"{more} more rows.", "soft") if more > 0 else ""
        return html_elements.make_table(heads, rows, marks) + note

    def _stands_out(self, row: Mapping[Any, Any]) -> bool:
        return bool(self.marked) and str(row[self.marked[0]]).startswith(self.marked[1])

    def _cells(self, row: Mapping[Any, Any]) -> Sequence[str]:
        cells: list[str] = []
        for column in self.columns:
            value = row[column.name]
            # Long texts are shortened here; the stored table has them in full.
            cells.append(format_number(value, column.digits) if column.digits else safe(value, 300))
        if self.links and row[self.links]:
            cells[0] = f'<a href="{safe(row[self.links], 2000)}">{cells[0]}</a>'
        return cells
