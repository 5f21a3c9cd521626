"""Read the CSV files of a result folder, and check every cell."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from bench.benchmark.storage.cell_validation import (
    CellError,
    check_cells,
    make_table_error,
    parse_csv_column,
    select_declared_columns,
)
from bench.benchmark.storage.table_schemas import Columns
from sims.core.files import get_first_line
from sims.core.simulator import InputError

if TYPE_CHECKING:
    import pyarrow as pa


ColumnResolver = Callable[[list[str]], Columns]
"""Returns the declared columns of a file for its header."""


class CsvTable:
    """A CSV file whose cells fit their declarations.

    Attributes:
        table: Declared columns that the file has.

    Raises:
        InputError: The file is damaged; the message is one line.
    """

    def __init__(self, path: Path, columns: Columns | ColumnResolver, remedy: str) -> None:
        """Read and check the whole file; a wrong cell becomes an error that names its line.

        Args:
            path: The file.
            columns: Declared columns, or a function that returns them for a file's header.
            remedy: Advice for a damaged file.
        """
        self._path, self._remedy = path, remedy
        self._text = self._read_text()
        _, self._header = next(self._iterate_records(), (1, []))
        declared = columns(self._header) if callable(columns) else columns
        try:
            present_columns = select_declared_columns(self._header, declared)
            self.table = self._convert_columns(present_columns)
        except CellError as error:
            raise self.make_error(error.row, error.says) from None

    def make_error(self, row: int | None, problem: str) -> InputError:
        """Make the error for a row, counted from 0, or for the whole file.

        Args:
            row: Row, or None for the file.
            problem: What is wrong.
        """
        if row is not None:
            return self._make_line_error(self._get_line_number(row), problem)
        return make_table_error(self._path, None, problem, self._remedy)

    def _make_line_error(self, line: int, problem: str) -> InputError:
        """Make the error for a line of the file, counted from 1."""
        return make_table_error(self._path, f"line {line}", problem, self._remedy)

    def _read_text(self) -> str:
        """Read the file as text, without the byte order mark that Excel writes at the beginning.

        Raises:
            InputError: the file is missing, empty or not UTF-8.
        """
        problem = "not a complete comparison"
        try:
            file_content = self._path.read_bytes()
        except OSError as error:
            raise self.make_error(None, f"{problem}: {error.strerror}") from None
        if not file_content.strip():
            raise self.make_error(None, f"{problem}: expected a CSV file, found an empty one")
        try:
            return file_content.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            line = file_content[: error.start].count(b"\n") + 1
            reason = f"expected UTF-8 text, found byte {file_content[error.start]:#04x}"
            raise self._make_line_error(line, reason) from None

    def _convert_columns(self, columns: Columns) -> pa.Table:
        """Convert the cells of the declared columns from text to their types, and check them.

        `columns` are the declared columns that the file has.
        """
        import pyarrow as pa

        texts = self._read_cells()
        typed = {}
        for column in columns:
            values = parse_csv_column(column, texts[column.name].combine_chunks())
            check_cells(column, values)
            typed[column.name] = values
        return pa.table(typed)

    def _read_cells(self) -> pa.Table:
        """Read every cell as text.

        Raises:
            InputError: the text cannot be split into rows with the cells of the header.
        """
        import pyarrow as pa
        from pyarrow import csv as arrow

        data = self._text.encode()
        text_types = {name: pa.large_string() for name in self._header}
        try:
            return arrow.read_csv(
                pa.BufferReader(data),
                # One block, since a text cell may be longer than any block.
                arrow.ReadOptions(block_size=min(len(data) + 1, 2**31 - 1), use_threads=False),
                arrow.ParseOptions(newlines_in_values=True),
                # No text means a missing value; an empty cell stays an empty text.
                arrow.ConvertOptions(
                    column_types=text_types, null_values=[], strings_can_be_null=False
                ),
            )
        except pa.ArrowException as error:
            self._refuse_ragged()
            raise self.make_error(
                None, f"expected a CSV file, found {get_first_line(error)}"
            ) from None

    def _refuse_ragged(self) -> None:
        """Raise an error for the first line whose number of cells differs from the header's."""
        for number, cells in self._iterate_records():
            if len(cells) != len(self._header):
                reason = f"expected {len(self._header)} cells, found {len(cells)}"
                raise self._make_line_error(number, reason)

    def _iterate_records(self) -> Iterator[tuple[int, list[str]]]:
        """Yield the cells of every record with its first line number, without blank lines.

        Raises:
            InputError: A record cannot be split into cells.
        """
        reader = csv.reader(io.StringIO(self._text, newline=""), strict=True)
        first_line = 1
        try:
            for cells in reader:
                if len(cells) > 1 or "".join(cells).strip():
                    yield first_line, cells
                first_line = reader.line_num + 1
        except csv.Error as error:
            raise self._make_line_error(first_line, f"expected cells, found {error}") from None

    def _get_line_number(self, row: int) -> int:
        """Return the line number of a row; the first record is the header."""
        lines = (
            number for index, (number, _) in enumerate(self._iterate_records()) if index == row + 1
        )
        # A file without this row has no line for it; the number is that of a file of single lines.
        return next(lines, row + 2)
