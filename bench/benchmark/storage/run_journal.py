"""Crash-safe journal of finished runs: each is appended as one record the moment it ends.

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
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from bench.benchmark.storage.journal_segments import (
    SEGMENTS_FOLDER,
    check_no_duplicate_runs,
    encode_record,
    list_segments,
    read_part_statuses,
    read_records,
)
from bench.benchmark.storage.run_status import RunStatus
from sims.core.files import atomic_replacement, open_locked
from sims.core.simulator import InputError

if TYPE_CHECKING:
    import pyarrow as pa

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

        `_index` are the plan indices of the runs in each finished part. `_records` are the runs in
        the current journal, and `_number` is the number of this journal. A journal of `part_runs`
        runs is converted to a part.
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
            parts = [
                _add_place_column(plan_index, rows_by_index[plan_index])
                for plan_index in chunk
                if plan_index in rows_by_index
            ]
            for path, file_indices in self._index.items():
                if file_indices[0] <= high and file_indices[-1] >= low:
                    is_in_chunk = (compute.field("place") >= low) & (compute.field("place") <= high)
                    parts.append(parquet.read_table(path, filters=is_in_chunk))
            table = pa.concat_tables([part.replace_schema_metadata() for part in parts])
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
