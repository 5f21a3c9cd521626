"""Read the CSV files of a result folder, runs batch by batch, and check every cell.

Rows of runs are those of runs.parquet and of a journal.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.storage.cell_validation import (
    CellError,
    Mask,
    check_cells,
    parse_csv_column,
    parse_parquet_column,
    select_declared_columns,
    to_numpy_mask,
)
from bench.benchmark.storage.table_schemas import (
    RUN_COLUMNS,
    RUN_CONSTANT_COLUMNS,
    Columns,
    ColumnSpec,
    expand_columns,
    list_channels,
    list_parameters,
)
from sims.core.files import get_first_line
from sims.core.simulator import InputError

if TYPE_CHECKING:
    import pandas as pd
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
        line = "" if row is None else f", line {self._get_line_number(row)}"
        return InputError(f"{self._path}{line}: {problem}; {self._remedy}")

    def _read_text(self) -> str:
        """Read the file as text, without the byte order mark that Excel writes at the beginning.

        Raises:
            InputError: the file is missing, empty or not UTF-8.
        """
        problem = f"{self._path}: not a complete comparison"
        try:
            file_content = self._path.read_bytes()
        except OSError as error:
            raise InputError(f"{problem}: {error.strerror}; {self._remedy}") from None
        if not file_content.strip():
            raise InputError(f"{problem}: expected a CSV file, found an empty one; {self._remedy}")
        try:
            return file_content.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            line = file_content[: error.start].count(b"\n") + 1
            reason = f"expected UTF-8 text, found byte {file_content[error.start]:#04x}"
            raise InputError(f"{self._path}, line {line}: {reason}; {self._remedy}") from None

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
                raise InputError(f"{self._path}, line {number}: {reason}; {self._remedy}")

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
            raise InputError(
                f"{self._path}, line {first_line}: expected cells, found {error}; {self._remedy}"
            ) from None

    def _get_line_number(self, row: int) -> int:
        """Return the line number of a row; the first record is the header."""
        lines = (
            number for index, (number, _) in enumerate(self._iterate_records()) if index == row + 1
        )
        # A file without this row has no line for it; the number is that of a file of single lines.
        return next(lines, row + 2)


class RunsTable(NamedTuple):
    """A file of runs.

    Attributes:
        path: Path of the file.
        remedy: Advice for a damaged file.
        rows: Rows that were read already, for a file that is not Parquet; otherwise None.
        first_row: Number of the first of these rows in the file.
    """

    path: Path
    remedy: str
    rows: pa.Table | None = None
    first_row: int = 0

    def make_error(self, row: int | None, problem: str) -> InputError:
        """Make the error for a row, counted from 0, or for the whole file.

        Args:
            row: Row, or None for the file.
            problem: What is wrong.
        """
        row_text = "" if row is None else f", row {self.first_row + row}"
        return InputError(f"{self.path}{row_text}: {problem}; {self.remedy}")

    def read_runs(self, experiment: Experiment) -> pd.DataFrame:
        """Check all rows, and return one line per run, in the order of the file.

        Each line has the columns that are constant within the run, ``row``, at which it begins, and
        ``used``, its last k. Columns are read one by one, since all of many rows would not fit in
        memory.

        Args:
            experiment: Experiment of the runs.

        Raises:
            InputError: The file is damaged; the message is one line.
        """
        import pyarrow as pa
        from pyarrow import parquet

        try:
            if self.rows is not None:
                return _read_checked_runs(self.rows.select, self.rows.column_names, experiment)
            with parquet.ParquetFile(self.path) as file:
                names = list(file.schema_arrow.names)
                return _read_checked_runs(
                    lambda columns: file.read(columns=columns), names, experiment
                )
        except CellError as error:
            raise self.make_error(error.row, error.says) from None
        # In a damaged file even the names of columns may be invalid text.
        except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
            raise self._make_read_error(error) from None

    def _make_read_error(self, error: Exception) -> InputError:
        """Make the one-line error for a file that is missing, or is not a Parquet file."""
        missing = isinstance(error, FileNotFoundError)
        reason = (
            "no such file" if missing else f"expected a Parquet file, found {get_first_line(error)}"
        )
        return InputError(f"{self.path}: not a complete comparison: {reason}; {self.remedy}")


def declare_run_columns(names: list[str], experiment: Experiment) -> list[ColumnSpec]:
    """Return the columns that the runs of an experiment must have, with their types and limits.

    Some columns exist once for each parameter or channel: those that the names of the file's
    columns contain and those of the experiment. If there are none, these columns keep the
    placeholder PARAMETER or CHANNEL of `table_schemas` in their names.

    Args:
        names: Names of the file's columns.
        experiment: Content of the experiment's TOML file: simulator, tuners, targets and budget.
    """
    parameters = dict.fromkeys([*list_parameters(names), *experiment.parameters])
    channels = experiment.observe or list_channels(names)
    columns = expand_columns(RUN_COLUMNS, parameters or ["PARAMETER"], channels or ["CHANNEL"])
    # A single parameter also has its error in its own unit.
    return [c for c in columns if c.name != "param_abs_error" or len(parameters) == 1]


def _read_checked_runs(
    read_columns: Callable[[list[str]], pa.Table], names: list[str], experiment: Experiment
) -> pd.DataFrame:
    """Check rows of runs and return one line per run; see `RunsTable.read_runs`.

    A run has one row for each number of simulations k, in consecutive rows.

    Args:
        read_columns: Reads columns by their names.
        names: Names of the columns.
        experiment: Experiment of the runs.

    Returns:
        One line per run: its constant columns, ``row``, at which it begins, and ``used``, its last
        k.

    Raises:
        CellError: A cell or a run violates its declaration.
    """
    import pandas as pd
    import pyarrow as pa
    from pyarrow import compute

    if not names:  # Without runs there are no columns.
        return pd.DataFrame(columns=["run", *RUN_CONSTANT_COLUMNS, "row", "used"])
    columns = select_declared_columns(names, declare_run_columns(names, experiment))
    declared = {column.name: column for column in columns}

    def read(name: str) -> pa.Array:
        return parse_parquet_column(declared[name], read_columns([name])[name])

    run, k = read("run"), read("k").to_numpy()
    is_recording = to_numpy_mask(compute.equal(read("range"), "real"))
    is_run_start = np.ones(len(k), dtype=bool)
    is_run_start[1:] = _find_changes(run)
    _check_counts(run, k, is_run_start)
    rows = np.flatnonzero(is_run_start)
    constants = {"run": run.take(rows)}
    for name, column in declared.items():
        values = read(name)
        check_cells(column, values, k == 0, is_recording)
        if name in RUN_CONSTANT_COLUMNS or name.startswith("true_"):
            _check_constant(name, values, ~is_run_start[1:])
            constants[name] = values.take(rows)
    # k counts without gaps, so the number of rows gives the last k.
    used = np.diff(np.append(rows, len(k))) - 1
    runs: pd.DataFrame = pa.table(constants).to_pandas().assign(row=rows, used=used)
    is_repeated = runs["run"].duplicated().to_numpy(dtype=bool)
    if is_repeated.any():
        repeated = int(is_repeated.argmax())
        name = runs["run"][repeated]
        raise CellError(int(rows[repeated]), "run", "every run once", f"{name} again")
    return runs


def _find_changes(values: pa.Array) -> Mask:
    """Return an (n - 1,) mask of values that differ from the previous one; NaN equals NaN."""
    import pyarrow as pa
    from pyarrow import compute

    if pa.types.is_floating(values.type):
        numbers = values.to_numpy()
        is_both_missing = np.isnan(numbers[1:]) & np.isnan(numbers[:-1])
        is_changed: Mask = (numbers[1:] != numbers[:-1]) & ~is_both_missing
        return is_changed
    return to_numpy_mask(compute.not_equal(values[1:], values[:-1]))


def _check_counts(run: pa.Array, k: NDArray[np.int64], is_run_start: Mask) -> None:
    """Check that k, the number of simulations, counts 0, 1, 2, ... in the rows of every run.

    Raises:
        CellError: k has another value, so that a row is missing or added.
    """
    # The value of the row before plus one; the first row, to which `roll` wraps around, is a start.
    expected = np.where(is_run_start, 0, np.roll(k, 1) + 1)
    is_wrong = k != expected
    if is_wrong.any():
        row = int(is_wrong.argmax())
        raise CellError(row, "k", f"{expected[row]}, the next of {run[row].as_py()}", str(k[row]))


def _check_constant(name: str, values: pa.Array, is_same_run: Mask) -> None:
    """Check that a column that describes a run, such as tuner and target, is constant within it.

    Args:
        name: Name of the column.
        values: (n,) values, in which the rows of a run follow each other.
        is_same_run: (n - 1,) mask of rows that belong to the run of the row before.

    Raises:
        CellError: a value differs from the row before.
    """
    is_changed = _find_changes(values) & is_same_run
    if is_changed.any():
        row = int(is_changed.argmax()) + 1
        before, found = values[row - 1].as_py(), values[row].as_py()
        raise CellError(row, name, f"{before} as in the row before", str(found))
