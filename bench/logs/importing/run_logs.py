"""Find the runs among the files of a folder, and the logs of each run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.logs.importing import column_guessing
from bench.logs.importing.column_guessing import LogColumn
from bench.logs.importing.import_result import MAX_NAMES, ImportResult
from sims.core.simulator import Array, InputError
from sims.recording.log_formats.hdf5_and_parquet import is_hdf5, list_run_paths
from sims.recording.log_formats.lerobot_dataset import is_dataset
from sims.recording.log_formats.log_columns import LogFile
from sims.recording.log_formats.log_files import LOG_SUFFIXES, list_logs, read_log
from sims.recording.log_formats.ros_bags import BAG_SUFFIXES, is_bag

TABLE_ENDINGS = tuple(ending for ending in LOG_SUFFIXES if ending not in (".txt", ".dat"))
"""File extensions of logs that are read from a folder; other text files may contain anything."""


class RunFiles(NamedTuple):
    """The logs of one run.

    Attributes:
        folder: Folder or bag that contains the logs.
        paths: Paths of the logs.
        alone: Whether the run is one file of a folder whose other files are runs as well.
        chosen: Whether the user named the files; then each of them must be readable.
    """

    folder: Path
    paths: list[Path]
    alone: bool = False
    chosen: bool = False

    def name(self, path: Path) -> str:
        """Return the name of a log in a description."""
        return path.relative_to(self.folder).as_posix()


def group_logs_by_run(logs: Sequence[Path]) -> dict[str, RunFiles]:
    """Group logs by run: those of each folder, bag or episode, or the files themselves.

    A bag (ROS) and an episode of a dataset (LeRobot) are one run each. The files of one folder are
    one run, unless it is the only one and all of its files have the same columns: then each file is
    a run, and so is each numbered group of a single HDF5 file.

    Args:
        logs: Files, folders of files, bags or datasets, or folders that contain such.

    Returns:
        Files of each run by its name; files that are named one by one are a run with the name "".

    Raises:
        InputError: There is no log, or there are both files and folders.
    """
    files = [path for path in logs if not path.is_dir() and not is_bag(path)]
    runs: dict[str, RunFiles] = {}
    for path in logs:
        if path not in files:
            runs |= _find_runs_in_folder(path)
    if files and runs:
        raise InputError("expected files of one run, or folders of one run each, found both")
    if files:
        folders = {path.parent for path in files}
        if len(folders) > 1:
            raise InputError("expected the files of one run in one folder; name the folders")
        runs = {"": RunFiles(folders.pop(), files, chosen=True)}
    if not runs:
        log_names = ", ".join(map(str, logs))
        kinds = ", ".join((*TABLE_ENDINGS, *BAG_SUFFIXES))
        raise InputError(f"{log_names}: expected logs ({kinds}), found none")
    if len(runs) == 1:
        ((name, run),) = runs.items()
        return _make_run_per_group(run) or _make_run_per_file(run) or {name: run}
    return runs


def _find_runs_in_folder(folder: Path) -> dict[str, RunFiles]:
    """Find the runs of a folder, bag or dataset, including those one level below it.

    Args:
        folder: ROS bag, LeRobot dataset, or folder of files and of further folders.

    Returns:
        Files of each run by its name: that of the bag, the episode or the folder.
    """
    is_whole = is_bag(folder) or is_dataset(folder)
    parts = [folder] if is_whole else [folder, *sorted(folder.iterdir())]
    datasets = [part for part in parts if is_dataset(part)]
    runs: dict[str, RunFiles] = {}
    for part in parts:
        if part in datasets:
            # Datasets number their episodes alike.
            prefix = f"{part.name}_" if len(datasets) > 1 else ""
            runs |= {
                f"{prefix}{path.parent.name}": RunFiles(path.parent, [path])
                for path in list_logs(part)
            }
            continue
        if is_bag(part):
            paths = list(list_logs(part))
        elif part.is_dir():
            paths = [path for path in list_logs(part) if path.suffix.lower() in TABLE_ENDINGS]
        else:  # a file, which belongs to the run of its folder
            continue
        if paths:
            # Some bags are files, whose extension is no part of the name.
            runs[part.stem if part.is_file() else part.name] = RunFiles(part, paths)
    return runs


def _make_run_per_group(run: RunFiles) -> dict[str, RunFiles]:
    """Return a run for each group of an HDF5 file with several runs; otherwise an empty dict.

    Args:
        run: run that consists of the file.
    """
    if len(run.paths) != 1 or not is_hdf5(run.paths[0]):
        return {}
    groups = list_run_paths(run.paths[0])
    if groups == run.paths:  # the file itself is the only run
        return {}
    return {
        group.name: RunFiles(run.folder, [group], alone=True, chosen=run.chosen) for group in groups
    }


def _make_run_per_file(run: RunFiles) -> dict[str, RunFiles]:
    """Return a run for each file if all files have the same columns; otherwise an empty dict.

    Files with equal columns are runs; files with different columns are parts of one run.

    Args:
        run: Files that a user named together.

    Returns:
        Runs by the stem of their file name.
    """
    tables = [path for path in run.paths if path.suffix.lower() in TABLE_ENDINGS and path.is_file()]
    stems = [path.stem for path in tables]
    # There is a single file, some log is not a table file, or names of runs would repeat.
    if len(tables) < 2 or len(tables) < len(run.paths) or len(set(stems)) < len(stems):
        return {}
    columns = []
    for path in tables:
        try:
            columns.append(tuple(read_log(path).list_columns()))
        except InputError:  # Reported when the run is read.
            return {}
    if len(set(columns)) > 1:
        return {}
    return {
        path.stem: RunFiles(run.folder, [path], alone=True, chosen=run.chosen) for path in tables
    }


MAX_RUNS = 8
"""Maximum number of runs that are read to decide what a column is."""


class RunLogs:
    """Logs of the runs that are imported. The first run decides which columns there are.

    Attributes:
        runs: Files of each run.
        rate: Rate of the rows in Hz; None if the logs have time stamps.
        time_column: Name of the column of time stamps; empty if there is none.
        time_unit: Its unit.
        columns: Columns of the first run with one number for each time stamp, except the stamps.
        seconds: (T,) time stamps of each file of the first run, from its first stamp.

    Raises:
        InputError: A file that the user named cannot be read, or no file can.
    """

    def __init__(
        self,
        runs: Mapping[str, RunFiles],
        rate: float | None,
        joint_names: Sequence[str],
        result: ImportResult,
    ) -> None:
        """Read the files of the first run, find their time stamps, and list the columns to import.

        Without time stamps (`rate` is given), the time of row k is k / rate in seconds. `_starts`
        has the first time stamp of each file in seconds from the earliest one of all files, and
        `_cache` the files that were read already. `seconds` has the times (T,) of the rows of each
        file, from its first row, and `columns` the columns that may be imported.

        Args:
            runs: Files of each run.
            rate: Rate of the rows in Hz, if the logs have no time stamps.
            joint_names: Names of the robot's joints, for messages.
            result: Result to which messages are added.
        """
        self.runs, self.rate = runs, rate
        self.time_column, self.time_unit = "", "s"
        self.seconds: dict[str, Array] = {}
        self._joint_names, self._result = joint_names, result
        self._starts: dict[str, float] = {}
        self._cache: dict[Path, LogFile] = {}
        logs = self._read_first_run()
        if rate is not None:
            for file, log in logs.items():
                # The longest column has all rows.
                count = max(log.get_column(name).size for name in log.list_columns())
                self.seconds[file], self._starts[file] = np.arange(count) / rate, 0.0
        else:
            self._choose_clock(logs)
        self.columns = self._complete_columns(logs)

    @property
    def first_path(self) -> Path:
        """Path of the first log of the first run."""
        return next(iter(self.runs.values())).paths[0]

    def read(self, run: str, column: LogColumn) -> tuple[Array, Array] | None:
        """Return time stamps (T,) in s and values (T,) of a column in a run.

        Args:
            run: Name of the run.
            column: Column to read; its file is only used if a run has several files.

        Returns:
            Time stamps and values; None if the run lacks the column or its time stamps.
        """
        files = self.runs[run]
        paths = files.paths
        # If each run is one file, its name differs from run to run and does not count.
        if not files.alone:
            paths = [path for path in paths if files.name(path) == column.file]
        if not paths:
            return None
        log = self._read_log(paths[0])
        if column.name not in log.list_columns():
            return None
        values = log.get_column(column.name)
        if self.rate is not None:
            return np.arange(values.size) / self.rate, values
        if self.time_column not in log.list_columns():
            return None
        stamps = log.get_column(self.time_column)
        if stamps.size != values.size:
            return None
        return column_guessing.TIME_UNITS[self.time_unit] * stamps, values

    def read_runs(self, column: LogColumn) -> list[Array]:
        """Return the values (T,) of a column in those of the first `MAX_RUNS` runs that have it."""
        samples = [self.read(run, column) for run in list(self.runs)[:MAX_RUNS]]
        return [values for _, values in (pair for pair in samples if pair is not None)]

    def hold_command(self, command: LogColumn, position: LogColumn) -> tuple[Array, Array]:
        """Return a command (T,) at the sample times of a position, and that position (T,).

        Both are those of the first run. A command holds until the next one.

        Args:
            command: column of the command.
            position: column of the position, perhaps of another file with other sample times.
        """
        if command.file == position.file:
            return command.values, position.values
        # Seconds count from the first stamp of each file, which differ by the offset.
        offset = self._starts[command.file] - self._starts[position.file]
        stamps = self.seconds[command.file] + offset
        return hold_signal(stamps, command.values, self.seconds[position.file]), position.values

    # -- files

    def _read_log(self, path: Path) -> LogFile:
        """Read a log; each file is read only once."""
        if path not in self._cache:
            self._cache[path] = read_log(path)
        return self._cache[path]

    def _read_first_run(self) -> dict[str, LogFile]:
        """Read the logs of the first run; leave out unreadable logs of a folder.

        Returns:
            Content of each log by its name in the description.

        Raises:
            InputError: A file that the user named cannot be read, or no file can.
        """
        files = next(iter(self.runs.values()))
        logs: dict[str, LogFile] = {}
        errors: list[InputError] = []
        for path in files.paths:
            try:
                log = self._read_log(path)
                if not log.named:
                    raise self._make_missing_header_error(log)
            except InputError as error:
                errors.append(error)
                self._leave_out_file(files.name(path), error, path)
                continue
            logs[files.name(path)] = log
        # No file can be read: the first error is the reason.
        if not logs:
            raise errors[0]
        return logs

    def _make_missing_header_error(self, log: LogFile) -> InputError:
        """Make the error for a table whose first row contains numbers.

        Args:
            log: Table without a header.
        """
        names = ["t", *(f"{name}_pos" for name in self._joint_names)]
        example_header = ",".join(names[:MAX_NAMES])
        return InputError(
            f"{log.path}, row {log.first}: expected a header that names the "
            f"{len(log.list_columns())} columns, found numbers; put one above, such as "
            f"{example_header},..."
        )

    def _leave_out_file(self, file: str, error: InputError, path: Path) -> None:
        """Report that a file is left out, or raise the error if the user named the file.

        Args:
            file: name of the file in messages.
            error: why it cannot be read.
            path: its path, which is removed from the message.

        Raises:
            InputError: The user named the file.
        """
        # `chosen` is the same for all runs.
        if next(iter(self.runs.values())).chosen:
            raise error
        text = str(error).removeprefix(str(path)).lstrip(",: ")
        self._result.untold.append(f"{file}: {text}; left out")

    # -- time stamps

    def _choose_clock(self, logs: Mapping[str, LogFile]) -> None:
        """Choose the column of time stamps, whose name and unit all files must share.

        Each file has candidates; a name that all files share is preferred. The name and unit of the
        files with the most recognised columns are used, and files with other stamps are left out.
        The times `seconds` count from the first stamp of each file; `_starts` is the time from the
        earliest stamp of all files to that one.

        Args:
            logs: Logs of the first run by file.

        Raises:
            InputError: A file that the user named has other stamps or none, or no file has stamps.
        """
        clocks = self._list_clocks(logs)
        names = [{column.name for column, _ in candidates} for candidates in clocks.values()]
        # Prefer a name that all files share: the stamp in a message's header over its time of
        # arrival.
        common = set.intersection(*names)
        clocks_by_file = {
            file: next((pair for pair in candidates if pair[0].name in common), candidates[0])
            for file, candidates in clocks.items()
        }
        # Number of columns with a known role, by name and unit of the stamps of their file.
        counts = Counter[tuple[str, str]]()
        for file, (column, unit) in clocks_by_file.items():
            roles = map(column_guessing.guess_role, _list_all_columns(file, logs[file]))
            counts[column.name, unit] += sum(role is not None for role in roles)
        self.time_column, self.time_unit = max(counts, key=lambda key: counts[key])
        earliest_stamp = min(float(column.values[0]) for column, _ in clocks_by_file.values())
        for file, (column, unit) in clocks_by_file.items():
            if (column.name, unit) != (self.time_column, self.time_unit):
                path = logs[file].path
                error = InputError(
                    f"{path}: its stamps are called {column.name} ({unit}), those of the files "
                    f"before {self.time_column} ({self.time_unit}); give them one name"
                )
                self._leave_out_file(file, error, path)
                continue
            # Robot clocks often count from 1970, and floats of that size resolve fractions of a
            # second coarsely, so the first stamp is subtracted before scaling.
            second = column_guessing.TIME_UNITS[unit]
            self.seconds[file] = second * (column.values - column.values[0])
            self._starts[file] = second * float(column.values[0] - earliest_stamp)
            repeated = int((np.diff(column.values) == 0).sum())
            if repeated:
                self._result.untold.append(
                    f"{file}: {repeated} of {column.values.size} stamps repeat the one before; "
                    "their rows are left out"
                )
        steps = np.diff(next(iter(self.seconds.values())))
        rate = 1.0 / float(np.median(steps[steps > 0]))
        self._result.guessed.append(
            f"time: column {self.time_column} in {self.time_unit}, {rate:.4g} Hz"
        )

    def _list_clocks(self, logs: Mapping[str, LogFile]) -> dict[str, list[tuple[LogColumn, str]]]:
        """Find for each file the columns that may be its time stamps, with their units.

        Files without such a column are left out with a message.

        Args:
            logs: Logs of the first run by file.

        Returns:
            By file, pairs of column and unit (s, ms, us or ns), the most likely first.

        Raises:
            InputError: A file that the user named has no such column, or no file has one.
        """
        clocks: dict[str, list[tuple[LogColumn, str]]] = {}
        errors: list[InputError] = []
        for file, log in logs.items():
            columns = column_guessing.list_clock_columns(_list_all_columns(file, log))
            # The unit that the file states, else the one with a plausible sampling rate.
            units = [
                column.unit
                if column.quantity == "time" and column.unit in column_guessing.TIME_UNITS
                else column_guessing.guess_time_unit(column.values)
                for column in columns
            ]
            candidates = [
                (column, unit)
                for column, unit in zip(columns, units, strict=True)
                if unit is not None
            ]
            if candidates:
                clocks[file] = candidates
                continue
            if columns:
                steps = np.diff(columns[0].values)
                interval = float(np.median(steps[steps > 0]))
                error = InputError(
                    f"{log.path}, column {columns[0].name}: stamps {interval:g} apart are not "
                    "plausible in s, ms, us or ns"
                )
            else:
                error = InputError(
                    f"{log.path}: no column increases from row to row; expected one of stamps; "
                    "state the rate of the rows with --rate HZ if there is none"
                )
            errors.append(error)
            self._leave_out_file(file, error, log.path)
        if not clocks:
            raise errors[0]
        return clocks

    def _complete_columns(self, logs: Mapping[str, LogFile]) -> list[LogColumn]:
        """Return the columns, except the time stamps, with one number for each time stamp.

        Columns of another length or without any number are left out with a message.

        Args:
            logs: Logs of the first run by file.
        """
        columns = []
        for file, seconds in self.seconds.items():
            for column in _list_all_columns(file, logs[file]):
                if column.name == self.time_column:
                    continue
                if column.values.size != seconds.size:
                    reason = f"has {column.values.size} numbers, not {seconds.size}"
                    self._result.leave_out(column, reason)
                elif np.isnan(column.values).all():
                    self._result.leave_out(column, "has no number")
                else:
                    columns.append(column)
        return columns


def hold_signal(stamps: Array, values: Array, times: Array) -> Array:
    """Resample a signal (T,) with a zero-order hold: each value holds until the next one.

    Before the first value, that value is returned.

    Args:
        stamps: (N,) increasing times of N values, s.
        values: (N,) values of the signal.
        times: (T,) times of the result, s.
    """
    indices = np.searchsorted(stamps, times, side="right") - 1
    held_values: Array = values[np.clip(indices, 0, values.size - 1)]
    return held_values


def _list_all_columns(file: str, log: LogFile) -> list[LogColumn]:
    """Return all numeric columns of a log; entries of lists are columns, and inf becomes NaN.

    Args:
        file: name of the log's file.
        log: its content.
    """
    columns = []
    for name in log.list_columns():
        values = log.get_column(name)
        finite = np.where(np.isfinite(values), values, np.nan)
        columns.append(LogColumn(file, name, finite, log.units.get(name, "")))
    return columns
