"""Tables of a page: named columns and sortable grids.

Importing pandas takes longer than drawing a figure, and the report of `explain` only needs rows,
columns and CSV.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from io import StringIO
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd


class Table:
    """Named columns of equal length.

    Raises:
        ValueError: The columns differ in length.
    """

    def __init__(self, columns: Mapping[str, Sequence[Any]]) -> None:
        """Copy the columns, and check that all have the same length.

        Args:
            columns: Values by column name, in the order of the columns; None and NaN are missing.
        """
        self._columns = {name: list(values) for name, values in columns.items()}
        lengths = {len(values) for values in self._columns.values()}
        if len(lengths) > 1:
            raise ValueError(f"expected columns of one length, found lengths {sorted(lengths)}")
        self._length = lengths.pop() if lengths else 0

    @classmethod
    def from_rows(cls, rows: Sequence[Mapping[str, Any]]) -> Table:
        """Build a table from rows with the same keys; without rows it has no columns."""
        names = list(rows[0]) if rows else []
        return cls({name: [row[name] for row in rows] for name in names})

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns, in order."""
        return tuple(self._columns)

    def __len__(self) -> int:
        return self._length

    def __contains__(self, name: object) -> bool:
        return name in self._columns

    def __getitem__(self, name: str) -> list[Any]:
        return self._columns[name]

    def without(self, names: Sequence[str]) -> Table:
        """Copy the table without some columns."""
        return Table({name: v for name, v in self._columns.items() if name not in names})

    def rows(self) -> list[dict[str, Any]]:
        """List the rows as dictionaries with a value for each column name."""
        return [
            dict(zip(self._columns, row, strict=True))
            for row in zip(*self._columns.values(), strict=True)
        ]

    def to_csv(self, *, index: bool = False, float_format: str | None = None) -> str:
        """Write the table as CSV, as `pandas.DataFrame.to_csv` does; missing values are empty.

        Args:
            index: Must be False, since there is no index.
            float_format: Format of floating-point numbers, such as ``%.6g``. None writes the
                shortest text that reads back as the same number.

        Raises:
            ValueError: `index` is True.
        """
        if index:
            raise ValueError("expected index=False, since the table has no index")
        text = StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self._columns)
        writer.writerows(
            [_cell(value, float_format) for value in row]
            for row in zip(*self._columns.values(), strict=True)
        )
        return text.getvalue()


def is_missing(value: object) -> bool:
    """Return whether a cell has no value: None or NaN."""
    return value is None or value != value


def _cell(value: object, float_format: str | None) -> object:
    if is_missing(value):
        return ""
    return float_format % value if float_format and isinstance(value, float) else value


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
    # Rows without a value come last in both directions.
    missing = [row for row in rows if is_missing(row[name])]
    present = [row for row in rows if not is_missing(row[name])]
    return sorted(present, key=lambda row: row[name], reverse=direction == "down") + missing
