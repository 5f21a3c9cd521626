"""Map the columns of a recording to raw logs that were not written for simgap.

The mapping is stated by `file`, `column`, `[time]` and `runs.NAME.folder` in a description.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sims.core.simulator import Array, InputError, make_read_only
from sims.core.toml_validation import (
    check_finite,
    check_known_names,
    check_table,
    check_text,
    make_error,
    read_toml,
)
from sims.core.value_limits import MAX_NAME_LENGTH, MAX_TIMESTAMP_SECONDS, MIN_RUN_SECONDS
from sims.recording.csv_table import CsvRun
from sims.recording.log_formats.log_files import LogFile, read_log
from sims.recording.unit_conversion import compute_unit_scale

TIME_KEYS = ("offset", "column", "unit", "rate")
"""Keys allowed in `[time]`."""
MAX_REPEATED = 0.05
"""Maximum share of a log's stamps that may repeat the previous one; their rows are left out."""
SAME_INSTANT_SECONDS = 1e-9
"""Maximum difference of two stamps in different files that count as the same time, in seconds."""


class SignalSource(NamedTuple):
    """Location of a signal: a file relative to its run's folder, and a column of that file."""

    file: str
    column: str


@dataclass(frozen=True)
class RecordingSources:
    """Locations of all columns of a recording.

    Attributes:
        signals: Location of each channel and input.
        time: Name of the column of stamps, in every file.
        second: Factor from the unit of the stamps to seconds.
        offset: Delay of the inputs relative to their stamps, s.
        folders: Folder of each run, relative to the description; empty if there is one run.
        stated: Whether the description states any location; otherwise the table was written for
            simgap.
        rate: Sampling rate in Hz of logs without stamps; 0 if the logs have stamps.
        files: By run, the file of signals without a stated file, relative to the run's folder.
        is_renaming: Whether only column names are stated, so that the table may be one written for
            simgap with other names.
    """

    signals: Mapping[str, SignalSource]
    time: str
    second: float
    offset: float
    folders: Mapping[str, str] = field(default_factory=dict)
    stated: bool = False
    rate: float = 0.0
    files: Mapping[str, str] = field(default_factory=dict)
    is_renaming: bool = False


def read_sources(
    path: Path, meta: Mapping[str, Any], columns: Mapping[str, Mapping[str, Any]]
) -> RecordingSources:
    """Read the locations of all columns from a description.

    Args:
        path: Path of the description, for messages.
        meta: Content of the description.
        columns: Table of each channel and input in the description.

    Raises:
        InputError: The description is malformed.
    """
    time = check_table(path, "time", meta.get("time", {}))
    check_known_names(f"entry in [time] of {path}", time, TIME_KEYS)
    stamps = check_text(path, "time.column", time.get("column", "t"))
    unit = check_text(path, "time.unit", time.get("unit", "s"))
    try:
        second = compute_unit_scale(unit, "s").gain
    except InputError as error:
        raise InputError(f"{path}: time.unit: {error}") from None
    rate = _rate(path, time)
    signals = {}
    for name, own in columns.items():
        file = check_text(path, f"{name}.file", own.get("file", ""))
        column = check_text(path, f"{name}.column", own.get("column", name))
        signals[name] = SignalSource(file, column)
    folders, own_files = {}, {}
    for name, marks in check_table(path, "runs", meta.get("runs", {})).items():
        if not isinstance(marks, dict):
            continue
        if "file" in marks:
            own_files[name] = check_text(path, f"runs.{name}.file", marks["file"])
            folders[name] = ""
        if "folder" in marks:
            folders[name] = check_text(path, f"runs.{name}.folder", marks["folder"])
    said = any({"file", "column"} & own.keys() for own in columns.values())
    elsewhere = any("file" in own for own in columns.values()) or bool(folders)
    elsewhere = elsewhere or bool({"column", "unit", "rate"} & time.keys())
    return RecordingSources(
        signals,
        stamps,
        second,
        check_finite(path, "time.offset", time.get("offset", 0.0)),
        folders,
        said or elsewhere,
        rate,
        own_files,
        said and not elsewhere,
    )


def _rate(path: Path, time: Mapping[str, Any]) -> float:
    """Return the sampling rate of logs without stamps, Hz; 0 if the logs have stamps."""
    if "rate" not in time:
        return 0.0
    for other in ("column", "unit"):
        if other in time:
            raise InputError(
                f"{path}: time: expected a rate, or column and unit of stamps, found both; leave "
                "one out"
            )
    rate = check_finite(path, "time.rate", time["rate"])
    if rate <= 0:
        raise make_error(path, "time.rate", "a number of rows a second, more than 0", time["rate"])
    return rate


def list_mapped_files(description: Path) -> list[Path]:
    """List the files that a description refers to: its table, logs, bags and model file.

    Malformed entries are skipped here; they are refused when the recording is read.
    """
    try:
        meta = read_toml(description)
    except InputError:
        return []
    signals = [_named(meta.get(kind), "file") for kind in ("channels", "inputs", "runs")]
    folders = _named(meta.get("runs"), "folder") or [""]
    # A signal without a file is in the table that has the description's name, in each folder.
    usual = description.with_suffix(".csv").name
    files = dict.fromkeys([usual, *(name for names in signals for name in names)])
    paths = [description.parent / folder / file for folder in folders for file in files]
    model = [name for name in (meta.get("model"),) if isinstance(name, str)]
    return [*paths, *(description.parent / name for name in model)]


def _named(tables: Any, word: str) -> list[str]:
    """Return the values of a key in nested tables, at any depth."""
    if not isinstance(tables, dict):
        return []
    own = [tables[word]] if isinstance(tables.get(word), str) else []
    return own + [name for inner in tables.values() for name in _named(inner, word)]


def read_logs(
    path: Path,
    sources: RecordingSources,
    channels: Sequence[str],
    inputs: Sequence[str],
    linear: frozenset[str],
) -> list[CsvRun]:
    """Read the runs of a recording from its logs.

    The rows of a run are all times at which a sensor or an input has a stamp, from the first to the
    last sample of a sensor. The cells of a sensor are empty between its own stamps; an input has
    its held or interpolated value at all times. So measurements are not resampled.

    Args:
        path: Table in which signals without a file are found.
        sources: Location of each signal.
        channels: Names of the measured signals.
        inputs: Names of the inputs.
        linear: Inputs that are interpolated linearly between samples.

    Raises:
        InputError: A log is malformed; the message is one line.
    """
    runs = []
    for name, folder in (sources.folders or {"": ""}).items():
        here = path.parent / folder
        if len(name) > MAX_NAME_LENGTH:
            raise InputError(f"{path}: the name of run {name[:40]}… is too long")
        usual = sources.files.get(name, path.name)
        parts = _Parts(here, usual, sources, (*channels, *inputs))
        for own, rows in parts.runs(name):
            runs.append(parts.joined(own, rows, channels, inputs, linear))
    return runs


class _Parts:
    """Logs of one folder."""

    def __init__(
        self, folder: Path, usual: str, sources: RecordingSources, signals: Sequence[str]
    ) -> None:
        self.sources = sources
        files = {name: sources.signals[name].file or usual for name in signals}
        wanted: dict[str, set[str]] = {}
        for name, file in files.items():
            own = wanted.setdefault(file, set() if sources.rate else {sources.time})
            own.add(sources.signals[name].column)
        self.logs: dict[str, LogFile] = {
            name: read_log(folder / Path(file), frozenset(wanted[file]))
            for name, file in files.items()
        }

    def runs(self, name: str) -> list[tuple[str, Array | None]]:
        """Return the names of the runs in these files, each with a mask of its rows.

        The mask is None where all rows belong to one run.
        """
        first = next(iter(self.logs.values()))
        alone = all(log.path == first.path for log in self.logs.values())
        if name or not alone or "run" not in first.columns:
            return [(name or "1", None)]
        numbers = first.get_column("run")
        order = list(dict.fromkeys(numbers.tolist()))
        return [(f"{number:g}", numbers == number) for number in order]

    def joined(
        self,
        name: str,
        rows: Array | None,
        channels: Sequence[str],
        inputs: Sequence[str],
        linear: frozenset[str],
    ) -> CsvRun:
        """Join the logs of one run into a table.

        Args:
            name: Name of the run.
            rows: Mask of the run's rows; None for all rows.
            channels: Names of the measured signals.
            inputs: Names of the inputs.
            linear: Inputs that are interpolated linearly between samples.

        Raises:
            InputError: A log has missing or decreasing stamps, or a signal has no samples.
        """
        stamps: dict[Path, Array] = {}
        # Rows of each file that are used; of rows with the same stamp, only the first.
        kept: dict[Path, Any] = {}
        notes = []
        for log in self.logs.values():
            if log.path in stamps:
                continue
            own, first = self._stamps(log, rows)
            stamps[log.path] = own[first]
            chosen = np.arange(own.size) if rows is None else np.flatnonzero(rows)
            kept[log.path] = chosen[first]
            if not first.all():
                repeated = f"{int((~first).sum())} of {own.size} stamps repeat the one before"
                notes.append(f"{log.path}: {repeated}; their {log.rows}s are left out")
        # Clocks of robots count from 1970: the remaining resolution is too coarse for rates, so
        # subtract the first stamp.
        zero = min(own[0] for own in stamps.values())
        stamps = {path: self.sources.second * (own - zero) for path, own in stamps.items()}
        measured = np.unique(np.concatenate([stamps[self.logs[c].path] for c in channels]))
        given = [stamps[self.logs[u].path] for u in inputs]
        times = np.unique(np.concatenate([measured, *given]))
        times = times[(times >= measured[0]) & (times <= measured[-1])]
        times = times[np.diff(times, prepend=-np.inf) > SAME_INSTANT_SECONDS]
        path = self.logs[channels[0]].path
        if times.size < 2 or times[-1] - times[0] < MIN_RUN_SECONDS:
            raise InputError(f"{path}: run {name!r}: expected at least two instants, found one")
        columns = {}
        for channel in channels:
            log = self.logs[channel]
            values = self._values(log, channel, kept)
            if not np.isfinite(values).any():
                raise InputError(f"{log.path}: column {channel} has no sample; leave it out")
            cells = np.full(times.size, np.nan)
            places = np.searchsorted(times, stamps[log.path] - SAME_INSTANT_SECONDS)
            inside = (places < times.size) & (stamps[log.path] >= times[0] - SAME_INSTANT_SECONDS)
            cells[places[inside]] = values[inside]
            columns[channel] = make_read_only(cells)
        for name_, own in zip(inputs, given, strict=True):
            columns[name_] = make_read_only(self._given(name_, own, times, kept, name_ in linear))
        return CsvRun(name, make_read_only(times), columns, tuple(notes))

    def _values(self, log: LogFile, signal: str, kept: Mapping[Path, Any]) -> Array:
        name = self.sources.signals[signal].column
        values, rows = log.get_column(name), kept[log.path]
        if rows.size and rows[-1] >= values.size:
            raise InputError(
                f"{log.path}, column {name}: expected a number for each stamp, found "
                f"{values.size} numbers and at least {rows[-1] + 1} stamps"
            )
        taken: Array = values[rows]
        return taken

    def _given(
        self,
        signal: str,
        stamps: Array,
        times: Array,
        kept: Mapping[Path, Any],
        straight: bool,
    ) -> Array:
        """Return the values of an input at all times of a run.

        Args:
            signal: Name of the input.
            stamps: Stamps of the input's log, s.
            times: (T,) times of the run, s.
            kept: Rows of each log that are used.
            straight: Whether to interpolate linearly instead of holding the last value.

        Returns:
            (T,) values in the unit of the log.
        """
        log = self.logs[signal]
        values = self._values(log, signal, kept)
        missing = np.flatnonzero(~np.isfinite(values))
        if missing.size:
            row = int(kept[log.path][missing[0]]) + log.first
            raise InputError(
                f"{log.path}, {log.rows} {row}, column {self.sources.signals[signal].column}: "
                f"expected a number, found none; what was put in is known at every stamp"
            )
        if straight:
            return np.interp(times, stamps, values)
        places = np.searchsorted(stamps, times + SAME_INSTANT_SECONDS, side="right") - 1
        held: Array = values[np.maximum(places, 0)]
        return held

    def _stamps(
        self, log: LogFile, rows: Array | None
    ) -> tuple[Array, np.ndarray[tuple[int, ...], np.dtype[np.bool_]]]:
        """Return the stamps (T,) of a log in its own unit, and a mask of the unrepeated ones.

        Raises:
            InputError: A stamp is missing or decreases, or many stamps repeat the previous one.
        """
        if self.sources.rate:
            longest = max(len(values) for values in log.columns.values())
            count = longest if rows is None else int(rows.sum())
            return np.arange(count) / self.sources.rate, np.ones(count, dtype=bool)
        stamps = log.get_column(self.sources.time)
        stamps = stamps if rows is None else stamps[rows]
        where = f"{log.path}, column {self.sources.time}"
        if not np.isfinite(stamps).all():
            row = int(np.flatnonzero(~np.isfinite(stamps))[0]) + log.first
            raise InputError(f"{where}, {log.rows} {row}: expected a stamp, found none")
        if np.abs(stamps).max() * self.sources.second > MAX_TIMESTAMP_SECONDS:
            raise InputError(
                f"{where}: expected stamps in the unit that [time] states, found {stamps[0]:.12g}; "
                "is it milliseconds or less?"
            )
        steps = np.diff(stamps)
        bad = np.flatnonzero(steps < 0)
        if not bad.size and (steps == 0).sum() > MAX_REPEATED * stamps.size:
            bad = np.flatnonzero(steps == 0)
        if bad.size:
            row = int(bad[0]) + 1 + log.first
            raise InputError(
                f"{where}, {log.rows} {row}: expected more than {stamps[bad[0]]:.12g}, found "
                f"{stamps[bad[0] + 1]:.12g}; take out rows that came twice or late"
            )
        return np.asarray(stamps), np.asarray(np.diff(stamps, prepend=-np.inf) > 0)
