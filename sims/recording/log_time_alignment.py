"""Join the logs of a recording into the table of each run.

A description may take its columns from several logs (`column_mapping`), each with its own stamps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sims.core.number_limits import MAX_TIMESTAMP_SECONDS, MIN_RUN_SECONDS
from sims.core.simulator import Array, InputError, make_read_only
from sims.core.toml_validation import toml_key
from sims.core.user_messages import MAX_NAME_LENGTH
from sims.recording.column_mapping import RecordingSources
from sims.recording.csv_table import CsvRun
from sims.recording.log_formats.log_columns import LogFile
from sims.recording.log_formats.log_files import read_log

MAX_REPEATED = 0.05
"""Maximum share of a log's stamps that may repeat the previous one; their rows are left out."""
SAME_INSTANT_SECONDS = 1e-9
"""Maximum difference of two stamps in different files that count as the same time, in seconds."""


def read_logs(
    path: Path,
    sources: RecordingSources,
    channels: Sequence[str],
    inputs: Sequence[str],
    linear: frozenset[str],
) -> list[CsvRun]:
    """Read the runs of a recording from its logs, which may have different time stamps.

    The rows of a run are all times at which a channel or an input has a stamp, from the first to
    the last sample of a channel. The cells of a channel are empty between its own stamps, so that
    measurements are not resampled; an input has its held or interpolated value at all times, and an
    extra column (neither channel nor input) its held value.

    Args:
        path: Table in which signals without a stated file are found.
        sources: Location of each signal.
        channels: Names of the measured signals.
        inputs: Names of the inputs.
        linear: Inputs that are interpolated linearly between samples.

    Raises:
        InputError: A log is malformed; the message is one line.
    """
    runs = []
    for name, folder in (sources.folders or {"": ""}).items():
        if len(name) > MAX_NAME_LENGTH:
            raise InputError(f"{path}: the name of run {name[:40]}… is too long")
        logs = _FolderLogs(
            path.parent / folder, sources.files.get(name, path.name), sources, channels, inputs
        )
        runs += [logs.join(run, rows, linear) for run, rows in logs.list_runs(name)]
    return runs


Mask: TypeAlias = NDArray[np.bool_]


class _LogRows(NamedTuple):
    """Rows of a log that belong to a run.

    Attributes:
        stamps: (N,) stamps, in s from the first stamp of the run.
        rows: (N,) numbers of the rows in the log.
    """

    stamps: Array
    rows: NDArray[np.intp]


class _FolderLogs:
    """Logs of one folder."""

    def __init__(
        self,
        folder: Path,
        default_file: str,
        sources: RecordingSources,
        channels: Sequence[str],
        inputs: Sequence[str],
    ) -> None:
        """Find the file of each signal, and read the needed columns of each file.

        An extra column without a stated file is searched for in the files of the other signals. The
        time stamps are read from each file, unless a sampling rate replaces them.

        Args:
            folder: Folder of the logs.
            default_file: File of signals without a stated file.
            sources: Location of each signal.
            channels: Names of the measured signals.
            inputs: Names of the inputs.
        """
        # The sampling rate, in Hz, is 0 if the logs have stamps; their unit is given in seconds.
        self._time_column, self._sampling_rate = sources.time, sources.rate
        self._seconds_per_unit = sources.second
        self._channels, self._inputs, self._extra = channels, inputs, list(sources.extra)
        self._sources = {
            **{name: sources.signals[name] for name in (*channels, *inputs)},
            **sources.extra,
        }
        files = {name: self._sources[name].file or default_file for name in (*channels, *inputs)}
        for name, source in sources.extra.items():
            (column,) = source.columns  # an extra column is never a sum of several
            files[name] = source.file or _find_file(folder, column, list(files.values()))
        columns_by_file: dict[str, set[str]] = {}
        for name, file in files.items():
            stamp_columns = set() if self._sampling_rate else {self._time_column}
            columns = columns_by_file.setdefault(file, stamp_columns)
            columns.update(self._sources[name].columns)
        self._logs: dict[str, LogFile] = {
            name: read_log(folder / Path(file), frozenset(columns_by_file[file]))
            for name, file in files.items()
        }

    def list_runs(self, name: str) -> list[tuple[str, Mask | None]]:
        """Return the names of the runs in these files, each with a mask of its rows.

        There are several runs only if a single file has a column ``run`` with their numbers, and
        the description does not name the run. Otherwise the mask is None: all rows are one run.

        Args:
            name: Name of the run in the description; empty if it names none.
        """
        first_log = next(iter(self._logs.values()))
        is_one_file = all(log.path == first_log.path for log in self._logs.values())
        if name or not is_one_file or "run" not in first_log.columns:
            return [(name or "1", None)]
        run_numbers = first_log.get_column("run")
        different_numbers = dict.fromkeys(run_numbers.tolist())
        return [(f"{number:g}", run_numbers == number) for number in different_numbers]

    def join(self, run: str, run_rows: Mask | None, linear: frozenset[str]) -> CsvRun:
        """Join the logs of one run into a table.

        The logs of a run may have different stamps. The table has a row for each of them; a
        channel is empty where its log has no sample, and an input is held or interpolated.

        Args:
            run: Name of the run.
            run_rows: Mask of the run's rows; None for all rows.
            linear: Inputs that are interpolated linearly between samples.

        Raises:
            InputError: A log has missing or decreasing stamps, or a signal has no samples.
        """
        rows_of, notes = self._select_rows(run_rows)  # stamps and rows of each log, by path
        times = self._sample_times(run, rows_of)
        columns = {}
        for channel in self._channels:
            log = self._logs[channel]
            values = self._read_signal(channel, rows_of[log.path])
            if not np.isfinite(values).any():
                raise InputError(f"{log.path}: column {channel} has no sample; leave it out")
            # Write the values into the rows of the table that have the stamps of the channel.
            stamps = rows_of[log.path].stamps
            # Stamps before the first or after the last row of the run have no row.
            row_indices = np.searchsorted(times, stamps - SAME_INSTANT_SECONDS)
            is_in_run = (row_indices < times.size) & (stamps >= times[0] - SAME_INSTANT_SECONDS)
            column = np.full(times.size, np.nan)
            column[row_indices[is_in_run]] = values[is_in_run]
            columns[channel] = make_read_only(column)
        for name in (*self._inputs, *self._extra):
            columns[name] = make_read_only(
                self._resample_signal(name, rows_of, times, name in linear)
            )
        return CsvRun(run, times, columns, tuple(notes))

    def _select_rows(self, run_rows: Mask | None) -> tuple[dict[Path, _LogRows], list[str]]:
        """Return the rows of each log that are used, and notes on those that are left out.

        Of rows with the same stamp, only the first is used. Stamps are converted to seconds from
        the first stamp of all logs.

        Args:
            run_rows: Mask of the run's rows; None for all rows.
        """
        rows_of: dict[Path, _LogRows] = {}
        notes = []
        for log in self._logs.values():
            if log.path in rows_of:
                continue
            stamps, is_new = self._read_stamps(log, run_rows)
            numbers = np.arange(stamps.size) if run_rows is None else np.flatnonzero(run_rows)
            rows_of[log.path] = _LogRows(stamps[is_new], numbers[is_new])
            if not is_new.all():
                repeated = f"{int((~is_new).sum())} of {stamps.size} stamps repeat the one before"
                notes.append(f"{log.path}: {repeated}; their {log.rows}s are left out")
        # Clocks of robots count from 1970, which leaves floats a coarse resolution; so the first
        # stamp is subtracted before scaling.
        first_stamp = min(rows.stamps[0] for rows in rows_of.values())
        return {
            path: rows._replace(stamps=self._seconds_per_unit * (rows.stamps - first_stamp))
            for path, rows in rows_of.items()
        }, notes

    def _sample_times(self, run: str, rows_of: Mapping[Path, _LogRows]) -> Array:
        """Return the times (T,) of a run in seconds: all stamps of its channels and inputs.

        Shapes: T times.

        Stamps of inputs before the first or after the last measurement are left out, and stamps
        that differ by rounding count as one.

        Args:
            run: name of the run, for messages.
            rows_of: stamps and rows of each log, by path.

        Raises:
            InputError: the run is too short.
        """

        def stamps_of(names: Sequence[str]) -> list[Array]:
            """Return the stamps of the logs that hold some signals."""
            return [rows_of[self._logs[name].path].stamps for name in names]

        measured = np.unique(np.concatenate(stamps_of(self._channels)))
        times = np.unique(np.concatenate([measured, *stamps_of(self._inputs)]))
        times = times[(times >= measured[0]) & (times <= measured[-1])]
        times = times[np.diff(times, prepend=-np.inf) > SAME_INSTANT_SECONDS]
        if times.size < 2 or times[-1] - times[0] < MIN_RUN_SECONDS:
            path = self._logs[self._channels[0]].path
            raise InputError(f"{path}: run {run!r}: expected at least two instants, found one")
        return make_read_only(times)

    def _read_signal(self, signal: str, rows: _LogRows) -> Array:
        """Return the values (N,) of a signal in the rows of a run, in the unit of the log.

        Shapes: N rows.

        A signal may be a weighted sum of several columns, for example of coupled drives.

        Args:
            signal: Name of the channel, input or extra column.
            rows: Rows of its log that belong to the run.

        Raises:
            InputError: a column is missing, or shorter than the column of stamps.
        """
        log = self._logs[signal]

        def read_column(name: str) -> Array:
            """Return the rows of the run from one column of the log.

            Raises:
                InputError: the column is shorter than the column of stamps.
            """
            values = log.get_column(name)
            if rows.rows.size and rows.rows[-1] >= values.size:
                raise InputError(
                    f"{log.path}, column {name}: expected a number for each stamp, found "
                    f"{values.size} numbers and at least {rows.rows[-1] + 1} stamps"
                )
            return np.asarray(values[rows.rows])

        return self._sources[signal].combine(read_column)

    def _resample_signal(
        self, signal: str, rows_of: Mapping[Path, _LogRows], times: Array, is_linear: bool
    ) -> Array:
        """Return the values of an input or an extra column at all times of a run.

        Shapes: T times.

        Its own stamps differ from these times, so its last value is held, or it is interpolated.
        Before its first stamp, it has its first value.

        Args:
            signal: Name of the signal.
            rows_of: Rows of each log that are used.
            times: (T,) times of the run, s.
            is_linear: Whether to interpolate linearly instead of holding the last value.

        Returns:
            (T,) values in the unit of the log.

        Raises:
            InputError: A value of an input is missing.
        """
        log = self._logs[signal]
        rows = rows_of[log.path]
        values = self._read_signal(signal, rows)
        missing = np.flatnonzero(~np.isfinite(values))
        if missing.size and signal in self._inputs:
            # `first` is the number of the first row of data in the file, for messages.
            row = int(rows.rows[missing[0]]) + log.first
            columns = ", ".join(self._sources[signal].columns)
            raise InputError(
                f"{log.path}, {log.rows} {row}, column {columns}: expected a number, found none; "
                "an input has a value at every stamp: take out the row, or name another column"
            )
        if is_linear:
            return np.interp(times, rows.stamps, values)
        # Index of the last sample up to each time; -1 before the first sample.
        last_rows = np.searchsorted(rows.stamps, times + SAME_INSTANT_SECONDS, side="right") - 1
        held_values: Array = values[np.maximum(last_rows, 0)]
        return held_values

    def _read_stamps(self, log: LogFile, run_rows: Mask | None) -> tuple[Array, Mask]:
        """Return the stamps (N,) of a log in its own unit, and a mask of those that are new.

        Shapes: N rows.

        A stamp that repeats the previous one is not new. Few repeated stamps are tolerated, many
        mean that the column is not a clock. If the log has no stamps, they follow from the sampling
        rate, in seconds.

        Args:
            log: log with its columns by name.
            run_rows: mask of the rows of one run; None for all.

        Raises:
            InputError: A stamp is missing or decreases, or many stamps repeat the previous one.
        """
        if self._sampling_rate:
            longest = max(len(values) for values in log.columns.values())
            count = longest if run_rows is None else int(run_rows.sum())
            return np.arange(count) / self._sampling_rate, np.ones(count, dtype=bool)
        stamps = log.get_column(self._time_column)
        stamps = stamps if run_rows is None else stamps[run_rows]
        location = f"{log.path}, column {self._time_column}"
        if not np.isfinite(stamps).all():
            # `first` is the number of the first row of data in the file, for messages.
            row = int(np.flatnonzero(~np.isfinite(stamps))[0]) + log.first
            raise InputError(f"{location}, {log.rows} {row}: expected a stamp, found none")
        if np.abs(stamps).max() * self._seconds_per_unit > MAX_TIMESTAMP_SECONDS:
            raise InputError(
                f"{location}: expected stamps in the unit that [time] states, found "
                f"{stamps[0]:.12g}; is it milliseconds or less?"
            )
        steps = np.diff(stamps)
        bad_steps = np.flatnonzero(steps < 0)  # index of the stamp before each decrease
        if not bad_steps.size and (steps == 0).sum() > MAX_REPEATED * stamps.size:
            bad_steps = np.flatnonzero(steps == 0)
        if bad_steps.size:
            row = int(bad_steps[0]) + 1 + log.first
            raise InputError(
                f"{location}, {log.rows} {row}: expected more than {stamps[bad_steps[0]]:.12g}, "
                f"found {stamps[bad_steps[0] + 1]:.12g}; take out rows that came twice or late"
            )
        is_new: Mask = np.diff(stamps, prepend=-np.inf) > 0
        return np.asarray(stamps), is_new


def _find_file(folder: Path, column: str, files: Sequence[str]) -> str:
    """Return the first of some files that has a column, for an extra column without a file.

    Args:
        folder: folder of the logs.
        column: name of the column, in any case.
        files: names of the files.

    Raises:
        InputError: No file has it.
    """
    for file in dict.fromkeys(files):
        log = read_log(folder / Path(file), frozenset({column}))
        if column.strip().lower() in {name.strip().lower() for name in log.list_columns()}:
            return file
    searched = ", ".join(dict.fromkeys(files))
    raise InputError(
        f"{folder}: column '{column}': expected it in one of {searched}, found none there; state "
        f'[extra.{toml_key(column)}] file = "NAME", column = "NAME"'
    )
