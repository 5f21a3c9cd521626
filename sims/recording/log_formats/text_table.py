"""Read text tables, as loggers and spreadsheets write them; the first lines tell their layout.

Comments and notes may precede the header, the header may be a comment itself (as NumPy writes it),
and a row of units may follow it. The separator is the one with which the largest share of the cells
are numbers.

Decimal commas are read where the separator or the cells of the file make them unambiguous. A cell
that does not fit its column is refused with the number of its row.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sims.core.simulator import Array, InputError, make_read_only
from sims.core.toml_validation import format_value
from sims.recording.log_formats.column_names import name_list_entries, name_numbered_columns
from sims.recording.log_formats.log_columns import MAX_COLUMNS, LogFile
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
        path: Path of the table.
        encoding: Encoding of the text.
        separator: One of `SEPARATORS`.
        names: Names of the columns; empty if the file has none.
        units: Unit of each column, from the row of units below the header.
        header: Line of the header, counted from 1; 0 if there is none.
        first: Line of the first data row, counted from 1.
        width: Number of cells per row.
    """

    path: Path
    encoding: str
    separator: str
    names: tuple[str, ...]
    units: Mapping[str, str]
    header: int
    first: int
    width: int


def find_layout(path: Path) -> Layout:
    """Find the layout of a table from its first lines.

    The separator is detected first, then the first row of numbers. The header is the last row above
    it that can be names; a row of units may lie in between. Without a header, the layout has no
    names, except if the first row is 0, 1, 2, ... as pandas writes it.

    Args:
        path: Path of the table.

    Raises:
        InputError: The table has no rows, or its header has another number of cells than its rows.
    """
    encoding, lines = _read_first_lines(path)
    # Lines are numbered from 1; 0 stands for no line. Blank lines are left out.
    text_by_line = {n: text for n, text in enumerate(lines, start=1) if text.strip()}
    comment_lines = {n for n, text in text_by_line.items() if COMMENT.match(text)}
    separator = _detect_separator(
        [text for n, text in text_by_line.items() if n not in comment_lines]
    )
    rows = {n: _split_line(text, separator) for n, text in text_by_line.items()}
    width = _find_row_width([row for n, row in rows.items() if n not in comment_lines])
    columns = _find_numeric_columns(rows.values(), width)  # positions of the columns of numbers
    first_data_line = next((n for n, row in rows.items() if _is_data(row, width, columns)), 0)
    lines_above = [n for n in rows if n < first_data_line] if first_data_line else list(rows)
    units_by_column: dict[int, str] = {}
    if lines_above and first_data_line:
        # Missing cells at the end of the row are empty.
        units_by_column = _parse_units([*rows[lines_above[-1]], *[""] * width], columns)
    if units_by_column:
        lines_above.pop()  # the row of units is not the header
    for n in reversed(lines_above):
        names = _parse_header(text_by_line[n], separator, width, columns)
        if names is not None:
            units = {names[column]: unit for column, unit in units_by_column.items()}
            # A table may end with its header.
            first = first_data_line or n + 1
            return Layout(path, encoding, separator, names, units, n, first, width)
    if not first_data_line:
        first_line = format_value(lines[0].strip())
        raise InputError(f"{path}: expected a header and rows of numbers, found {first_line}")
    lines_above = [n for n in lines_above if n not in comment_lines]
    if not lines_above:
        # The row of numbers itself may be the header; otherwise there are no names.
        column_numbers = _make_column_numbers(rows, first_data_line)
        header = first_data_line if column_numbers else 0
        first = first_data_line + 1 if column_numbers else first_data_line
        return Layout(path, encoding, separator, column_numbers, {}, header, first, width)
    n = lines_above[-1]
    if len(rows[n]) > 1 and width > 1:
        raise InputError(
            f"{path}, row {n}: expected {width} names, one for each cell of row "
            f"{first_data_line}, found {len(rows[n])}; give each column a name"
        )
    # The line above is a note.
    return Layout(path, encoding, separator, (), {}, 0, first_data_line, width)


def _read_first_lines(path: Path) -> tuple[str, list[str]]:
    """Return the encoding of a file and its first complete lines.

    At most `_HEAD_BYTES` bytes and `_HEAD_LINES` lines are read.

    Raises:
        InputError: the file is empty, or holds binary data.
    """
    with path.open("rb") as file:
        first_bytes = file.read(_HEAD_BYTES)
        is_complete = not file.read(1)
    encoding = _detect_encoding(path, first_bytes)
    lines = first_bytes.decode(encoding, errors="replace").splitlines()
    if not is_complete and len(lines) > 1:
        lines.pop()  # the last line may be cut
    lines = lines[:_HEAD_LINES]
    if not any(line.strip() for line in lines):
        raise InputError(f"{path}: expected a table with a header and rows, found an empty file")
    return encoding, lines


def _detect_encoding(path: Path, head: bytes) -> str:
    """Return the encoding of a text: UTF-8, UTF-16 with a byte order mark, or Windows-1252.

    Args:
        path: path of the file, for messages.
        head: first bytes of the file.

    Raises:
        InputError: the file holds binary data.
    """
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
    """Split a line into its cells.

    Args:
        line: text of the line.
        separator: one of `SEPARATORS`; a space stands for any white space.
    """
    if separator == " ":
        return line.split()
    try:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:  # for example a quoted cell without end
        return [line]


def _detect_separator(lines: Sequence[str]) -> str:
    """Return the separator with which the largest share of the cells are numbers.

    Only rows with the most frequent number of cells count: the share of numbers among their cells
    is multiplied by their share of all rows. Of equal shares, the separator with more columns wins.
    It is a comma if no separator gives several columns.

    Args:
        lines: First lines of the file, without comments and blank lines.
    """
    best, best_score = ",", (-1.0, 0.0)
    for separator in SEPARATORS:
        rows = [_split_line(line, separator) for line in lines]
        width = _find_row_width(rows)
        if width < 2:
            continue
        full_rows = [row for row in rows if len(row) == width]
        cells = [cell for row in full_rows for cell in row if cell.strip()]
        numeric_share = float(np.mean([is_numeric(cell) for cell in cells] or 0))
        # Rounded, so that equal shares are equal numbers.
        score = (round(numeric_share * len(full_rows) / len(rows), 6), float(width))
        if score > best_score:
            best, best_score = separator, score
    return best


def _find_row_width(rows: Sequence[Sequence[str]]) -> int:
    """Return the most frequent number of cells per row, including empty ones at the end.

    Of equally frequent numbers, it is the largest.
    """
    counts = Counter(len(row) for row in rows)
    return max(counts, key=lambda count: (counts[count], count), default=0)


def _find_numeric_columns(rows: Iterable[Sequence[str]], width: int) -> list[int]:
    """Return the positions of the columns in which at least half of the cells are numbers.

    Args:
        rows: cells of the first lines of the file.
        width: number of cells in a data row.
    """
    full_rows = [row for row in rows if len(row) == width]
    # The second half of the inspected rows is data, whatever precedes it.
    data_rows = full_rows[len(full_rows) // 2 :]
    numeric_columns = []
    for column in range(width):
        filled_cells = [row[column] for row in data_rows if row[column].strip()]
        if filled_cells and 2 * sum(map(is_numeric, filled_cells)) >= len(filled_cells):
            numeric_columns.append(column)
    return numeric_columns


def _is_data(row: Sequence[str], width: int, columns: Sequence[int]) -> bool:
    """Return whether a row contains numbers rather than names, notes or units.

    Of the cells in columns of numbers, some must be numbers, and either none a text or the first a
    number: a row of data may have a text where a reading failed.

    Args:
        row: cells of the row.
        width: number of cells in a data row.
        columns: positions of the columns that hold numbers.
    """
    if len(row) != width:
        return False
    cells = [row[column].strip() for column in columns]
    are_numbers = [is_numeric(cell) for cell in cells]
    has_text = any(cell and not is_numeric(cell) for cell in cells)
    return any(are_numbers) and (not has_text or are_numbers[0])


def _parse_header(
    line: str, separator: str, width: int, columns: Sequence[int]
) -> tuple[str, ...] | None:
    """Return the column names in a line; None if the line is not a header.

    A header may be a comment. It has a name for each cell of a row; at most one column of numbers
    may lack a name. Names may be numbers, except that of the first column of numbers, if they are
    different whole numbers.

    Args:
        line: line before the first row of numbers.
        separator: separator of the rows.
        width: number of cells in a row.
        columns: positions of the columns with numbers.
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
    required_names = [stripped_names[column] for column in columns]
    if required_names.count("") > 1 or (required_names and is_numeric(required_names[0])):
        return None
    # Joints may be numbered, `time,1,2,3`, but a note with a number is not a header, `Rate;100`.
    numeric_names = [name for name in required_names if is_numeric(name)]
    is_numbered = all(map(str.isdigit, numeric_names))
    if not is_numbered or len(set(numeric_names)) < len(numeric_names):
        return None
    return tuple(stripped_names)


def _parse_units(row: Sequence[str], columns: Sequence[int]) -> dict[int, str]:
    """Return the units by column if a row contains units only; otherwise an empty dictionary.

    Args:
        row: cells of the row below the header; some may be empty.
        columns: positions of the columns that hold numbers.
    """
    units_by_column = {}
    for column in columns:
        text = row[column].strip().strip("[](){}<> ")
        if not text:
            continue
        unit_and_quantity = read_unit(text)
        if unit_and_quantity is None or is_numeric(row[column]):
            return {}
        units_by_column[column], _ = unit_and_quantity
    return units_by_column


def _make_column_numbers(rows: Mapping[int, Sequence[str]], first: int) -> tuple[str, ...]:
    """Return the cells of the first row if they are column numbers, as pandas writes for no names.

    The numbers count from 0 or 1; the first cell is empty if pandas has written its index. The
    result is empty if the first row is anything else.

    Args:
        rows: cells of the first lines, by the number of the line.
        first: number of the first row.
    """
    cells = tuple(cell.strip() for cell in rows[first])
    numbers = cells[1:] if cells and not cells[0] else cells
    counts = [tuple(str(start + k) for k in range(len(numbers))) for start in (0, 1)]
    # One or two cells of data may well be such numbers.
    if len(numbers) < 3 or numbers not in counts:
        return ()
    # A first row 0, 1, 2, ... may also be data, unless the following rows contain fractions.
    following_rows = [row for line, row in rows.items() if line > first]
    has_fractions = any("." in cell or "," in cell for row in following_rows for cell in row)
    return cells if has_fractions else ()


def is_numeric(cell: str) -> bool:
    """Return whether a cell holds a number, a list of numbers, a time or a mark such as "nan".

    Args:
        cell: Text of a cell, such as "1.5", "[0.1, 0.2]", "2026-01-31T12:00:00" or "nan".
    """
    text = cell.strip()
    if NUMBER.fullmatch(text) or text.lower() in NO_NUMBER:
        return True
    match = NUMBERS.fullmatch(text)
    if match:
        return all(map(NUMBER.fullmatch, match["inside"].replace(",", " ").split()))
    return INSTANT.fullmatch(text) is not None


BOOLEAN_VALUES = {"true": 1.0, "false": 0.0}
"""Number for each text of a boolean, such as whether a drive is enabled."""


def read_text_table(path: Path) -> LogFile:
    """Read a text table of any layout as a log.

    The layout (separator, header, row of units) is found automatically. Columns without names of
    joints get those of other columns that hold such names.

    Args:
        path: Path of the table.

    Raises:
        InputError: The file is not a table, or a cell does not fit its column; the one-line message
            states the row.
    """
    layout = find_layout(path)
    named_cells = zip(_make_unique_names(layout), _read_cells(layout), strict=True)
    text_columns = [_TextColumn(layout, name, cells) for name, cells in named_cells]
    # One column may resolve an ambiguity of another: `1,234` is 1.234 in a file that has `0,5`.
    has_decimal_commas = any(column.has_decimal_commas for column in text_columns)
    columns: dict[str, Array] = {}
    texts: dict[str, list[str]] = {}
    for column in text_columns:
        values = column.convert_to_numbers(has_decimal_commas)
        if values is None:
            texts[column.name] = column.texts.tolist()
        else:
            columns[column.name] = make_read_only(values)
    named_columns, replaced_columns = name_numbered_columns(columns, texts)
    named_entries, replaced_lists = name_list_entries(columns, texts)
    return LogFile(
        path,
        {**columns, **named_columns, **named_entries},
        tuple(texts),
        rows="row",
        units=layout.units,
        unlisted=replaced_columns | replaced_lists,
        named=bool(layout.names),
        first=layout.first,
    )


def _make_unique_names(layout: Layout) -> list[str]:
    """Make the column names unique as pandas does: ``q``, ``q.1``, ``Unnamed: 3``.

    Args:
        layout: Layout of the table. Without names, columns are called ``column 1`` and so on.
    """
    names = layout.names or [f"column {column + 1}" for column in range(layout.width)]
    unique_names: list[str] = []
    for column, name in enumerate(names):
        unique_name = name or f"Unnamed: {column}"
        repetition = 1
        while unique_name in unique_names:
            unique_name, repetition = f"{name}.{repetition}", repetition + 1
        unique_names.append(unique_name)
    return unique_names


def _read_cells(layout: Layout) -> list[Any]:
    """Read the cells of each column as text, without comments and lines before the first row.

    Shapes: T rows.

    The file is read in the detected encoding, or as Windows-1252. Columns at the end that have no
    name and are empty throughout are dropped.

    Args:
        layout: layout of the table.

    Returns:
        For each column an array (T,) of texts, empty where a cell is missing.

    Raises:
        InputError: rows have different numbers of cells, or the text cannot be decoded.
    """
    import pandas

    separator = r"\s+" if layout.separator == " " else layout.separator
    for encoding in (layout.encoding, "cp1252"):
        try:
            with layout.path.open(encoding=encoding, newline="") as file:
                # Skipped here: a quotation mark in a note above the header would make pandas take
                # the rows for one cell.
                for _ in range(layout.first - 1):
                    next(file, "")
                table = pandas.read_csv(
                    file,
                    sep=separator,
                    header=None,
                    dtype=str,
                    keep_default_na=False,
                    skipinitialspace=True,
                )
            break
        except UnicodeDecodeError:  # a byte after the inspected head of the file
            continue
        except pandas.errors.EmptyDataError:
            return [np.array([], dtype=object)] * layout.width
        except (pandas.errors.ParserError, ValueError) as error:
            raise _find_uneven_row(layout) or _make_split_error(layout, error) from None
    else:  # neither encoding fits
        raise InputError(f"{layout.path}: expected UTF-8 text; save it as UTF-8")
    is_comment = table[0].str.match(COMMENT.pattern)
    if is_comment.any():
        table = table[~is_comment.to_numpy(dtype=bool)]
    # pandas fills up rows that are too short with empty cells.
    has_empty_end = (table[table.columns[-1]].fillna("") == "").any()
    if has_empty_end and (uneven_row := _find_uneven_row(layout)):
        raise uneven_row
    while table.shape[1] > layout.width and (table[table.columns[-1]].fillna("") == "").all():
        table = table.iloc[:, :-1]
    if table.shape[1] > MAX_COLUMNS:
        raise InputError(
            f"{layout.path}: expected at most {MAX_COLUMNS} columns, found {table.shape[1]}"
        )
    if table.shape[1] != layout.width:
        raise InputError(
            f"{layout.path}, row {layout.first}: expected {layout.width} cells, "
            f"found {table.shape[1]}"
        )
    return [table[name].fillna("").to_numpy(dtype=object) for name in table.columns]


def _make_split_error(layout: Layout, error: Exception) -> InputError:
    """Make the error for a file whose rows pandas cannot split, although each has enough cells.

    Args:
        layout: layout of the table.
        error: error of pandas.
    """
    quote_match = re.search(r"EOF inside string starting at row (\d+)", str(error))
    if quote_match:
        row = layout.first + int(quote_match[1])
        return InputError(
            f"{layout.path}, row {row}: a quotation mark opens a cell and none closes it; close or "
            "delete it"
        )
    return InputError(
        f"{layout.path}, row {layout.first}: expected rows of {layout.width} cells between commas, "
        "semicolons, tabs or blanks; save the file as CSV"
    )


def _find_uneven_row(layout: Layout) -> InputError | None:
    """Make the error for the first row with a wrong number of cells; None if all rows are even.

    Empty cells at the end of a row do not count. The message distinguishes an open quotation mark,
    a log that ends within a row, and any other row.

    Args:
        layout: layout of the table.
    """
    line = layout.first
    try:
        for line, last_line, row in _iterate_rows(layout):
            count = len(row)
            while count > layout.width and not row[count - 1].strip():
                count -= 1
            if count == layout.width:
                continue
            if last_line > line:  # a quoted cell contains a line end
                return InputError(
                    f"{layout.path}, row {line}: a quotation mark opens a cell that ends in row "
                    f"{last_line}; close or delete it"
                )
            reference = f"as in the header, row {layout.header}" if layout.header else "as above"
            # No row follows: the logger was probably stopped while it wrote this one.
            is_last = all(later <= line for later, *_ in _iterate_rows(layout))
            if count < layout.width and is_last:
                remedy = "the log is truncated there: delete this row"
            else:
                remedy = "correct or delete this row"
            return InputError(
                f"{layout.path}, row {line}: expected {layout.width} cells {reference}, "
                f"found {count}; {remedy}"
            )
    except csv.Error:  # such as a cell of more than 131,072 characters
        # `line` is that of the last row that could be read.
        return InputError(
            f"{layout.path}, row {line + 1}: expected cells of numbers or short texts, "
            "found a cell that is too long; is a quotation mark not closed?"
        )
    return None


def _iterate_rows(layout: Layout) -> Iterator[tuple[int, int, list[str]]]:
    """Iterate over the rows of data; skip comments and blank lines.

    Args:
        layout: layout of the table.

    Yields:
        Number of the first and of the last line of a row, and its cells. They are different lines
        if a quoted cell contains a line end.
    """
    with layout.path.open(encoding=layout.encoding, errors="replace", newline="") as file:
        if layout.separator == " ":
            for line, text in enumerate(file, start=1):
                if line >= layout.first and text.strip() and not COMMENT.match(text):
                    yield line, line, text.split()
            return
        for _ in range(layout.first - 1):
            next(file, "")
        reader = csv.reader(file, delimiter=layout.separator, skipinitialspace=True)
        previous_line = layout.first - 1
        for row in reader:
            last_line = layout.first - 1 + reader.line_num
            if any(row) and not COMMENT.match(row[0]):
                yield previous_line + 1, last_line, row
            previous_line = last_line


def _find_line(layout: Layout, record: int) -> int:
    """Return the line of a data row, counted from 1 as in an editor.

    Args:
        layout: layout of the table.
        record: number of the data row, counted from 0 without comments and blank lines.
    """
    for number, (line, *_) in enumerate(_iterate_rows(layout)):
        if number == record:
            return line
    return layout.first + record


MAX_SAMPLED_CELLS = 1000
"""Maximum number of cells with commas per column inspected to distinguish text from numbers."""


class _TextColumn:
    """Cells of one column of a text table and the kind of numbers that they hold."""

    def __init__(self, layout: Layout, name: str, cells: Any) -> None:
        """Find out whether commas in a column are decimal commas or thousands separators.

        Shapes: T rows.

        If most of the sampled cells with a comma are not numbers, the column holds lists or
        text, and its commas have no meaning (`has_commas` is False). Otherwise they are decimal
        commas, thousands separators, or ambiguous if neither is set. `series` has the cells
        without blanks around them, and `filled` those that are not empty.

        Args:
            layout: Layout of the table.
            name: Name of the column.
            cells: (T,) text of each cell.
        """
        import pandas

        self.layout, self.name = layout, name
        self.cells = cells
        self.series = pandas.Series(cells, dtype=object).astype(str).str.strip()
        self.texts = self.series.to_numpy(dtype=object)
        self.filled = self.series[self.series != ""]
        self.has_commas, self.has_decimal_commas, self.is_thousands = False, False, False
        commas = self.filled[self.filled.str.contains(",", regex=False)]
        sampled_cells = commas.iloc[:: max(len(commas) // MAX_SAMPLED_CELLS, 1)]
        # Lists and texts may contain commas, too.
        number_count = sum(map(bool, map(NUMBER.fullmatch, sampled_cells)))
        if commas.empty or 2 * number_count < len(sampled_cells):
            return
        self.has_commas = True
        # Several commas in a cell, or a point after a comma, as in 1,234,567 and 1,234.5.
        is_grouped = (commas.str.count(",") > 1) | commas.str.contains(r",.*\.", regex=True)
        self.is_thousands = bool(is_grouped.any())
        if self.layout.separator != ",":
            self.has_decimal_commas = not self.is_thousands
        else:
            # Where commas also separate cells, 1,234 may be a group of thousands, unless other
            # cells show decimals.
            may_be_groups = commas.str.fullmatch(r"[+-]?[1-9]\d{0,2}(,\d{3})+(\.\d*)?")
            self.has_decimal_commas = not bool(may_be_groups.all()) and not self.is_thousands

    def convert_to_numbers(self, file_has_decimal_commas: bool) -> Array | None:
        """Convert the cells to numbers.

        Shapes: T rows.

        The first cell that is not empty decides the kind: Boolean values, lists, dates or numbers.
        Empty cells, and marks such as "nan", are missing numbers (NaN). If more than half of the
        cells are not numbers, the column counts as text.

        Args:
            file_has_decimal_commas: Whether some column of the file has decimal commas.

        Returns:
            Numbers (T,), or (T, k) for lists of k numbers; None if the column holds text.

        Raises:
            InputError: A cell is not a number, or its comma is ambiguous.
        """
        import pandas

        if self.filled.empty:
            return np.full(len(self.series), np.nan)
        first = self.filled.iloc[0]
        if first.lower() in BOOLEAN_VALUES:
            switches = self.series.str.lower().map({**BOOLEAN_VALUES, "": np.nan})
            # With any other cell, the column is text, or has a wrong cell, which is found below.
            if bool(((self.series == "") | switches.notna()).all()):
                return np.asarray(switches, dtype=np.float64)
        if NUMBERS.fullmatch(first) and is_numeric(first):
            return self._convert_lists()
        if INSTANT.fullmatch(first):
            return self._convert_dates()
        texts = self.series
        if self.has_commas:
            if self.has_decimal_commas or (file_has_decimal_commas and not self.is_thousands):
                texts = self._convert_decimal_commas()
            elif self.is_thousands:
                texts = texts.str.replace(",", "", regex=False)
            else:
                row = int(np.flatnonzero(texts.str.contains(",", regex=False))[0])
                raise self._make_cell_error(row, "a number with a decimal point",
                    "; its comma may divide decimals or thousands",
                )  # fmt: skip
        values = pandas.to_numeric(texts.where(texts != "", "nan"), errors="coerce")
        result = np.asarray(values, dtype=np.float64)
        is_missing = (texts == "") | texts.str.lower().isin(NO_NUMBER)
        bad_rows = np.flatnonzero(np.isnan(result) & ~is_missing.to_numpy(dtype=bool))
        if bad_rows.size == 0:
            return result
        if bad_rows.size > 0.5 * len(self.filled):
            return None
        raise self._make_cell_error(int(bad_rows[0]), "a number")

    def _convert_decimal_commas(self) -> Any:
        """Return the cells with decimal points instead of decimal commas.

        Some cells may contain points, too:

        * If a cell has a point before a comma, as in 1.234,5, points before three digits separate
          thousands and are removed.
        * Otherwise a cell with a point is an error: with a decimal comma, 1.234 is more than a
          thousand; with a decimal point, it is about one.

        Raises:
            InputError: points without commas leave the meaning of a cell open.
        """
        if self.filled.str.contains(r"\..*,", regex=True).any():
            texts = self.series.str.replace(r"\.(?=\d{3}(\D|$))", "", regex=True)
            return texts.str.replace(",", ".", n=1, regex=False)
        has_point = self.filled.str.contains(".", regex=False)
        if not has_point.any():
            return self.series.str.replace(",", ".", n=1, regex=False)
        first_row, *_ = has_point.index.to_numpy()[has_point.to_numpy()]
        is_grouped = self.filled[has_point].str.fullmatch(r"[+-]?\d{1,3}(\.\d{3})+(,\d*)?")
        expected = "a number without a point" if is_grouped.all() else "a decimal comma"
        note = "; other cells of this column have decimal commas"
        raise self._make_cell_error(int(first_row), expected, note)

    def _convert_dates(self) -> Array | None:
        """Convert times such as ``2026-11-26 17:24:01.123`` to (T,) seconds since 1970.

        Shapes: T rows.

        Empty cells become NaN.

        Raises:
            InputError: a cell is not a time.
        """
        import pandas

        empty = (self.series == "").to_numpy(dtype=bool)
        texts = self.series.str.replace(",", ".", regex=False).str.replace("UTC", "Z", regex=False)
        is_instant = self.series.str.fullmatch(INSTANT.pattern).to_numpy(dtype=bool) | empty
        if not is_instant.all():
            row = int(np.flatnonzero(~is_instant)[0])
            raise self._make_cell_error(row, f"an instant as {self.filled.iloc[0]}")
        stamps = pandas.to_datetime(
            texts.where(texts != "", None), utc=True, format="ISO8601", errors="coerce"
        )
        nanoseconds = stamps.astype("datetime64[ns, UTC]").astype("int64").to_numpy(dtype=np.int64)
        return np.where(stamps.isna().to_numpy(), np.nan, nanoseconds * 1e-9)

    def _convert_lists(self) -> Array:
        """Convert cells such as ``[0.1, 0.2]`` to an array (T, k): T cells with k numbers each.

        Raises:
            InputError: a cell is not a list, or has another length than the first one.
        """
        number_lists: list[list[float]] = []
        expected = "a list of numbers"
        for row, text in enumerate(self.texts):
            number_list = _parse_number_list(text)
            if number_list is None or len(number_list) > MAX_COLUMNS:
                raise self._make_cell_error(row, expected)
            if row > 0 and len(number_list) != len(number_lists[0]):
                raise self._make_cell_error(row, expected)
            number_lists.append(number_list)
            expected = f"a list of {len(number_lists[0])} numbers"
        return np.array(number_lists, dtype=np.float64).reshape(len(number_lists), -1)

    def _make_cell_error(self, record: int, expected: str, note: str = "") -> InputError:
        """Make the error for a cell that does not fit its column.

        Args:
            record: number of the row of data, counted from 0.
            expected: expected content in words.
            note: addition at the end of the message.
        """
        line = _find_line(self.layout, record)
        cell_text = format_value(self.cells[record])
        return InputError(
            f"{self.layout.path}, row {line}, column {self.name}: expected {expected}, "
            f"found {cell_text}{note}"
        )


def _parse_number_list(text: str) -> list[float] | None:
    """Return the numbers of a cell such as ``[0.1, 0.2]``; None if it is not such a list."""
    match = NUMBERS.fullmatch(text)
    if match is None:
        return None
    try:
        return [float(part) for part in match["inside"].replace(",", " ").split()]
    except ValueError:
        return None
