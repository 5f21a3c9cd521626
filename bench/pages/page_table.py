"""Table of a page: named columns of equal length, without pandas.

Importing pandas takes longer than drawing a figure, and the report of `explain` only needs rows,
columns and CSV.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from io import StringIO
from typing import Any


class Table:
    """Named columns of equal length.

    Args:
        columns: Values by column name, in the order of the columns; None and NaN are missing.

    Raises:
        ValueError: The columns differ in length.
    """

    def __init__(self, columns: Mapping[str, Sequence[Any]]) -> None:
        """Copy the columns, and check that all have the same length."""
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
