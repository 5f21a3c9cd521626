"""Segment files of an unfinished comparison: its plan, records of finished runs, and parts.

`bench.benchmark.storage.run_journal` writes them.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Container, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.benchmark.storage import cell_validation
from bench.benchmark.storage.cell_validation import CellError
from bench.benchmark.storage.run_status import STATUS_COLUMN_NAMES, RunStatus
from bench.benchmark.storage.table_schemas import STATUS_COLUMNS, ColumnSpec
from sims.core.files import get_first_line, write_atomically
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
    """Convert ``[[place, {column: value}], ...]`` to statuses by index, checking every cell.

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

    Args:
        path: Path of the file.
        plan_indices: Indices of its runs.
        known_indices: Indices of the runs in other files.

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


def read_finished_statuses(folder: Path) -> dict[int, RunStatus]:
    """Read the statuses of the finished runs of a study, by index in the plan.

    Another process may be writing there at the same time.

    Raises:
        InputError: A file is damaged.
    """
    return {
        plan_index: status
        for _, statuses in read_statuses_by_file(folder)
        for plan_index, status in statuses.items()
    }


def read_statuses_by_file(folder: Path) -> Iterator[tuple[Path, dict[int, RunStatus]]]:
    """Yield the statuses of the finished runs of a study by file; see `read_finished_statuses`."""
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
