"""Crash-safe journal of finished runs while a comparison is unfinished.

The folder ``segments`` of an unfinished comparison contains ``plan.txt`` (the id of every run, in
order) and ``runs.journal``, to which each run is appended when it ends. A last record that was cut
off by a kill is dropped: its run was not finished. Appended records survive the end of any process;
a crash of the machine may lose the last ones.
"""

from __future__ import annotations

import json
import shutil
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple

from bench.benchmark.storage import cell_validation
from bench.benchmark.storage.cell_validation import CellError
from bench.benchmark.storage.run_status import STATUS_COLUMN_NAMES, RunStatus
from bench.benchmark.storage.table_schemas import STATUS_COLUMNS, ColumnSpec
from sims.core.files import get_first_line, open_locked, write_atomically
from sims.core.simulator import InputError

if TYPE_CHECKING:
    import pyarrow as pa


SEGMENTS_FOLDER = "segments"
"""Name of the folder of journal, plan and salt in the folder of an unfinished comparison."""
JOURNAL_FILE = "runs.journal"
"""Name of the file of finished runs."""
PLAN_FILE = "plan.txt"
"""Name of the file of the plan, which lists the id of every run."""
PLAN_REMEDY = "restore it, or delete it and resume the comparison, which writes it again"
"""Advice for a damaged plan."""
JOURNAL_REMEDY = "restore it, or delete it and resume the comparison: the runs are repeated"
"""Advice for a damaged journal."""
_RECORD_HEADER = struct.Struct(">4sIII")
"""Head of a record: mark, lengths of status and rows in bytes, checksum of both."""
_ROWS_HEADER = struct.Struct(">I")
"""Head of the compressed rows: their size in bytes when decompressed."""
_CODEC = "zstd"
"""Compression of the rows."""
_RECORD_MARK = b"run\n"
"""Mark at the beginning of a record."""
_PLAN_INDEX = ColumnSpec("place in the plan", int, low=0, high=2.0**31)
_DAMAGE_ERRORS = (ValueError, KeyError, TypeError, CellError, RecursionError)
"""Errors that reading a damaged status may raise."""


class JournalRecord(NamedTuple):
    """Record of a finished run in a journal.

    Attributes:
        head: index of the run in the plan and its status, as JSON.
        rows: rows of the run, see `decode_rows`.
        end: position of the end of the record in the file, in bytes.
    """

    head: bytes
    rows: bytes
    end: int


def encode_record(plan_index: int, status: RunStatus, rows: pa.Table) -> bytes:
    """Encode a finished run as a record of a journal: header, status as JSON, compressed rows.

    Args:
        plan_index: Index of the run in the plan.
        status: How the run ended.
        rows: Rows of the run.

    Returns:
        Bytes of the record; the header has the lengths and the checksum of status and rows.
    """
    import pyarrow as pa

    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, rows.schema) as stream:
        stream.write_table(rows)
    plain = sink.getvalue()
    head = json.dumps([plan_index, asdict(status)]).encode()
    body = _ROWS_HEADER.pack(plain.size) + pa.compress(plain, _CODEC, asbytes=True)
    checksum = zlib.crc32(head + body)
    record: bytes = _RECORD_HEADER.pack(_RECORD_MARK, len(head), len(body), checksum) + head + body
    return record


def decode_rows(packed: bytes) -> pa.Table:
    """Return the rows of a record."""
    import pyarrow as pa

    (size,) = _ROWS_HEADER.unpack_from(packed)
    plain = pa.decompress(packed[_ROWS_HEADER.size :], size, _CODEC)
    return pa.ipc.open_stream(plain).read_all()


def read_records(path: Path) -> Iterator[JournalRecord]:
    """Yield every complete record of a journal; none if there is no such file.

    A journal has one record for each finished run: a header with a mark, two lengths and a
    checksum, the status of the run (head), and its compressed rows. A process that was killed may
    have left an incomplete record at the end, and a crash of the machine zeros. Reading stops
    before them.

    Raises:
        InputError: a record with others after it is damaged.
    """
    if not path.exists():
        return
    with path.open("rb") as file:
        file_size = path.stat().st_size
        # A header of zeros is what a crash of the machine left.
        while len(header := file.read(_RECORD_HEADER.size)) == _RECORD_HEADER.size and any(header):
            mark, head_size, rows_size, checksum = _RECORD_HEADER.unpack(header)
            payload = file.read(head_size + rows_size) if mark == _RECORD_MARK else b""
            # The file ends within this record, so it is the last one and was cut off.
            if mark == _RECORD_MARK and len(payload) < head_size + rows_size:
                return
            if mark != _RECORD_MARK or zlib.crc32(payload) != checksum:
                # Nothing follows, so it is the last record, which was not written completely.
                if file.tell() >= file_size:
                    return
                raise _make_damage_error(path, f"a record before byte {file.tell()}, found damage")
            yield JournalRecord(payload[:head_size], payload[head_size:], file.tell())


def _read_bytes(file: IO[bytes], position: int, size: int) -> bytes:
    file.seek(position)
    return file.read(size)


def parse_statuses(path: Path, heads: Sequence[bytes]) -> dict[int, RunStatus]:
    """Parse the heads of a journal's records, and check every value.

    Args:
        path: path of the journal, for messages.
        heads: JSON texts ``[index, {column: value}]``; the index is the position in the
            plan of runs.

    Returns:
        Statuses by index in the plan.

    Raises:
        InputError: a value violates its declaration, or a run is in two records.
    """
    try:
        entries = [json.loads(head) for head in heads]
        indices = [index for index, _ in entries]
        cell_validation.check_cells(
            _PLAN_INDEX, cell_validation.parse_json_column(_PLAN_INDEX, indices)
        )
        for column in STATUS_COLUMNS:
            values = [status[column.name] for _, status in entries]
            cell_validation.check_cells(column, cell_validation.parse_json_column(column, values))
    except _DAMAGE_ERRORS as error:
        raise _make_damage_error(path, f"records of runs, found {get_first_line(error)}") from None
    statuses: dict[int, RunStatus] = {}
    for index, status in entries:
        if index in statuses:
            raise _make_damage_error(
                path, f"every run once, found that of line {index + 1} of the plan again"
            )
        statuses[index] = RunStatus(**{name: status[name] for name in STATUS_COLUMN_NAMES})
    return statuses


def _make_damage_error(path: Path, expected: str) -> InputError:
    return InputError(f"{path}: expected {expected}; {JOURNAL_REMEDY}")


def read_statuses(folder: Path) -> dict[int, RunStatus]:
    """Read the statuses of the finished runs of a study, by index in the plan.

    Another process may append runs, or delete the journal, at the same time.

    Raises:
        InputError: The journal is damaged, or the folder has runs of an earlier version.
    """
    _refuse_earlier_files(folder / SEGMENTS_FOLDER)
    path = folder / SEGMENTS_FOLDER / JOURNAL_FILE
    return parse_statuses(path, [record.head for record in read_records(path)])


def _refuse_earlier_files(folder: Path) -> None:
    """Refuse the finished runs of a version that wrote several files, which would be repeated.

    Raises:
        InputError: there are such files.
    """
    names = sorted(p.name for p in folder.glob("[0-9]*") if p.suffix in (".journal", ".parquet"))
    if names:
        raise InputError(
            f"{folder / names[0]}: expected finished runs in {JOURNAL_FILE}, found a file of an "
            "earlier version; finish the comparison with that version, or move the file elsewhere: "
            "its runs are repeated"
        )


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


class RunJournal:
    """Journal of the finished runs of a comparison; opening it recovers earlier records.

    Attributes:
        folder: folder of the journal.
        path: path of the journal.
        statuses: Statuses of all finished runs, by index in the plan.

    Raises:
        InputError: Another process is working in the folder, the journal is damaged, or the folder
            has runs of an earlier version.
    """

    def __init__(self, folder: Path) -> None:
        """Lock the folder against other processes, and recover all runs that it contains.

        `_row_extents` has the position and the length in bytes of the rows of each run, which stay
        on disk. `_end` is the position at which the next record begins.

        Args:
            folder: folder of the comparison.
        """
        self.folder = folder / SEGMENTS_FOLDER
        try:
            self.folder.mkdir(exist_ok=True)
        except FileExistsError:
            raise InputError(
                f"{self.folder}: expected a folder, found a file; move it elsewhere"
            ) from None
        self.path = self.folder / JOURNAL_FILE
        _refuse_earlier_files(self.folder)
        self._lock = open_locked(self.folder / "lock", self.folder.parent)
        extents: list[tuple[int, int]] = []
        heads: list[bytes] = []
        self._end = 0
        try:
            for record in read_records(self.path):
                self._end = record.end
                heads.append(record.head)
                extents.append((record.end - len(record.rows), len(record.rows)))
            self.statuses = parse_statuses(self.path, heads)
        except InputError:
            self._lock.close()
            raise
        self._row_extents = dict(zip(self.statuses, extents, strict=True))
        # Unbuffered: what is written must survive a kill of this process.
        self._file = self.path.open("r+b" if self.path.exists() else "w+b", buffering=0)
        # Remove a record that was cut off by a kill, or the next one would follow an incomplete
        # record.
        self._file.truncate(self._end)
        self._file.seek(self._end)

    def append(self, plan_index: int, columns: Mapping[str, Any], status: RunStatus) -> None:
        """Append a finished run; when this returns, the run survives a kill.

        Args:
            plan_index: Index of the run in the plan.
            columns: Rows of the run, by column.
            status: How the run ended.
        """
        import pyarrow as pa

        record = encode_record(plan_index, status, pa.table(dict(columns)))
        # A single write: after a kill a record is complete or cut off, but never mixed with
        # another.
        self._file.write(record)
        self._end += len(record)
        _, _, rows_size, _ = _RECORD_HEADER.unpack_from(record)
        self.statuses[plan_index] = status
        self._row_extents[plan_index] = self._end - rows_size, rows_size

    def iterate_tables(self, runs: int = 2000) -> Iterator[tuple[list[int], pa.Table]]:
        """Yield the finished runs in the order of the plan, chunk by chunk.

        Args:
            runs: Maximum number of runs in a chunk.

        Yields:
            Indices of the runs in the plan, and their rows.

        Raises:
            InputError: rows are damaged.
        """
        import pyarrow as pa

        plan_indices = sorted(self.statuses)
        # In chunks, since all rows of a million runs would not fit in memory.
        for first in range(0, len(plan_indices), runs):
            chunk = plan_indices[first : first + runs]
            try:
                with self.path.open("rb") as file:
                    tables = [decode_rows(_read_bytes(file, *self._row_extents[i])) for i in chunk]
                rows = pa.concat_tables(tables).combine_chunks()
            except (OSError, pa.ArrowException) as error:
                raise _make_damage_error(
                    self.path, f"rows of runs, found {get_first_line(error)}"
                ) from None
            yield chunk, rows

    def close(self) -> None:
        """Close the journal and release the lock of the folder."""
        self._file.close()
        self._lock.close()

    def delete_segments(self) -> None:
        """Delete the journal with its folder, because its content has been stored elsewhere.

        The folder is renamed first, so that an incomplete one is never found.
        """
        self.close()
        # An incomplete folder of segments would count as an unfinished comparison.
        trash_folder = self.folder.with_name(f".{SEGMENTS_FOLDER}.gone")
        shutil.rmtree(trash_folder, ignore_errors=True)
        self.folder.rename(trash_folder)
        shutil.rmtree(trash_folder)
