"""Crash-safe journal of finished runs, and its segment files while a comparison is unfinished.

The folder ``segments`` of an unfinished comparison contains ``plan.txt`` (the id of every run, in
order), ``NNNNNN.journal`` (records that are being appended) and ``NNNNNN.parquet`` (parts of many
records). A part is written next to its journal, renamed, and only then is the journal deleted; if
both are found, the part contains everything. A record that was cut off by a kill fails its checksum
and is dropped: its run was not finished. Appended records survive the end of any process; a crash
of the machine may lose the runs since the last part.
"""

from __future__ import annotations

import json
import shutil
import struct
import zlib
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from bench.benchmark.storage import cell_validation
from bench.benchmark.storage.cell_validation import CellError
from bench.benchmark.storage.run_status import STATUS_COLUMN_NAMES, RunStatus
from bench.benchmark.storage.table_schemas import STATUS_COLUMNS, ColumnSpec
from sims.core.files import atomic_replacement, get_first_line, open_locked, write_atomically
from sims.core.simulator import InputError

if TYPE_CHECKING:
    import pyarrow as pa


SEGMENTS_FOLDER = "segments"
"""Name of the folder of segments in the folder of an unfinished comparison."""
PLAN_FILE = "plan.txt"
"""Name of the file of the plan, which lists the id of every run."""
PLAN_REMEDY = "restore it, or delete it and resume the comparison, which writes it again"
"""Advice for a damaged plan."""
_RECORD_HEADER = struct.Struct(">4sII")
"""Head of a record: mark, length of the content, checksum of the content."""
_RECORD_MARK = b"run\n"
"""Mark at the beginning of a record."""
SEGMENT_REMEDY = "restore it, or delete it and resume the comparison: the runs are repeated"
"""Advice for a damaged segment."""
_PLAN_INDEX = ColumnSpec("place in the plan", int, low=0, high=2.0**31)


def encode_record(plan_index: int, status: RunStatus, rows: pa.Table) -> bytes:
    """Encode a finished run as a record of a journal, with a checksum.

    A record is a header (mark, length, checksum) and the rows of the run as an Arrow stream, in
    whose metadata are the index and the status.

    Args:
        plan_index: Index of the run in the plan.
        status: How the run ended.
        rows: Rows of the run.
    """
    import pyarrow as pa

    sink = pa.BufferOutputStream()
    head = json.dumps([plan_index, asdict(status)])
    rows = rows.replace_schema_metadata({"status": head})
    with pa.ipc.new_stream(sink, rows.schema) as stream:
        stream.write_table(rows)
    packed: bytes = sink.getvalue().to_pybytes()
    return _RECORD_HEADER.pack(_RECORD_MARK, len(packed), zlib.crc32(packed)) + packed


def read_records(path: Path) -> Iterator[tuple[int, RunStatus, pa.Table, int]]:
    """Yield every complete record of a journal: plan index, status, rows and end offset in bytes.

    A process that was killed may have left an incomplete record at the end. It is detected by its
    length and checksum, and reading stops before it.

    Raises:
        InputError: a record is complete but damaged.
    """
    import pyarrow as pa

    data, end = path.read_bytes(), 0
    while end + _RECORD_HEADER.size <= len(data):
        record_mark, length, checksum = _RECORD_HEADER.unpack_from(data, end)
        payload = data[end + _RECORD_HEADER.size : end + _RECORD_HEADER.size + length]
        if record_mark != _RECORD_MARK or len(payload) < length or zlib.crc32(payload) != checksum:
            return
        end += _RECORD_HEADER.size + length
        try:
            rows = pa.ipc.open_stream(payload).read_all()
            statuses = _convert_statuses([json.loads(rows.schema.metadata[b"status"])])
        except _DAMAGE_ERRORS as error:
            raise _make_damage_error(path, f"a record of a run: {get_first_line(error)}") from None
        ((plan_index, status),) = statuses.items()
        yield plan_index, status, rows.replace_schema_metadata(), end


def read_part_statuses(path: Path) -> dict[int, RunStatus]:
    """Read the statuses of a part, by index in the plan, from its footer.

    Raises:
        InputError: The file is damaged.
    """
    from pyarrow import parquet

    try:
        return _convert_statuses(json.loads(parquet.read_schema(path).metadata[b"statuses"]))
    except _DAMAGE_ERRORS as error:
        raise _make_damage_error(
            path, f"a part of a comparison, found damage: {get_first_line(error)}"
        ) from None


_DAMAGE_ERRORS = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    CellError,
    RecursionError,
    NotImplementedError,
)
"""Errors that reading a damaged segment may raise; they include Arrow's own errors."""


def _convert_statuses(entries: Any) -> dict[int, RunStatus]:
    """Convert ``[[index, {column: value}], ...]`` to statuses by index, checking every cell.

    The index is the place of the run in the plan.

    Args:
        entries: JSON list from the footer of a file.

    Raises:
        CellError: A value violates its declaration.
    """
    plan_indices = cell_validation.parse_json_column(_PLAN_INDEX, [index for index, _ in entries])
    cell_validation.check_cells(_PLAN_INDEX, plan_indices)
    columns = [c for c in STATUS_COLUMNS if c.name in STATUS_COLUMN_NAMES]
    for column in columns:
        values = [status[column.name] for _, status in entries]
        cell_validation.check_cells(column, cell_validation.parse_json_column(column, values))
    return {
        plan_index: RunStatus(**{name: status[name] for name in STATUS_COLUMN_NAMES})
        for plan_index, status in entries
    }


def _make_damage_error(path: Path, expected: str) -> InputError:
    return InputError(f"{path}: expected {expected}; {SEGMENT_REMEDY}")


def check_no_duplicate_runs(
    path: Path, plan_indices: Iterable[int], known_indices: Container[int]
) -> None:
    """Reject runs that another file contains already.

    Raises:
        InputError: A run is in both.
    """
    if repeated_indices := [index for index in plan_indices if index in known_indices]:
        raise _make_damage_error(
            path, f"every run once, found that of line {repeated_indices[0] + 1} of the plan again"
        )


def list_segments(folder: Path, ending: str) -> list[Path]:
    """List the segment files with an extension, in order.

    Args:
        folder: Folder of segments.
        ending: File extension without dot.

    Raises:
        InputError: The name of a file is not a number.
    """
    paths = sorted(folder.glob(f"*.{ending}"))
    for path in paths:
        if not (path.stem.isascii() and path.stem.isdigit()):
            raise InputError(f"{path}: expected a name such as 000001.{ending}; move it elsewhere")
    return paths


def read_statuses_by_file(folder: Path) -> Iterator[tuple[Path, dict[int, RunStatus]]]:
    """Yield the statuses of the finished runs of a study, by index in the plan, by file.

    Files are journals of single runs, and parts, into which full journals are converted. Another
    process may do this at the same time, so a journal may disappear, or its runs come twice.

    Raises:
        InputError: A file is damaged.
    """
    # Journals first: a journal that becomes a part in the meantime is then found among the parts.
    for path in list_segments(folder / SEGMENTS_FOLDER, "journal"):
        with suppress(FileNotFoundError):
            yield path, {index: status for index, status, _, _ in read_records(path)}
    known_indices: set[int] = set()
    for path in list_segments(folder / SEGMENTS_FOLDER, "parquet"):
        statuses = read_part_statuses(path)
        check_no_duplicate_runs(path, statuses, known_indices)
        known_indices.update(statuses)
        yield path, statuses


def write_plan(folder: Path, ids: Sequence[str]) -> None:
    """Write the id of every run, in the order of the plan."""
    write_atomically(folder / SEGMENTS_FOLDER / PLAN_FILE, "".join(f"{name}\n" for name in ids))


def read_plan(folder: Path) -> list[str] | None:
    """Read the ids of the plan; None if there is no plan yet.

    Raises:
        InputError: It is damaged.
    """
    path = folder / SEGMENTS_FOLDER / PLAN_FILE
    try:
        return path.read_text(encoding="utf-8").splitlines() if path.is_file() else None
    except ValueError:
        raise InputError(
            f"{path}: expected the ids of the runs as UTF-8 text, found other bytes; {PLAN_REMEDY}"
        ) from None


RUNS_PER_PART = 1000
"""Number of records that are combined into a part."""


class RunJournal:
    """Journal of the finished runs of a comparison; opening it recovers earlier records.

    Attributes:
        statuses: Statuses of all finished runs, by index in the plan.

    Raises:
        InputError: Another process is working in the folder, or a part is damaged.
    """

    def __init__(self, folder: Path, part_runs: int = RUNS_PER_PART) -> None:
        """Lock the folder against other processes, and recover all runs that it contains.

        Runs are appended to a journal; a journal of `part_runs` runs is converted to a part, a
        compressed file. `_index` are the plan indices of the runs in each part, `_records` the runs
        in the current journal, and `_number` the number of this journal. What a killed process has
        left is repaired: an incomplete part is deleted, and so is a journal whose part exists.
        """
        self.folder = folder / SEGMENTS_FOLDER
        try:
            self.folder.mkdir(exist_ok=True)
        except FileExistsError:
            raise InputError(
                f"{self.folder}: expected a folder, found a file; move it elsewhere"
            ) from None
        self._lock = open_locked(self.folder / "lock", self.folder.parent)
        # An incomplete part of a process that was killed while it wrote; its journal still exists.
        for partial_file in self.folder.glob("*.partial"):
            partial_file.unlink()
        self._part_runs = part_runs
        self.statuses: dict[int, RunStatus] = {}
        self._index: dict[Path, list[int]] = {}
        self._records: list[tuple[int, RunStatus, pa.Table]] = []
        try:
            self._read_parts()
            self._number = 1 + max((int(p.stem) for p in self._index), default=0)
            for path in list_segments(self.folder, "journal"):
                # A part contains its whole journal. After a kill between writing the one and
                # deleting the other, reading both would duplicate runs.
                if int(path.stem) < self._number:
                    path.unlink()
                else:  # Numbers may be skipped if the user deleted a damaged part.
                    self._number = int(path.stem)
            self._file = self._reopen_journal(self._make_file_path("journal"))
        except InputError:
            self._lock.close()
            raise

    def _read_parts(self) -> None:
        """Read the statuses of the runs in all parts; the rows of the runs stay on disk.

        Raises:
            InputError: a part is damaged, or a run is in two parts.
        """
        for path in list_segments(self.folder, "parquet"):
            statuses = read_part_statuses(path)
            check_no_duplicate_runs(path, statuses, self.statuses)
            self.statuses |= statuses
            self._index[path] = sorted(statuses)

    def _make_file_path(self, ending: str) -> Path:
        return self.folder / f"{self._number:06d}.{ending}"

    def _reopen_journal(self, path: Path) -> IO[bytes]:
        """Open a journal for appending: read its complete records and drop one that is cut off."""
        end = 0
        if path.exists():
            # Appending continues at the last end.
            for plan_index, status, rows, end in read_records(path):  # noqa: B007
                check_no_duplicate_runs(path, [plan_index], self.statuses)
                self._records.append((plan_index, status, rows))
                self.statuses[plan_index] = status
        # Unbuffered: what is written must survive a kill of this process.
        file = path.open("r+b" if path.exists() else "w+b", buffering=0)
        # Remove a record that was cut off by a kill, or the next one would follow an incomplete
        # record.
        file.truncate(end)
        file.seek(end)
        return file

    def append(self, plan_index: int, columns: Mapping[str, Any], status: RunStatus) -> None:
        """Append a finished run; when this returns, the run survives a kill.

        Args:
            plan_index: Index of the run in the plan.
            columns: Rows of the run, by column.
            status: How the run ended.
        """
        import pyarrow as pa

        rows = pa.table(dict(columns))
        # A single write: after a kill a record is complete or cut off, but never mixed with
        # another.
        self._file.write(encode_record(plan_index, status, rows))
        self._records.append((plan_index, status, rows))
        self.statuses[plan_index] = status
        if len(self._records) >= self._part_runs:
            self._make_part()

    def _make_part(self) -> None:
        """Convert the full journal to a compressed Parquet part, and begin the next journal."""
        import pyarrow as pa
        from pyarrow import parquet

        self._records.sort(key=lambda record: record[0])
        # The footer allows reading the statuses without reading the rows.
        statuses = json.dumps([[index, asdict(status)] for index, status, _ in self._records])
        tables = [_add_place_column(index, rows) for index, _, rows in self._records]
        table = pa.concat_tables(tables).replace_schema_metadata({"statuses": statuses})
        path = self._make_file_path("parquet")
        with atomic_replacement(path) as partial:
            parquet.write_table(table, partial, compression="zstd")
        # Not earlier: until the part exists, the journal is the only copy of these runs.
        self._file.close()
        self._make_file_path("journal").unlink()
        self._index[path] = [index for index, _, _ in self._records]
        self._records = []
        self._number += 1
        self._file = self._reopen_journal(self._make_file_path("journal"))

    def iterate_tables(self, runs: int = 2000) -> Iterator[pa.Table]:
        """Yield the rows of all finished runs in the order of the plan, chunk by chunk.

        Args:
            runs: Approximate number of runs in a chunk.
        """
        import pyarrow as pa
        from pyarrow import compute, parquet

        rows_by_index = {index: rows for index, _, rows in self._records}
        plan_indices = sorted(self.statuses)
        # In chunks, since all rows of a million runs would not fit in memory.
        for first in range(0, len(plan_indices), runs):
            chunk = plan_indices[first : first + runs]
            low, high = chunk[0], chunk[-1]
            chunk_tables = [
                _add_place_column(plan_index, rows_by_index[plan_index])
                for plan_index in chunk
                if plan_index in rows_by_index
            ]
            for path, file_indices in self._index.items():
                if file_indices[0] <= high and file_indices[-1] >= low:
                    is_in_chunk = (compute.field("place") >= low) & (compute.field("place") <= high)
                    chunk_tables.append(parquet.read_table(path, filters=is_in_chunk))
            table = pa.concat_tables([part.replace_schema_metadata() for part in chunk_tables])
            order = compute.sort_indices(
                table, sort_keys=[("place", "ascending"), ("k", "ascending")]
            )
            yield table.take(order).drop_columns(["place"])

    def list_segment_contents(
        self,
    ) -> Iterator[tuple[Path, dict[int, RunStatus], list[pa.Table] | None]]:
        """Yield the content of each file.

        The content is the statuses by index in the plan, and the rows of the current journal; the
        rows of a part are None, since they are in its file.
        """
        for path, plan_indices in self._index.items():
            yield path, {index: self.statuses[index] for index in plan_indices}, None
        if self._records:
            statuses = {index: status for index, status, _ in self._records}
            yield self._make_file_path("journal"), statuses, [rows for _, _, rows in self._records]

    def close(self) -> None:
        """Close the journal and release the lock of the folder."""
        self._file.close()
        self._lock.close()

    def delete_segments(self) -> None:
        """Delete the segments, whose content has been stored elsewhere.

        The folder is renamed first, so that an incomplete one is never found.
        """
        self.close()
        # An incomplete folder of segments would count as an unfinished comparison.
        trash_folder = self.folder.with_name(f".{SEGMENTS_FOLDER}.gone")
        shutil.rmtree(trash_folder, ignore_errors=True)
        self.folder.rename(trash_folder)
        shutil.rmtree(trash_folder)


def _add_place_column(plan_index: int, rows: pa.Table) -> pa.Table:
    """Add the column ``place``, the index of the run in the plan, by which rows are sorted."""
    import numpy as np
    import pyarrow as pa

    return rows.append_column("place", pa.array(np.full(len(rows), plan_index)))
