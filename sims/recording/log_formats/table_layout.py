"""Find the layout of a text table from its first lines.

Comments and notes may precede the header, the header may be a comment itself (as NumPy writes it),
and a row of units may follow it. The separator is the one with which the largest share of the cells
are numbers.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sims.core.simulator import InputError
from sims.core.toml_validation import format_value
from sims.recording.log_formats.unit_names import read_unit

SEPARATORS = (",", ";", "\t", "|", " ")
"""Possible separators of the cells of a table; a blank means any number of blanks."""
_HEAD_BYTES = 1 << 22
"""Maximum number of bytes from which the layout is found."""
_HEAD_LINES = 400
"""Maximum number of lines from which the layout is found."""
COMMENT = re.compile(r"\s*(#+|%+|//+|!+)\s*")
"""Pattern of the beginning of a comment line."""
NUMBER = re.compile(
    r"[+-]?(\d+([.,]\d+)*\.?|[.,]\d+)([eE][+-]?\d+)?|[+-]?inf(inity)?", re.IGNORECASE
)
"""Pattern of a number with a decimal point or comma."""
NUMBERS = re.compile(r"[\[\(](?P<inside>[^\]\)]*)[\]\)]")
"""Pattern of a list of numbers in one cell."""
INSTANT = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d([.,]\d{1,9})?\s*(Z|UTC|[+-]\d\d:?\d\d)?")
"""Pattern of a date with a time, in ISO 8601."""
NO_NUMBER = frozenset({"nan", "null", "none", "na", "n/a", "#n/a", "nil"})
"""Cells that stand for a missing number."""
_NAME = re.compile(r"[^\W\d][\w./\[\](){}°%-]*")


@dataclass(frozen=True)
class Layout:
    """Layout of a text table.

    Attributes:
        encoding: Encoding of the text.
        separator: One of `SEPARATORS`.
        names: Names of the columns; empty if the file has none.
        units: Unit of each column, from the row of units below the header.
        header: Line of the header, counted from 1; 0 if there is none.
        first: Line of the first data row, counted from 1.
        width: Number of cells per row.
    """

    encoding: str
    separator: str
    names: tuple[str, ...]
    units: Mapping[str, str]
    header: int
    first: int
    width: int


def find_layout(path: Path) -> Layout:
    """Find the layout of a table from its first lines.

    Raises:
        InputError: The table has no rows, or its header has another number of cells than its rows.
    """
    with path.open("rb") as file:
        first_bytes = file.read(_HEAD_BYTES)
        is_complete = not file.read(1)
    encoding = _detect_encoding(path, first_bytes)
    lines = first_bytes.decode(encoding, errors="replace").splitlines()
    if not is_complete and len(lines) > 1:
        lines.pop()  # the last line is incomplete
    lines = lines[:_HEAD_LINES]
    if not any(line.strip() for line in lines):
        raise InputError(f"{path}: expected a table with a header and rows, found an empty file")
    data_lines = [line for line in lines if line.strip() and not COMMENT.match(line)]
    separator = _detect_separator(data_lines)
    rows = {
        n: _split_line(line, separator) for n, line in enumerate(lines, start=1) if line.strip()
    }
    width = _find_row_width([row for n, row in rows.items() if not COMMENT.match(lines[n - 1])])
    columns = _find_numeric_columns(rows.values(), width)
    first_data_line = next((n for n, row in rows.items() if _is_data(row, width, columns)), 0)
    rows_above = [n for n in rows if n < first_data_line] if first_data_line else list(rows)
    units_row: dict[int, str] = {}
    if (
        rows_above
        and first_data_line
        and (row_units := _parse_units(_normalise_row(rows[rows_above[-1]], width), columns))
    ):
        units_row = row_units
        rows_above.pop()
    for n in reversed(rows_above):
        names = _parse_header(lines[n - 1], separator, width, columns)
        if names is not None:
            units = {names[place]: unit for place, unit in units_row.items()}
            return Layout(encoding, separator, names, units, n, first_data_line or n + 1, width)
    if not first_data_line:
        first_line = format_value(lines[0].strip())
        raise InputError(f"{path}: expected a header and rows of numbers, found {first_line}")
    rows_above = [n for n in rows_above if not COMMENT.match(lines[n - 1])]
    if not rows_above and (column_numbers := _make_column_numbers(rows, first_data_line)):
        return Layout(
            encoding, separator, column_numbers, {}, first_data_line, first_data_line + 1, width
        )
    if rows_above and len(rows[rows_above[-1]]) > 1 and width > 1:
        n = rows_above[-1]
        raise InputError(
            f"{path}, row {n}: expected {width} names, one for each cell of row "
            f"{first_data_line}, found {len(rows[n])}; give each column a name"
        )
    return Layout(encoding, separator, (), {}, 0, first_data_line, width)


def _detect_encoding(path: Path, head: bytes) -> str:
    """Return the encoding of a text: UTF-8, UTF-16 with a byte order mark, or Windows-1252."""
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    if b"\0" in head:
        raise InputError(f"{path}: expected a table of text, found binary data")
    try:
        # Ignore the last line, which may be cut within a character.
        head[: head.rfind(b"\n") + 1 or None].decode("utf-8-sig")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def _split_line(line: str, separator: str) -> list[str]:
    """Split a line into its cells."""
    if separator == " ":
        return line.split()
    try:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:  # for example a quoted cell without end
        return [line]


def _detect_separator(lines: Sequence[str]) -> str:
    """Return the separator with which the largest share of the cells are numbers."""
    best, best_score = ",", (-1.0, 0.0)
    for separator in SEPARATORS:
        rows = [_split_line(line, separator) for line in lines]
        width = _find_row_width(rows)
        if width < 2:
            continue
        full_rows = [row for row in rows if len(row) == width]
        numeric = np.mean(
            [is_numeric(cell) for row in full_rows for cell in row if cell.strip()] or 0
        )
        score = (round(float(numeric) * len(full_rows) / len(rows), 6), float(width))
        if score > best_score:
            best, best_score = separator, score
    return best


def _find_row_width(rows: Sequence[Sequence[str]]) -> int:
    """Return the most frequent number of cells per row, including empty ones at the end."""
    counts = Counter(len(row) for row in rows)
    return max(counts, key=lambda count: (counts[count], count), default=0)


def _normalise_row(row: Sequence[str], width: int) -> list[str]:
    """Strip the cells of a row, and shorten or extend it to `width` cells."""
    return [cell.strip() for cell in [*row, *[""] * width][:width]]


def _find_numeric_columns(rows: Iterable[Sequence[str]], width: int) -> list[int]:
    """Return the positions of the columns in which at least half of the cells are numbers."""
    full_rows = [row for row in rows if len(row) == width]
    # The second half of the inspected rows is data, whatever precedes it.
    body = full_rows[len(full_rows) // 2 :]
    result = []
    for column in range(width):
        filled = [row[column] for row in body if row[column].strip()]
        if filled and 2 * sum(map(is_numeric, filled)) >= len(filled):
            result.append(column)
    return result


def _is_data(row: Sequence[str], width: int, columns: Sequence[int]) -> bool:
    """Return whether a row contains numbers rather than names, notes or units."""
    if len(row) != width:
        return False
    cells = [row[place].strip() for place in columns]
    numbers = [is_numeric(cell) for cell in cells]
    texts = [bool(cell) and not number for cell, number in zip(cells, numbers, strict=True)]
    return any(numbers) and (not any(texts) or numbers[0])


def _parse_header(
    line: str, separator: str, width: int, columns: Sequence[int]
) -> tuple[str, ...] | None:
    """Return the column names in a line; None if the line is not a header.

    Args:
        line: line before the first row of numbers.
        separator: separator of the rows.
        width: number of cells in a row.
        columns: positions of the columns with numbers, which must have names.
    """
    comment = COMMENT.match(line)
    # `%time,field.data` of rostopic begins with a name, `% t q1` of Matlab with a comment.
    is_comment = comment is not None and not re.match(r"%\w", line.strip())
    text = line[comment.end() :] if comment is not None and is_comment else line
    names = _split_line(text, separator)
    while len(names) > width and not names[-1].strip():
        names.pop()
    if len(names) != width and is_comment:
        # NumPy writes the header as given by the user, who may use a separator other than that of
        # the rows.
        for other_separator in SEPARATORS:
            parts = [part.strip() for part in _split_line(text, other_separator)]
            if len(parts) == width and all(map(_NAME.fullmatch, parts)):
                names = parts
    if len(names) != width:
        return None
    stripped_names = [name.strip(", ;\t" if separator == " " else None) for name in names]
    missing = sum(not stripped_names[place] for place in columns)
    numeric_names = [
        stripped_names[place] for place in columns if is_numeric(stripped_names[place])
    ]
    if missing > 1 or (columns and is_numeric(stripped_names[columns[0]])):
        return None
    # Joints may be numbered, `time,1,2,3`, but a note with a number is not a header, `Rate;100`.
    if not all(number.isdigit() for number in numeric_names) or len(set(numeric_names)) < len(
        numeric_names
    ):
        return None
    return tuple(stripped_names)


def _parse_units(row: Sequence[str], columns: Sequence[int]) -> dict[int, str]:
    """Return the units by position if a row contains units only; otherwise nothing."""
    units_by_place = {}
    for column in columns:
        text = row[column].strip("[](){}<> ") if row[column] else ""
        if not text:
            continue
        unit = read_unit(text)
        if unit is None or is_numeric(row[column]):
            return {}
        units_by_place[column] = unit[0]
    return units_by_place


def _make_column_numbers(rows: Mapping[int, Sequence[str]], first: int) -> tuple[str, ...]:
    """Return the column numbers that pandas writes for unnamed columns; otherwise nothing."""
    cells = tuple(cell.strip() for cell in rows[first])
    numbers = cells[1:] if cells and not cells[0] else cells
    counts = [tuple(str(start + k) for k in range(len(numbers))) for start in (0, 1)]
    if len(numbers) < 3 or numbers not in counts:
        return ()
    # A first row 0, 1, 2, ... may also be data, unless the following rows contain fractions.
    following_rows = [row for line, row in rows.items() if line > first]
    fractions = any("." in cell or "," in cell for row in following_rows for cell in row)
    return cells if fractions else ()


def is_numeric(cell: str) -> bool:
    """Return whether a cell holds a number, a list of numbers, a time or a missing-number mark."""
    text = cell.strip()
    if NUMBER.fullmatch(text) or text.lower() in NO_NUMBER:
        return True
    match = NUMBERS.fullmatch(text)
    if match:
        return all(map(NUMBER.fullmatch, match["inside"].replace(",", " ").split()))
    return INSTANT.fullmatch(text) is not None
