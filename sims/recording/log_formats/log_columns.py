"""Columns of a log, by name, and one-line errors of the libraries that read logs."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from sims.core.simulator import Array, InputError, make_read_only

MAX_COLUMNS = 10_000
"""Maximum number of columns of a log, and of entries of a list in a cell."""
_LIST_ENTRY_PATTERN = re.compile(r"(?P<base>.*)\[(?P<index>\d{1,5})\]")


@dataclass(frozen=True)
class LogFile:
    """Columns of one log.

    Attributes:
        path: Path of the log.
        columns: Numbers by column name, (T,) or (T, k), NaN where missing; columns without numbers
            are left out.
        texts: Names of the columns without numbers.
        rows: Word for a row in messages, such as "row" or "message".
        units: Unit of each column for which a row of the file states one.
        unlisted: Columns that `list_columns` leaves out, because another one holds the same numbers
            under the name of their joint.
        named: Whether the file names its columns.
        first: Number of the first row in the file, for messages.
    """

    path: Path
    columns: Mapping[str, Array]
    texts: tuple[str, ...] = ()
    rows: str = "row"
    units: Mapping[str, str] = field(default_factory=dict)
    unlisted: frozenset[str] = frozenset()
    named: bool = True
    first: int = 2

    def get_column(self, name: str) -> Array:
        """Return one column (T,), or one entry of a column of lists, such as ``position[2]``.

        Shapes: T rows.

        Args:
            name: Name as a description or a user wrote it; case does not count.

        Raises:
            InputError: There is no such column or entry, or the column contains lists and the name
                no index; the message is one line.
        """
        if name in self.columns:
            values = self.columns[name]
            if values.ndim == 1:
                return values
            last = values.shape[1] - 1
            entries = f"its entries are {name}[0] to {name}[{last}]"
            raise InputError(f"{self.path}: column '{name}' contains lists; {entries}")
        column, index = self._find_column(name)
        values = self.columns[column]
        if index is None and values.ndim == 1:
            return values
        if index is None or values.ndim == 1 or index >= values.shape[1]:
            raise self._make_missing_column_error(name)
        return make_read_only(values[:, index])

    def _find_column(self, name: str) -> tuple[str, int | None]:
        """Find a column regardless of case, and the index into its lists if the name has one.

        `position[2]` is entry 2 of a list column, unless a column has this very name.

        Args:
            name: Name as a description or a user wrote it.

        Returns:
            Name in the file, and the index of the list entry, else None.

        Raises:
            InputError: No column has this name, or several have it in different case.
        """
        candidates: list[tuple[str, int | None]] = [(name, None)]
        match = _LIST_ENTRY_PATTERN.fullmatch(name)
        if match:
            candidates.append((match["base"], int(match["index"])))
        for candidate, index in candidates:
            if candidate in self.columns:
                return candidate, index
            lower_case = candidate.strip().lower()
            matches = [column for column in self.columns if column.strip().lower() == lower_case]
            if len(matches) == 1:
                return matches[0], index
        raise self._make_missing_column_error(name)

    def _make_missing_column_error(self, name: str) -> InputError:
        """Return the error for a column that does not exist, or that holds text."""
        if name in self.texts:
            return InputError(f"{self.path}: column '{name}': expected numbers, found text")
        column_list = ", ".join(self.list_columns()) or "none"
        return InputError(f"{self.path}: unknown column '{name}'; there are: {column_list}")

    def list_columns(self) -> list[str]:
        """List all numeric columns; columns of lists by their entries, ``position[0]`` and so on.

        Columns are left out that another one replaces under the name of a joint.
        """
        column_names = []
        for name, values in self.columns.items():
            if name in self.unlisted:
                continue
            if values.ndim == 1:
                column_names.append(name)
            else:
                column_names += [f"{name}[{k}]" for k in range(values.shape[1])]
        return column_names


@contextmanager
def convert_read_errors(path: Path, kind: str, hint: str = "") -> Iterator[None]:
    """Convert all errors of the library that reads a file to an error of one line.

    It is used in a ``with`` statement around the calls of the library.

    Args:
        path: Path of the file.
        kind: Kind of the file with its article, for the message, such as "an HDF5 file".
        hint: Advice at the end of the message.

    Raises:
        InputError: The file cannot be read; the message is one line.
    """
    try:
        yield
    except InputError:
        raise
    except MemoryError:
        # A damaged file may state any size.
        raise InputError(
            f"{path}: the file is damaged, or its content does not fit into memory"
        ) from None
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: not {kind} that can be read: {reason[:300]}{hint}") from None
