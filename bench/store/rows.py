"""Rows of runs, as runs.parquet and the parts of a journal hold them: read batch by batch, every
cell checked, and every run whole.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.problem.experiment import Experiment
from bench.store.cells import CellError, Mask, check, columns_of, mask_of, of_parquet
from bench.store.schema import OF_A_RUN, RUNS, Column, channels_in, parameters_in, spelled
from sims.base import InputError
from sims.files import first_line

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

_BATCH = 131_072
"""Rows that are checked at a time: all columns of many would fill memory."""


class RunsFile(NamedTuple):
    """A file of runs.

    Attributes:
        path: the file.
        remedy: what to do where it is damaged.
    """

    path: Path
    remedy: str

    def fault(self, row: int | None, says: str) -> InputError:
        """The error for a row, counted from 0; or for the file."""
        place = "" if row is None else f", row {row}"
        return InputError(f"{self.path}{place}: {says}; {self.remedy}")

    def names(self) -> list[str]:
        """Its columns.

        Raises:
            InputError: it is no Parquet file.
        """
        from pyarrow import ArrowException, parquet

        try:
            return list(parquet.read_schema(self.path).names)
        # Of damaged bytes even the names of columns may be no text.
        except (OSError, ArrowException, UnicodeDecodeError) as error:
            raise self._unreadable(error) from None

    def runs(
        self, experiment: Experiment, records: Sequence[pa.Table] | None = None
    ) -> pd.DataFrame:
        """A line a run, in the order of the file: what is the same in all its rows, the ``row`` at
        which it begins, and ``used``, its last k.

        Args:
            experiment: whose runs they are.
            records: what has been read already, of a file that is no Parquet file.

        Raises:
            InputError: the file is damaged, in one line.
        """
        import pyarrow as pa

        try:
            if records is None:
                return checked_runs(self._batches(), self.names(), experiment)
            whole = pa.concat_tables(records)
            return checked_runs([whole], whole.column_names, experiment)
        except CellError as error:
            raise self.fault(error.row, error.says) from None
        except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
            raise self._unreadable(error) from None

    def _batches(self) -> Iterator[pa.Table]:
        import pyarrow as pa
        from pyarrow import parquet

        with parquet.ParquetFile(self.path) as file:
            for batch in file.iter_batches(_BATCH):
                yield pa.Table.from_batches([batch])

    def _unreadable(self, error: Exception) -> InputError:
        missing = isinstance(error, FileNotFoundError)
        what = "no such file" if missing else f"expected a Parquet file, found {first_line(error)}"
        return InputError(f"{self.path}: not a complete comparison: {what}; {self.remedy}")


def declared(names: list[str], experiment: Experiment) -> list[Column]:
    """The columns of the runs of an experiment: its parameters and channels are those that the file
    speaks of, and those that the experiment names.
    """
    parameters = dict.fromkeys([*parameters_in(names), *experiment.parameters])
    channels = experiment.observe or channels_in(names)
    columns = spelled(RUNS, parameters or ["PARAMETER"], channels or ["CHANNEL"])
    # Of one parameter the error is there in its own unit too.
    return [c for c in columns if c.name != "param_abs_error" or len(parameters) == 1]


def checked_runs(
    batches: Iterable[pa.Table], names: list[str], experiment: Experiment
) -> pd.DataFrame:
    """A line a run; see `RunsFile.runs`.

    Raises:
        CellError: something is not what it is declared to be.
    """
    import pandas as pd

    # Where no run was made there are no columns either.
    there = columns_of(names, declared(names, experiment)) if names else []
    told: list[pd.DataFrame] = []
    before: pa.Table | None = None
    offset = 0
    for batch in batches:
        if not len(batch):
            continue
        rows = _checked(batch, there, before, offset)
        told.append(_begun(rows, before is not None, offset))
        offset += len(batch)
        before = rows.slice(len(rows) - 1)
    runs = (
        pd.concat(told, ignore_index=True)
        if told
        else pd.DataFrame(columns=["run", *OF_A_RUN, "row"])
    )
    # k counts without a gap, so that the number of rows tells the last one.
    runs["used"] = np.diff(np.append(runs["row"].to_numpy(dtype=np.int64), offset)) - 1
    twice = runs["run"].duplicated().to_numpy(dtype=bool)
    if twice.any():
        place = int(twice.argmax())
        name = runs["run"].iloc[place]
        raise CellError(int(runs["row"].iloc[place]), "run", "every run once", f"{name} again")
    return runs


def _checked(
    batch: pa.Table, there: list[Column], before: pa.Table | None, offset: int
) -> pa.Table:
    """The batch in its declared types, behind the last row of the one before.

    Raises:
        CellError: a cell is not what it is declared to be, or a run is not whole.
    """
    import pyarrow as pa
    from pyarrow import compute

    try:
        typed = {c.name: of_parquet(c, batch[c.name].combine_chunks()) for c in there}
        at_start = typed["k"].to_numpy() == 0
        no_truth = mask_of(compute.equal(typed["range"], "real"))
        for column in there:
            check(column, typed[column.name], at_start, no_truth)
    except CellError as error:
        row = None if error.row is None else error.row + offset
        raise _moved(error, row) from None
    rows = pa.table(typed)
    rows = rows if before is None else pa.concat_tables([before, rows]).combine_chunks()
    try:
        _check_counts(rows, before is not None)
        _check_same(rows)
    except CellError as error:
        raise _moved(error, (error.row or 0) + offset - (before is not None)) from None
    return rows


def _moved(error: CellError, row: int | None) -> CellError:
    error.row = row
    return error


def _new(rows: pa.Table) -> Mask:
    """(n,) where a run begins; the first row is taken for such a place."""
    return np.append(True, _changes(rows["run"]))


def _changes(values: pa.ChunkedArray) -> Mask:
    """(n - 1,) where a value is not the one before it; nothing is the same as nothing."""
    import pyarrow as pa
    from pyarrow import compute

    column = values.combine_chunks()
    if pa.types.is_floating(column.type):
        numbers = column.to_numpy()
        nothing = np.isnan(numbers[1:]) & np.isnan(numbers[:-1])
        differ: Mask = (numbers[1:] != numbers[:-1]) & ~nothing
        return differ
    changed = compute.not_equal(column.slice(1), column.slice(0, max(len(column) - 1, 0)))
    return mask_of(changed)


def _check_counts(rows: pa.Table, goes_on: bool) -> None:
    """See that k counts 0, 1, 2, ... in every run."""
    k: NDArray[np.int64] = rows["k"].to_numpy()
    wanted = np.append(0, k[:-1] + 1)
    wanted[_new(rows)] = 0
    if goes_on:  # the first row is known, whatever its k
        wanted[0] = k[0]
    bad = k != wanted
    if bad.any():
        row = int(bad.argmax())
        run = rows["run"][row].as_py()
        raise CellError(row, "k", f"{wanted[row]}, the next of {run}", str(k[row]))


def _described(rows: pa.Table) -> list[str]:
    """The columns that are the same in all rows of a run."""
    names = rows.column_names
    return [name for name in names if name in OF_A_RUN or name.startswith("true_")]


def _check_same(rows: pa.Table) -> None:
    """See that what describes a run is the same in all its rows."""
    within = ~_new(rows)[1:]
    for name in _described(rows):
        bad = _changes(rows[name]) & within
        if bad.any():
            row = int(bad.argmax()) + 1
            values = rows[name].slice(row - 1, 2).to_pylist()
            raise CellError(row, name, f"{values[0]} as in the row before", str(values[1]))


def _begun(rows: pa.Table, goes_on: bool, offset: int) -> pd.DataFrame:
    """A line for each run that begins in these rows."""
    new = _new(rows)
    if goes_on:
        new[0] = False
    places = np.flatnonzero(new)
    keys = rows.select(["run", *_described(rows)])
    told: pd.DataFrame = keys.take(places).to_pandas()
    return told.assign(row=places + offset - goes_on)
