"""Tables that a reader sorts, filters, copies and saves: `Grid`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from bench.pages import elements
from bench.pages.elements import safe
from bench.pages.table import Table, is_missing
from bench.pages.text import number

if TYPE_CHECKING:
    import pandas as pd

FEW = 15
"""Rows that a page shows without its script, and at once with it."""


@dataclass(frozen=True)
class Column:
    """A column that is shown.

    Attributes:
        name: in the table.
        head: above it, with its unit; the name where empty.
        digits: significant digits of a number; 0 for texts, as they stand.
        says: what it is, shown above the head.
    """

    name: str
    head: str = ""
    digits: int = 0
    says: str = ""


@dataclass(frozen=True)
class Grid:
    """A table to work with.

    Attributes:
        name: in the page's address and ids: letters, digits and hyphens.
        title: read aloud, and shown above it.
        table: name of the table in the page.
        columns: that are shown; what is saved has all.
        filters: columns of which a reader chooses a value.
        only: values chosen at first, by column of `filters`.
        sort: column by which it is sorted at first, downwards with ``,down`` behind it; empty for
            as it stands.
        switch: column of names that legends switch on and off; empty for none.
        marked: a column, and the beginning of its text in rows that stand out; empty for none.
        lights: column of names by which rows light up together with whatever in the page bears the
            same name.
        links: column of addresses to which the first shown column leads; empty for none. Such an
            address is a path from where the page lies, quoted (`urllib.parse.quote`).
    """

    name: str
    title: str
    table: str
    columns: tuple[Column, ...]
    filters: tuple[str, ...] = ()
    only: Mapping[str, str] = field(default_factory=dict)
    sort: str = ""
    switch: str = ""
    marked: tuple[str, ...] = ()
    lights: str = ""
    links: str = ""

    def spec(self) -> dict[str, Any]:
        """What the page's script is told, as JSON holds it."""
        return {**asdict(self), "few": FEW}

    def html(self, frame: pd.DataFrame | Table) -> str:
        """Render the table as it stands without a script: the first rows of the first choice.

        Args:
            frame: the table that the page holds as CSV.
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
            f"{elements.NUMBERS * bool(c.digits)}{safe(c.head or c.name)}" for c in self.columns
        ]
        shown = part[:FEW]
        rows = [self._cells(row) for row in shown]
        marks = ["found" if self._stands_out(row) else "" for row in shown]
        more = len(part) - FEW
        note = elements.paragraph(f"{more} more rows.", "soft") if more > 0 else ""
        return elements.table(heads, rows, marks) + note

    def _stands_out(self, row: Mapping[Any, Any]) -> bool:
        return bool(self.marked) and str(row[self.marked[0]]).startswith(self.marked[1])

    def _cells(self, row: Mapping[Any, Any]) -> Sequence[str]:
        cells: list[str] = []
        for column in self.columns:
            value = row[column.name]
            # Longer than elsewhere: of a traceback every line is wanted.
            cells.append(number(value, column.digits) if column.digits else safe(value, 300))
        if self.links and row[self.links]:
            cells[0] = f'<a href="{safe(row[self.links], 2000)}">{cells[0]}</a>'
        return cells
