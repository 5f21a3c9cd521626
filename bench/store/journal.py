"""Finished runs on disk the moment they end: a record each, appended; many records become one
Parquet part.

The folder ``segments`` of a comparison that is under way holds ``plan.txt`` (the id of every run,
in order), ``NNNNNN.journal`` (records that are being appended) and ``NNNNNN.parquet`` (parts). A
part is written beside its journal, renamed, and only then is the journal deleted; where both are
found, the part holds everything. A record that was cut off by a kill fails its checksum and is
dropped: its run was not finished. What is appended survives the end of any process; the end of the
machine may cost the runs since the last part.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from bench.store.segments import (
    FOLDER,
    part_statuses,
    record,
    records,
    refuse_double,
    segments,
)
from bench.store.status import Status
from sims.base import InputError
from sims.files import replacing

if TYPE_CHECKING:
    import pyarrow as pa

PART_RUNS = 1000
"""Records that become a part together."""


class Journal:
    """The finished runs of a comparison in `folder`; opening it recovers whatever an earlier
    process left.

    Attributes:
        statuses: of every finished run, by its place in the plan.

    Raises:
        InputError: another process is at work in the folder, or a part is damaged.
    """

    def __init__(self, folder: Path, part_runs: int = PART_RUNS) -> None:
        self.folder = folder / FOLDER
        try:
            self.folder.mkdir(exist_ok=True)
        except FileExistsError:
            raise InputError(
                f"{self.folder}: expected a folder, found a file; move it elsewhere"
            ) from None
        self._lock = _locked(self.folder / "lock")
        # Half a part, of a process that was killed while it wrote; its journal is still there.
        for half in self.folder.glob("*.partial"):
            half.unlink()
        self._part_runs = part_runs
        self.statuses: dict[int, Status] = {}
        self._index: dict[Path, list[int]] = {}
        self._records: list[tuple[int, Status, pa.Table]] = []
        try:
            self._read_parts()
            self._number = 1 + max((int(p.stem) for p in self._index), default=0)
            for path in segments(self.folder, "journal"):
                # A part holds all of its journal: killed between the two, it would double runs.
                if int(path.stem) < self._number:
                    path.unlink()
                else:  # beyond the next where a person deleted a damaged part
                    self._number = int(path.stem)
            self._file = self._reopened(self._path("journal"))
        except InputError:
            self._lock.close()
            raise

    def _read_parts(self) -> None:
        for path in segments(self.folder, "parquet"):
            statuses = part_statuses(path)
            refuse_double(path, statuses, self.statuses)
            self.statuses |= statuses
            self._index[path] = sorted(statuses)

    def _path(self, ending: str) -> Path:
        return self.folder / f"{self._number:06d}.{ending}"

    def _reopened(self, path: Path) -> IO[bytes]:
        """The journal, its whole records read and a cut-off one dropped, ready to append."""
        end = 0
        if path.exists():
            # The last end is where to go on.
            for place, status, rows, end in records(path):  # noqa: B007
                refuse_double(path, [place], self.statuses)
                self._records.append((place, status, rows))
                self.statuses[place] = status
        # Without a buffer: what is written must survive this process.
        file = path.open("r+b" if path.exists() else "w+b", buffering=0)
        # What was cut off by a kill goes, or the next record would stand behind half a one.
        file.truncate(end)
        file.seek(end)
        return file

    def add(self, place: int, columns: Mapping[str, Any], status: Status) -> None:
        """Keep a finished run; when this returns, it survives a kill."""
        import pyarrow as pa

        rows = pa.table(dict(columns))
        # One write: a kill leaves a record whole or cut off, never two that are mixed.
        self._file.write(record(place, status, rows))
        self._records.append((place, status, rows))
        self.statuses[place] = status
        if len(self._records) >= self._part_runs:
            self._make_part()

    def _make_part(self) -> None:
        import pyarrow as pa
        from pyarrow import parquet

        self._records.sort(key=lambda record: record[0])
        # In the footer, where statuses are read without reading the rows.
        statuses = json.dumps([[place, asdict(status)] for place, status, _ in self._records])
        tables = [_placed(place, rows) for place, _, rows in self._records]
        whole = pa.concat_tables(tables).replace_schema_metadata({"statuses": statuses})
        path = self._path("parquet")
        with replacing(path) as partial:
            parquet.write_table(whole, partial, compression="zstd")
        # Only now: until the part is there, the journal is all there is of these runs.
        self._file.close()
        self._path("journal").unlink()
        self._index[path] = [place for place, _, _ in self._records]
        self._records = []
        self._number += 1
        self._file = self._reopened(self._path("journal"))

    def tables(self, runs: int = 2000) -> Iterator[pa.Table]:
        """The rows of all finished runs in the order of the plan, about `runs` runs at a time."""
        import pyarrow as pa
        from pyarrow import compute, parquet

        pending = {place: rows for place, _, rows in self._records}
        places = sorted(self.statuses)
        # By chunks: all rows of a million runs would fill memory.
        for first in range(0, len(places), runs):
            chunk = places[first : first + runs]
            low, high = chunk[0], chunk[-1]
            parts = [_placed(place, pending[place]) for place in chunk if place in pending]
            for path, held in self._index.items():
                if held[0] <= high and held[-1] >= low:
                    between = (compute.field("place") >= low) & (compute.field("place") <= high)
                    parts.append(parquet.read_table(path, filters=between))
            whole = pa.concat_tables([part.replace_schema_metadata() for part in parts])
            order = compute.sort_indices(
                whole, sort_keys=[("place", "ascending"), ("k", "ascending")]
            )
            yield whole.take(order).drop_columns(["place"])

    def files(self) -> Iterator[tuple[Path, dict[int, Status], list[pa.Table] | None]]:
        """What each file holds: statuses by place, and the rows of the journal that is appended to;
        those of a part are in its file.
        """
        for path, places in self._index.items():
            yield path, {place: self.statuses[place] for place in places}, None
        if self._records:
            held = {place: status for place, status, _ in self._records}
            yield self._path("journal"), held, [rows for _, _, rows in self._records]

    def close(self) -> None:
        """Let others work in the folder."""
        self._file.close()
        self._lock.close()

    def discard(self) -> None:
        """Delete the segments; their content stands elsewhere. Renamed first, so that no half of
        them is ever met.
        """
        self.close()
        # Half a folder of segments would count as a comparison under way.
        gone = self.folder.with_name(f".{FOLDER}.gone")
        shutil.rmtree(gone, ignore_errors=True)
        self.folder.rename(gone)
        shutil.rmtree(gone)


def _placed(place: int, rows: pa.Table) -> pa.Table:
    import numpy as np
    import pyarrow as pa

    return rows.append_column("place", pa.array(np.full(len(rows), place)))


def _locked(path: Path) -> IO[str]:
    """The lock of the folder: held until this process ends, however it ends."""
    file = path.open("a", encoding="ascii")
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except ImportError:  # no such locks on this system
        pass
    except OSError:
        file.close()
        raise InputError(
            f"{path.parent.parent}: another simgap is at work there; wait for it, or end it"
        ) from None
    return file
