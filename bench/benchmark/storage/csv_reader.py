"""Read the CSV files of a result folder, runs batch by batch, and check every cell.

Rows of runs are those of runs.parquet and of the parts of a journal.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
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
        self._header = next(self._iterate_records(), (1, []))[1]
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
        place = "" if row is None else f", line {self._get_line_number(row)}"
        return InputError(f"{self._path}{place}: {problem}; {self._remedy}")

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
        """Read every cell as text."""
        import pyarrow as pa
        from pyarrow import csv as arrow

        data = self._text.encode()
        texts = {name: pa.large_string() for name in self._header}
        try:
            return arrow.read_csv(
                pa.BufferReader(data),
                # One block, since a text cell may be longer than any block.
                arrow.ReadOptions(block_size=min(len(data) + 1, 2**31 - 1), use_threads=False),
                arrow.ParseOptions(newlines_in_values=True),
                arrow.ConvertOptions(column_types=texts, null_values=[], strings_can_be_null=False),
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
            number for place, (number, _) in enumerate(self._iterate_records()) if place == row + 1
        )
        return next(lines, row + 2)


_BATCH_ROWS = 131_072
"""Number of rows checked at a time; all columns of many rows would not fit in memory."""


class RunsTable(NamedTuple):
    """A file of runs.

    Attributes:
        path: Path of the file.
        remedy: Advice for a damaged file.
    """

    path: Path
    remedy: str

    def make_error(self, row: int | None, problem: str) -> InputError:
        """Make the error for a row, counted from 0, or for the whole file.

        Args:
            row: Row, or None for the file.
            problem: What is wrong.
        """
        place = "" if row is None else f", row {row}"
        return InputError(f"{self.path}{place}: {problem}; {self.remedy}")

    def list_columns(self) -> list[str]:
        """List the columns of the file.

        Raises:
            InputError: It is not a Parquet file.
        """
        from pyarrow import ArrowException, parquet

        try:
            return list(parquet.read_schema(self.path).names)
        # In a damaged file even the names of columns may be invalid text.
        except (OSError, ArrowException, UnicodeDecodeError) as error:
            raise self._make_read_error(error) from None

    def read_runs(
        self, experiment: Experiment, records: Sequence[pa.Table] | None = None
    ) -> pd.DataFrame:
        """Read one line per run, in the order of the file.

        Each line has the columns that are constant within the run, ``row``, at which it begins, and
        ``used``, its last k.

        Args:
            experiment: Experiment of the runs.
            records: Tables that were read before, for a file that is not Parquet.

        Raises:
            InputError: The file is damaged; the message is one line.
        """
        import pyarrow as pa

        try:
            if records is None:
                return read_checked_runs(self._read_batches(), self.list_columns(), experiment)
            table = pa.concat_tables(records)
            return read_checked_runs([table], table.column_names, experiment)
        except CellError as error:
            raise self.make_error(error.row, error.says) from None
        except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
            raise self._make_read_error(error) from None

    def _read_batches(self) -> Iterator[pa.Table]:
        """Yield the rows of the Parquet file in batches of at most `_BATCH_ROWS` rows."""
        import pyarrow as pa
        from pyarrow import parquet

        with parquet.ParquetFile(self.path) as file:
            for batch in file.iter_batches(_BATCH_ROWS):
                yield pa.Table.from_batches([batch])

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


def read_checked_runs(
    batches: Iterable[pa.Table], names: list[str], experiment: Experiment
) -> pd.DataFrame:
    """Check rows of runs and return one line per run; see `RunsTable.read_runs`.

    A run has one row for each number of simulations k, in consecutive rows. The rows come in
    batches that may divide a run, so each batch is checked together with the last row before it.

    Args:
        batches: The rows, as consecutive tables.
        names: Names of the columns.
        experiment: Experiment of the runs.

    Raises:
        CellError: A cell or a run violates its declaration.
    """
    import pandas as pd

    # Without runs there are no columns.
    columns = (
        select_declared_columns(names, declare_run_columns(names, experiment)) if names else []
    )
    summaries: list[pd.DataFrame] = []
    last_row: pa.Table | None = None
    offset = 0
    for batch in batches:
        if not len(batch):
            continue
        rows = _convert_batch(batch, columns, last_row, offset)
        summaries.append(_summarise_new_runs(rows, last_row is not None, offset))
        offset += len(batch)
        last_row = rows.slice(len(rows) - 1)
    runs = (
        pd.concat(summaries, ignore_index=True)
        if summaries
        else pd.DataFrame(columns=["run", *RUN_CONSTANT_COLUMNS, "row"])
    )
    # k counts without gaps, so the number of rows gives the last k.
    runs["used"] = np.diff(np.append(runs["row"].to_numpy(dtype=np.int64), offset)) - 1
    is_repeated = runs["run"].duplicated().to_numpy(dtype=bool)
    if is_repeated.any():
        place = int(is_repeated.argmax())
        name = runs["run"].iloc[place]
        raise CellError(int(runs["row"].iloc[place]), "run", "every run once", f"{name} again")
    return runs


def _convert_batch(
    batch: pa.Table, columns: list[ColumnSpec], last_row: pa.Table | None, offset: int
) -> pa.Table:
    """Convert a batch of rows to its declared types, check it, and prepend the last row before it.

    That row is needed to check a run that begins in one batch and continues in the next. Errors
    name the row of the whole file.

    Args:
        batch: rows as text.
        columns: declarations of the columns.
        last_row: last row of the previous batch; None for the first batch.
        offset: number of rows before this batch.

    Raises:
        CellError: A cell violates its declaration, or a run is incomplete.
    """
    import pyarrow as pa
    from pyarrow import compute

    try:
        typed = {c.name: parse_parquet_column(c, batch[c.name].combine_chunks()) for c in columns}
        at_start = typed["k"].to_numpy() == 0
        is_recording = to_numpy_mask(compute.equal(typed["range"], "real"))
        for column in columns:
            check_cells(column, typed[column.name], at_start, is_recording)
    except CellError as error:
        row = None if error.row is None else error.row + offset
        raise _shift_error_row(error, row) from None
    batch_rows = pa.table(typed)
    batch_rows = (
        batch_rows
        if last_row is None
        else pa.concat_tables([last_row, batch_rows]).combine_chunks()
    )
    try:
        _check_counts(batch_rows, last_row is not None)
        _check_same(batch_rows)
    except CellError as error:
        raise _shift_error_row(error, (error.row or 0) + offset - (last_row is not None)) from None
    return batch_rows


def _shift_error_row(error: CellError, row: int | None) -> CellError:
    error.row = row
    return error


def _find_run_starts(rows: pa.Table) -> Mask:
    """Return an (n,) mask of rows where a run begins, including the first row."""
    return np.append(True, _find_changes(rows["run"]))


def _find_changes(values: pa.ChunkedArray) -> Mask:
    """Return an (n - 1,) mask of values that differ from the previous one; NaN equals NaN."""
    import pyarrow as pa
    from pyarrow import compute

    column = values.combine_chunks()
    if pa.types.is_floating(column.type):
        numbers = column.to_numpy()
        is_both_missing = np.isnan(numbers[1:]) & np.isnan(numbers[:-1])
        is_changed: Mask = (numbers[1:] != numbers[:-1]) & ~is_both_missing
        return is_changed
    changed = compute.not_equal(column.slice(1), column.slice(0, max(len(column) - 1, 0)))
    return to_numpy_mask(changed)


def _check_counts(rows: pa.Table, goes_on: bool) -> None:
    """Check that k, the number of simulations, counts 0, 1, 2, ... in the rows of every run.

    `goes_on` is True if the first row is the last one of the batch before; it was checked there.

    Raises:
        CellError: k has another value, so that a row is missing or added.
    """
    k: NDArray[np.int64] = rows["k"].to_numpy()
    expected = np.append(0, k[:-1] + 1)
    expected[_find_run_starts(rows)] = 0
    if goes_on:
        expected[0] = k[0]
    is_wrong = k != expected
    if is_wrong.any():
        row = int(is_wrong.argmax())
        run = rows["run"][row].as_py()
        raise CellError(row, "k", f"{expected[row]}, the next of {run}", str(k[row]))


def _list_constant_columns(rows: pa.Table) -> list[str]:
    """List the columns that are constant within a run."""
    names = rows.column_names
    return [name for name in names if name in RUN_CONSTANT_COLUMNS or name.startswith("true_")]


def _check_same(rows: pa.Table) -> None:
    """Check that the columns that describe a run are constant within it.

    These are columns such as tuner and target, which are repeated in each row of the run.

    Args:
        rows: Table in which the rows of a run follow each other.

    Raises:
        CellError: a value differs from the row before.
    """
    is_same_run = ~_find_run_starts(rows)[1:]
    for name in _list_constant_columns(rows):
        is_changed = _find_changes(rows[name]) & is_same_run
        if is_changed.any():
            row = int(is_changed.argmax()) + 1
            values = rows[name].slice(row - 1, 2).to_pylist()
            raise CellError(row, name, f"{values[0]} as in the row before", str(values[1]))


def _summarise_new_runs(rows: pa.Table, goes_on: bool, offset: int) -> pd.DataFrame:
    """Return one line for each run that begins in these rows, a batch of a larger file.

    A line has the values that are constant within the run, and in ``row`` the row of the file at
    which it begins. `goes_on` is True if the first row is the last one of the batch before, which
    begins no run. `offset` is the number of rows before the batch.
    """
    new = _find_run_starts(rows)
    if goes_on:
        new[0] = False
    places = np.flatnonzero(new)
    keys = rows.select(["run", *_list_constant_columns(rows)])
    summary: pd.DataFrame = keys.take(places).to_pandas()
    return summary.assign(row=places + offset - goes_on)
