"""Tables that a reader sorts, filters, copies and saves: `DataGrid`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from bench.pages.page_table import Table, is_missing

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

    @property
    def headings(self) -> list[str]:
        """Headings of the columns, those of numbers with a hyphen before them."""
        return [f"{'-' * bool(c.digits)}{c.head or c.name}" for c in self.columns]

    def is_marked(self, row: Mapping[Any, Any]) -> bool:
        """Return whether a row is highlighted."""
        return bool(self.marked) and str(row[self.marked[0]]).startswith(self.marked[1])


def select_initial_rows(grid: DataGrid, frame: pd.DataFrame | Table) -> list[dict[str, Any]]:
    """Select the rows of a grid's initial choice, in its initial order.

    Args:
        grid: The grid.
        frame: The table that the page contains as CSV.
    """
    table = (
        frame
        if isinstance(frame, Table)
        else Table({str(name): frame[name].tolist() for name in frame})
    )
    rows = [
        row
        for row in table.rows()
        if all(str(row[name]) == value for name, value in grid.only.items())
    ]
    if not grid.sort:
        return rows
    name, _, direction = grid.sort.partition(",")
    missing = [row for row in rows if is_missing(row[name])]
    present = [row for row in rows if not is_missing(row[name])]
    return sorted(present, key=lambda row: row[name], reverse=direction == "down") + missing
