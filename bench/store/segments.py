"""The files of a comparison that is under way, as they stand: its plan, records of finished runs,
and parts; `bench.store.journal` writes them.
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

from bench.store import cells
from bench.store.cells import CellError
from bench.store.schema import STATUS, Column
from bench.store.status import STATUS_COLUMNS, Status
from sims.base import InputError
from sims.files import first_line, write

if TYPE_CHECKING:
    import pyarrow as pa

FOLDER = "segments"
"""Below a comparison's folder, while it is under way."""
PLAN = "plan.txt"
"""In it, the id of every run."""
PLAN_REMEDY = "restore it, or delete it and resume the comparison, which writes it again"
"""What to do with a plan that is damaged."""
_HEAD = struct.Struct(">4sII")
"""Of a record: mark, length of what follows, its checksum."""
_MARK = b"run\n"
"""With which a record begins."""
REMEDY = "restore it, or delete it and resume the comparison: its runs are made again"
"""What to do with a segment that is damaged."""
_PLACE = Column("place in the plan", int, low=0, high=2.0**31)


def record(place: int, status: Status, rows: pa.Table) -> bytes:
    """A record of a journal: a finished run, with its checksum."""
    import pyarrow as pa

    sink = pa.BufferOutputStream()
    head = json.dumps([place, asdict(status)])
    rows = rows.replace_schema_metadata({"status": head})
    with pa.ipc.new_stream(sink, rows.schema) as stream:
        stream.write_table(rows)
    packed: bytes = sink.getvalue().to_pybytes()
    return _HEAD.pack(_MARK, len(packed), zlib.crc32(packed)) + packed


def records(path: Path) -> Iterator[tuple[int, Status, pa.Table, int]]:
    """Place, status, rows, and the offset behind it, of every whole record of a journal."""
    import pyarrow as pa

    data, end = path.read_bytes(), 0
    while end + _HEAD.size <= len(data):
        mark, length, checksum = _HEAD.unpack_from(data, end)
        payload = data[end + _HEAD.size : end + _HEAD.size + length]
        if mark != _MARK or len(payload) < length or zlib.crc32(payload) != checksum:
            return
        end += _HEAD.size + length
        try:
            rows = pa.ipc.open_stream(payload).read_all()
            held = _statuses_of([json.loads(rows.schema.metadata[b"status"])])
        except _DAMAGE as error:
            raise _damaged(path, f"a record of a run: {first_line(error)}") from None
        ((place, status),) = held.items()
        yield place, status, rows.replace_schema_metadata(), end


def part_statuses(path: Path) -> dict[int, Status]:
    """Statuses of a part, by place, from its footer alone.

    Raises:
        InputError: the file is damaged.
    """
    from pyarrow import parquet

    try:
        return _statuses_of(json.loads(parquet.read_schema(path).metadata[b"statuses"]))
    except _DAMAGE as error:
        raise _damaged(path, f"a part of a comparison, found damage: {first_line(error)}") from None


_DAMAGE = (OSError, ValueError, KeyError, TypeError, CellError, RecursionError, NotImplementedError)
"""What reading a damaged segment may raise; Arrow's own errors are among them."""


def _statuses_of(held: Any) -> dict[int, Status]:
    """Statuses by place of ``[[place, {column: value}], ...]``, every cell checked.

    Raises:
        CellError: one is not what it is declared to be.
    """
    places = cells.of_python(_PLACE, [place for place, _ in held])
    cells.check(_PLACE, places)
    columns = [c for c in STATUS if c.name in STATUS_COLUMNS]
    for column in columns:
        values = [status[column.name] for _, status in held]
        cells.check(column, cells.of_python(column, values))
    return {
        place: Status(**{name: status[name] for name in STATUS_COLUMNS}) for place, status in held
    }


def _damaged(path: Path, expected: str) -> InputError:
    return InputError(f"{path}: expected {expected}; {REMEDY}")


def refuse_double(path: Path, places: Iterable[int], known: Container[int]) -> None:
    """Refuse runs that another file has already.

    Raises:
        InputError: it has one.
    """
    if double := [place for place in places if place in known]:
        raise _damaged(
            path, f"every run once, found that of line {double[0] + 1} of the plan again"
        )


def segments(folder: Path, ending: str) -> list[Path]:
    """The files of this ending, in order.

    Raises:
        InputError: one has no number for a name.
    """
    paths = sorted(folder.glob(f"*.{ending}"))
    for path in paths:
        if not (path.stem.isascii() and path.stem.isdigit()):
            raise InputError(f"{path}: expected a name such as 000001.{ending}; move it elsewhere")
    return paths


def finished(folder: Path) -> dict[int, Status]:
    """Statuses of the finished runs below `folder`, by place, while another process may be at work
    there.

    Raises:
        InputError: a file is damaged.
    """
    return {place: status for _, held in kept(folder) for place, status in held.items()}


def kept(folder: Path) -> Iterator[tuple[Path, dict[int, Status]]]:
    """By file, the statuses of the finished runs below `folder`; see `finished`."""
    # Journals first: one that becomes a part meanwhile is found among the parts.
    for path in segments(folder / FOLDER, "journal"):
        with suppress(FileNotFoundError):
            yield path, {place: status for place, status, _, _ in records(path)}
    known: set[int] = set()
    for path in segments(folder / FOLDER, "parquet"):
        statuses = part_statuses(path)
        refuse_double(path, statuses, known)
        known.update(statuses)
        yield path, statuses


def write_plan(folder: Path, ids: Sequence[str]) -> None:
    """Write the id of every run, in the order of the plan."""
    write(folder / FOLDER / PLAN, "".join(f"{name}\n" for name in ids))


def read_plan(folder: Path) -> list[str] | None:
    """The ids of the plan; None where there is none yet.

    Raises:
        InputError: it is damaged.
    """
    path = folder / FOLDER / PLAN
    try:
        return path.read_text(encoding="utf-8").splitlines() if path.is_file() else None
    except ValueError:
        raise InputError(
            f"{path}: expected the ids of the runs as UTF-8 text, found other bytes; {PLAN_REMEDY}"
        ) from None
