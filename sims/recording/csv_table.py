"""Read the table `NAME.csv` of a recording, fast if it is faultless; errors state row and column.

Tables with anything unusual are left to the slower reader, which inspects each cell.

Rows are lines of the file, counted from 1 with the header, as in an editor.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import islice, pairwise, takewhile
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from sims.core.files import require_file
from sims.core.number_limits import MAX_TIMESTAMP_SECONDS, MIN_RUN_SECONDS
from sims.core.simulator import Array, InputError, make_read_only, similar
from sims.core.toml_validation import format_value
from sims.core.user_messages import MAX_NAME_LENGTH

MIN_FAST_PARSE_BYTES = 1 << 20
"""Minimum size in bytes of a table for which importing the fast parser is worthwhile."""


def read_csv_fast(
    path: Path, header: Sequence[str], column_names: Sequence[str], gaps: Collection[str]
) -> tuple[list[str], dict[str, Array]] | None:
    """Read the run names and the numeric columns of a CSV table with pyarrow.

    Shapes: T rows.

    It gives up where cells are quoted, or a number is missing or not finite, so that the slow
    reader, which inspects each cell, can locate the error.

    Args:
        path: Table whose first line is its header.
        header: Checked names of its columns, including ``run``.
        column_names: Names of the numeric columns to read.
        gaps: Names of those columns whose cells may be empty (NaN).

    Returns:
        Name of the run of each row, and the numeric columns (T,) by name; None if anything in the
        table is unusual.
    """
    import pyarrow as arrow
    from pyarrow import csv

    types = {"run": arrow.string()}
    types |= {name: arrow.float64() for name in column_names}
    try:
        table = csv.read_csv(
            path,
            # Use one thread, because there is already one worker process per core.
            csv.ReadOptions(column_names=list(header), skip_rows=1, use_threads=False),
            # Quotes may hide commas and line ends; such tables are left to the other reader.
            csv.ParseOptions(quote_char=False),
            csv.ConvertOptions(
                column_types=types,
                null_values=[""],
                strings_can_be_null=False,
            ),
        )
    except (arrow.ArrowException, OSError):
        return None
    columns: dict[str, Array] = {}
    for name in column_names:
        cells = table[name]
        values = cells.to_numpy()
        # An empty cell is NaN and allowed in a gap; NaN or inf written as text is not.
        allowed_gaps = cells.null_count if name in gaps else 0
        if np.count_nonzero(~np.isfinite(values)) != allowed_gaps:
            return None
        columns[name] = values
    # Each different name is converted once.
    runs = table["run"].combine_chunks().dictionary_encode()
    names = [str(name).strip() for name in runs.dictionary.to_pylist()]
    if any('"' in name for name in names):
        return None
    return [names[code] for code in runs.indices.to_numpy().tolist()], columns


_ROWS_PER_CHUNK = 1 << 13
"""Number of rows that are converted to numbers at once, which limits the memory for their text."""
_MAX_NAMES = 12
"""Maximum number of names in a message."""
_SECONDS_PER_YEAR = 365.25 * 86400
"""Seconds per year."""
_NUMBER_PATTERN = re.compile(r"\s*[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?\s*")
"""Pattern of a number as instruments write it, without `inf` or `1_000`, which float() accepts."""


class CsvRun(NamedTuple):
    """Rows of one run.

    Attributes:
        name: Name of the run.
        times: (T,) times, in the unit of the table.
        columns: Other columns by name, each (T,); NaN where missing.
        notes: Remarks on rows that were left out.
    """

    name: str
    times: Array
    columns: dict[str, Array]
    notes: tuple[str, ...] = ()


def read_table(
    path: Path, channels: Sequence[str], inputs: Sequence[str], extra: Sequence[str] = ()
) -> list[CsvRun]:
    """Read the runs of a table in order of appearance.

    Args:
        path: Path of the table.
        channels: Names of the measured signals; cells may be empty.
        inputs: Names of the inputs; no cell may be empty.
        extra: Names of other columns; cells may be empty.

    Raises:
        InputError: The table is malformed; the message is one line.
    """
    require_file(path)
    try:
        return RecordingTable(path, channels, inputs, extra).read()
    except UnicodeDecodeError:
        raise _make_encoding_error(path) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


def has_run_column(path: Path) -> bool:
    """Return whether the header of a table has the column `run`, as tables of simgap have."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            return "run" in file.readline().strip().split(",")
    except (OSError, UnicodeDecodeError):
        return False


def _make_encoding_error(path: Path) -> InputError:
    """Make the error for a table that is not UTF-8.

    The message names the row of the first invalid byte, or UTF-16 if the file is in that encoding.

    Args:
        path: Table that cannot be decoded.
    """
    data = path.read_bytes()
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):  # byte order marks
        return InputError(f"{path}: expected UTF-8 text, found UTF-16; save it as UTF-8")
    try:
        data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row, byte = data.count(b"\n", 0, error.start) + 1, data[error.start]
        return InputError(
            f"{path}, row {row}: expected UTF-8 text, found the byte 0x{byte:02x}; save it as UTF-8"
        )
    return InputError(f"{path}: expected UTF-8 text")


class RecordingTable:
    """Table of a CSV file, and the checks of runs that apply to every kind of table."""

    def __init__(
        self, path: Path, channels: Sequence[str], inputs: Sequence[str], extra: Sequence[str]
    ) -> None:
        """Name the expected columns; `gaps` are those whose cells may be empty.

        Args:
            path: Path of the table, for messages.
            channels: Names of the measured signals; cells may be empty.
            inputs: Names of the inputs; no cell may be empty.
            extra: Names of other columns; cells may be empty.
        """
        self.path = path
        self.signals = [*inputs, *channels, *extra]
        self.numeric = ["t", *self.signals]
        self.wanted = ["run", *self.numeric]
        self.gaps = {*channels, *extra}
        self.channels, self.inputs = channels, inputs

    def read(self) -> list[CsvRun]:
        """Return the runs of the file.

        Large files are parsed by a fast reader first. If it gives up, or the name of a run is too
        long, the file is read cell by cell, to locate the error.
        """
        records = self._iterate_records()
        header = self._check_header(next(records, []))
        parsed = None
        if self.path.stat().st_size >= MIN_FAST_PARSE_BYTES:
            parsed = read_csv_fast(self.path, header, self.numeric, self.gaps)
        if parsed is not None:
            names, columns = parsed
            if max(map(len, set(names)), default=0) <= MAX_NAME_LENGTH:
                return self.split_into_runs(names, columns)
        return self.split_into_runs(*self._convert_cells(header, records))

    def _convert_cells(
        self, header: list[str], records: Iterator[list[str]]
    ) -> tuple[list[str], dict[str, Array]]:
        """Convert the rows below the header to run names and numeric columns (T,).

        Shapes: T rows.

        Rows are converted in blocks, so that the texts of a long table are never all in memory.

        Args:
            header: Names of the columns.
            records: Cells of each row below the header.

        Returns:
            Name of the run of each row, and the numeric columns by name.
        """
        names: list[str] = []
        blocks: dict[str, list[Array]] = {name: [np.empty(0)] for name in self.numeric}
        while rows := list(islice(records, _ROWS_PER_CHUNK)):
            first_row = len(names)
            # A log that was cut ends with an incomplete row, whose message would hide those of the
            # rows before it, so these are converted first.
            complete_rows = list(takewhile(lambda row: len(row) == len(header), rows))
            if complete_rows:
                cells = dict(zip(header, zip(*complete_rows, strict=True), strict=True))
                for name, numbers in blocks.items():
                    numbers.append(self._convert_to_numbers(name, cells[name], first_row))
                names += [name.strip() for name in cells["run"]]
            if len(complete_rows) < len(rows):
                incomplete_row = rows[len(complete_rows)]
                raise self._make_row_width_error(incomplete_row, len(header), len(names))
        return names, {name: np.concatenate(numbers) for name, numbers in blocks.items()}

    def _iterate_records(self) -> Iterator[list[str]]:
        """Iterate over header and rows; skip blank lines.

        Raises:
            InputError: The file is not a CSV table, such as with a quotation mark that is not
                closed.
        """
        with self.path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True, skipinitialspace=True)
            try:
                yield from (row for row in reader if row)
            except csv.Error as error:
                raise InputError(
                    f"{self.path}, row {reader.line_num}: not a CSV table: {error}"
                ) from None

    def _check_header(self, cells: list[str]) -> list[str]:
        """Check the names of the columns against the declared ones, and return them.

        Every declared column must exist, and no other column may: a forgotten signal must not be
        ignored silently.

        Args:
            cells: Cells of the first row.

        Returns:
            Names without spaces around them.

        Raises:
            InputError: A column is missing, unnamed, given twice or not declared, or the separator
                is not a comma.
        """
        header = [cell.strip() for cell in cells]
        # A single column is most likely due to another separator.
        if len(header) < 2:
            text = "".join(header)
            if ";" in text:
                found_text = "semicolons (save it with commas)"
            elif "\t" in text:
                found_text = "tabs (save it with commas)"
            else:
                found_text = format_value(text)
            raise InputError(
                f"{self.path}, row 1: expected columns {', '.join(self.wanted)} between commas, "
                f"found {found_text}"
            )
        for index, name in enumerate(header):
            if not name:
                raise InputError(f"{self.path}, row 1: column {index + 1} has no name")
            if name in header[:index]:
                raise InputError(f"{self.path}, row 1: column {format_value(name)} is given twice")
        for name in self.wanted:
            if name not in header:
                raise self.make_missing_column_error(name, header)
        for name in header:
            if name not in self.wanted:
                description = self.path.with_suffix(".toml").name
                raise InputError(
                    f"{self.path}: column {format_value(name)} is not declared; {description} "
                    f"declares {_join_names(self.signals)}; add it with its unit under "
                    "[inputs], [channels] or, if nothing reads it, [extra]"
                )
        return header

    def make_missing_column_error(self, name: str, found: Sequence[str]) -> InputError:
        """Make the error for a missing column, which lists the columns of the table.

        It suggests the most similar one of those that the description does not declare.

        Args:
            name: name of the missing column.
            found: names of the columns of the table.
        """
        hint = similar(name, [column for column in found if column not in self.wanted])
        return InputError(
            f"{self.path}: expected column '{name}', found columns {_join_names(found)}{hint}"
        )

    def _make_row_width_error(self, row: Sequence[str], width: int, record: int) -> InputError:
        """Make the error of a row that has another number of cells than the header.

        Args:
            row: Cells of the row.
            width: Number of cells of the header.
            record: Number of the row, counted from 0 below the header.
        """
        return InputError(
            f"{self.path}, row {self._find_line_number(record)}: "
            f"expected {width} cells as in the header, found {len(row)}; correct or delete the row"
        )

    def _convert_to_numbers(self, name: str, cells: Sequence[str], first_row: int) -> Array:
        """Convert the cells of a column to numbers (T,); empty ones to NaN where gaps are allowed.

        Shapes: T rows.

        Python's `float` converts all cells at once. Cells that it converts to something not finite,
        or that it accepts but an instrument would not write, are checked one by one.

        Args:
            name: Name of the column.
            cells: Text of each cell.
            first_row: Number of the first of these rows, counted from 0 below the header.

        Raises:
            InputError: A cell is not a finite number, nor an empty one in a column with gaps.
        """
        try:
            values = np.array(list(map(float, cells)))
        except ValueError:
            values = np.array(
                [float(c) if _NUMBER_PATTERN.fullmatch(c) else math.nan for c in cells]
            )
        suspect_indices: Iterable[int] = np.flatnonzero(~np.isfinite(values)).tolist()
        joined_cells = "".join(cells)
        # float() also accepts 1_000 and digits of other scripts.
        if "_" in joined_cells or not joined_cells.isascii():
            suspect_indices = range(len(cells))
        for row_index in suspect_indices:
            if cells[row_index].strip() or name not in self.gaps:
                self._check_cell(name, cells[row_index], first_row + row_index)
        return values

    def _check_cell(self, name: str, cell: str, record: int) -> None:
        """Check that a cell holds a finite number.

        Args:
            name: name of the column.
            cell: text of the cell.
            record: number of the row, counted from 0 without the header.

        Raises:
            InputError: the cell does not; the message states its row and column.
        """
        if not (_NUMBER_PATTERN.fullmatch(cell) and math.isfinite(float(cell))):
            note = ""
            if name in self.gaps:
                note = "; leave the cell empty if the sample is missing"
            elif name in self.inputs and not cell.strip():
                note = "; an input has no missing samples"
            self.raise_error(
                record, name, f"expected a finite number, found {format_value(cell)}{note}"
            )

    def split_into_runs(self, names: list[str], columns: dict[str, Array]) -> list[CsvRun]:
        """Split the rows into runs, each a block of rows with the same name, and check them.

        The checks concern the name of each run, its number of rows, its samples, and its times.

        Args:
            names: Name of the run of each of the T rows.
            columns: Times ``t`` and all other columns by name, each (T,); NaN where a cell is
                empty.

        Raises:
            InputError: There are no rows; a run has no name, too few rows or no sample; or time
                does not increase.
        """
        if not names:
            raise InputError(f"{self.path}: expected rows of data, found none")
        for name in self.channels:
            if np.isnan(columns[name]).all():
                raise InputError(f"{self.path}: column {name} has no sample; leave the channel out")
        # `edges` are the first row of each run, and the number of rows.
        changes = [row for row in range(1, len(names)) if names[row] != names[row - 1]]
        edges = [0, *changes, len(names)]
        self._check_times_increase(columns["t"], edges)
        runs: dict[str, CsvRun] = {}
        for begin, end in pairwise(edges):
            name = names[begin]
            if not name:
                self.raise_error(begin, "run", "expected the name of a run, found none")
            if len(name) > MAX_NAME_LENGTH:
                expected = f"a name of at most {MAX_NAME_LENGTH} characters"
                self.raise_error(begin, "run", f"expected {expected}, found {format_value(name)}")
            if name in runs:
                self.raise_error(
                    begin,
                    "run",
                    f"run {format_value(name)} continues after another run began; "
                    "expected its rows together",
                )
            signals = {c: make_read_only(columns[c][begin:end]) for c in self.signals}
            if end - begin < 2:
                self.raise_error(
                    begin, "run", f"run {format_value(name)} has one row; expected at least two"
                )
            if not any(np.isfinite(signals[c]).any() for c in self.channels):
                self.raise_error(
                    begin,
                    self.channels[0],
                    f"run {format_value(name)} has no sample of any channel",
                )
            self._check_seconds(columns["t"], begin, end - 1)
            runs[name] = CsvRun(name, make_read_only(columns["t"][begin:end]), signals)
        return list(runs.values())

    def _check_seconds(self, t: Array, first: int, last: int) -> None:
        """Check that the stamps of a run can be seconds, and not a smaller unit.

        Shapes: N rows.

        The latest stamp and the duration of the run must be plausible.

        Args:
            t: (N,) time stamps of all rows of the table.
            first: index of the first row of the run.
            last: index of its last row.
        """
        latest = max(-t[first], t[last])  # largest magnitude, since times increase
        if latest > MAX_TIMESTAMP_SECONDS:
            years = f"{latest:.4g}, which would be {latest / _SECONDS_PER_YEAR:.2g} years"
            self.raise_error(
                last, "t", f"expected seconds, found {years}; are these milliseconds or less?"
            )
        duration = t[last] - t[first]
        if duration < MIN_RUN_SECONDS:
            self.raise_error(last, "t", f"expected seconds, found a run of {duration:.3g} s")

    def _check_times_increase(self, t: Array, edges: list[int]) -> None:
        """Check that the times increase within each run.

        Shapes: T rows.

        Args:
            t: (T,) times of all rows, s.
            edges: First row of each run, and the number of rows.

        Raises:
            InputError: A time does not exceed the previous one of its run.
        """
        is_bad = t[1:] <= t[:-1]
        # A run may begin earlier than the previous one ended.
        run_starts = np.array(edges[1:-1], dtype=int)
        is_bad[run_starts - 1] = False
        if is_bad.any():
            row_index = int(np.argmax(is_bad))
            self.raise_error(
                row_index + 1,
                "t",
                f"expected more than {t[row_index]:.12g} s, found {t[row_index + 1]:.12g} s",
            )

    def raise_error(self, record: int, column: str, message: str) -> NoReturn:
        """Raise the error for a cell.

        Args:
            record: Number of the row, counted from 0.
            column: Name of the column.
            message: Expected and found content of the cell.

        Raises:
            InputError: Always.
        """
        raise InputError(f"{self.format_location(record)}, column {column}: {message}")

    def format_location(self, record: int) -> str:
        """Return the location of row `record` (counted from 0) for a message."""
        return f"{self.path}, row {self._find_line_number(record)}"

    def _find_line_number(self, record: int) -> int:
        """Return the line of the file on which a row ends, counted from 1; reads the file again.

        Args:
            record: number of the row, counted from 0 below the header, without blank lines.
        """
        with self.path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True, skipinitialspace=True)
            with suppress(csv.Error):  # the fast reader accepts such cells
                next(islice((row for row in reader if row), record + 1, None))
            return reader.line_num


def _join_names(names: Sequence[str]) -> str:
    """Join names for a message; only the first `_MAX_NAMES` of many."""
    text = ", ".join(names[:_MAX_NAMES])
    if len(names) > _MAX_NAMES:
        text += f" and {len(names) - _MAX_NAMES} more"
    return text
