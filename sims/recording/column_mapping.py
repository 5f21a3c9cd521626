"""Map the columns of a recording to raw logs that were not written for simgap.

The mapping is stated by `file`, `column`, `matrix`, `[time]` and `runs.NAME.folder` in a
description.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from sims.core.simulator import Array, InputError
from sims.core.toml_validation import (
    check_finite,
    check_known_names,
    check_text,
    get_subtable,
    make_error,
    read_toml,
)
from sims.recording.unit_conversion import compute_unit_scale

TIME_KEYS = ("offset", "column", "unit", "rate")
"""Keys allowed in `[time]`."""


class SignalSource(NamedTuple):
    """Location of a signal: a file relative to its run's folder, and columns of that file.

    The signal is the weighted sum of the columns, which for one column has the weight 1. Weights
    convert coupled drives to the joint side: a row of their coupling matrix.

    Attributes:
        file: File, relative to the folder of the run; empty for the usual one.
        columns: Names of the columns.
        weights: Weight of each column.
    """

    file: str
    columns: tuple[str, ...]
    weights: tuple[float, ...] = (1.0,)

    def combine(self, read_column: Callable[[str], Array]) -> Array:
        """Return the weighted sum (T,) of the columns, in their unit.

        Shapes: T rows.

        Args:
            read_column: Function that returns a column (T,) by name.
        """
        first, *others = map(read_column, self.columns)
        if self.weights == (1.0,):
            # A single column is returned without a copy.
            return first
        first_weight, *other_weights = self.weights
        weighted_columns = (w * column for w, column in zip(other_weights, others, strict=True))
        return sum(weighted_columns, first_weight * first)


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
        extra: Location of each column that is neither channel nor input. Without a file, it is in
            the first file of the other signals that has such a column.
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
    extra: Mapping[str, SignalSource] = field(default_factory=dict)


def read_sources(
    path: Path,
    meta: Mapping[str, Any],
    columns: Mapping[str, Mapping[str, Any]],
    extra: Mapping[str, Mapping[str, Any]],
) -> RecordingSources:
    """Read from a description in which files and columns of the logs the signals are.

    The table ``[time]`` states the time stamps, each signal its file and columns, and
    ``[runs.NAME]`` the folder or file of a run. If nothing is stated, the recording is a table in
    the format of simgap, whose columns have the names of the signals.

    Args:
        path: Path of the description, for messages.
        meta: Content of the description.
        columns: Entries of each channel and input in the description.
        extra: Entries of each column that is neither.

    Raises:
        InputError: The description is malformed.
    """
    time = get_subtable(path, meta, "time")
    check_known_names(f"entry in [time] of {path}", time, TIME_KEYS)
    time_column = check_text(path, "time.column", time.get("column", "t"))
    unit = check_text(path, "time.unit", time.get("unit", "s"))
    try:
        seconds_per_unit = compute_unit_scale(unit, "s").gain
    except InputError as error:
        raise InputError(f"{path}: time.unit: {error}") from None
    rate = _read_sampling_rate(path, time)
    signals = {name: _read_source(path, name, table) for name, table in columns.items()}
    folders, run_files = {}, {}
    for name, run_table in get_subtable(path, meta, "runs").items():
        if not isinstance(run_table, dict):  # refused when the runs are read
            continue
        if "file" in run_table:
            run_files[name] = check_text(path, f"runs.{name}.file", run_table["file"])
            folders[name] = ""  # the folder of the description, unless one is stated
        if "folder" in run_table:
            folders[name] = check_text(path, f"runs.{name}.folder", run_table["folder"])
    tables = (*columns.values(), *extra.values())
    has_columns = any({"file", "column"} & table.keys() for table in tables)
    # Tables in the format of simgap have neither files nor folders, nor another time than t in s.
    is_other_format = (
        any("file" in table for table in tables)
        or bool(folders)
        or bool({"column", "unit", "rate"} & time.keys())
    )
    return RecordingSources(
        signals=signals,
        time=time_column,
        second=seconds_per_unit,
        offset=check_finite(path, "time.offset", time.get("offset", 0.0)),
        folders=folders,
        stated=has_columns or is_other_format,
        rate=rate,
        files=run_files,
        is_renaming=has_columns and not is_other_format,
        extra={
            name: _read_source(path, f"extra.{name}", table, name) for name, table in extra.items()
        },
    )


def _read_source(path: Path, key: str, table: Mapping[str, Any], default: str = "") -> SignalSource:
    """Read the location of one signal: `file`, `column` and `matrix` of its table.

    A signal is one column, or a weighted sum of several columns, whose weights are `matrix`.

    Args:
        path: Path of the description, for messages.
        key: Name of the table, for messages.
        table: Content of the table.
        default: Name of the column where none is stated; `key` if empty.

    Raises:
        InputError: An entry has a wrong type, or there is not one weight for each column.
    """
    file = check_text(path, f"{key}.file", table.get("file", ""))
    column = table.get("column", default or key)
    if not isinstance(column, list):
        if "matrix" in table:
            raise make_error(
                path,
                f"{key}.matrix",
                'it with several columns (column = ["A", "B"] and matrix = [0.5, -0.5])',
                table["matrix"],
            )
        return SignalSource(file, (check_text(path, f"{key}.column", column),))
    names = tuple(check_text(path, f"{key}.column", name) for name in column)
    matrix = table.get("matrix")
    if not names or not isinstance(matrix, list) or len(matrix) != len(names):
        raise make_error(
            path, f"{key}.matrix", f"a row of {len(names)} numbers, one for each column", matrix
        )
    weights = tuple(check_finite(path, f"{key}.matrix", weight) for weight in matrix)
    if not any(weights):
        raise make_error(path, f"{key}.matrix", "a number that is not zero", matrix)
    return SignalSource(file, names, weights)


def _read_sampling_rate(path: Path, time: Mapping[str, Any]) -> float:
    """Return the sampling rate in Hz of logs without time stamps; 0 if the logs have time stamps.

    Args:
        path: path of the description, for messages.
        time: its table ``[time]``.

    Raises:
        InputError: the rate is not positive, or a column or unit of stamps is stated as well.
    """
    if "rate" not in time:
        return 0.0
    for unused_key in ("column", "unit"):
        if unused_key in time:
            raise InputError(
                f"{path}: time: expected a rate, or column and unit of stamps, found both; leave "
                "one out"
            )
    rate = check_finite(path, "time.rate", time["rate"])
    if rate <= 0:
        raise make_error(path, "time.rate", "a number of rows a second, more than 0", time["rate"])
    return rate


def list_mapped_files(description: Path) -> list[Path]:
    """List the files that a description may refer to: its table, logs, bags and model file.

    Each stated file is listed in the folder of each run; it need not exist there. Malformed entries
    are skipped here; they are refused when the recording is read.

    Args:
        description: Path of the description.
    """
    try:
        meta = read_toml(description)
    except InputError:
        return []
    # A signal without a file is in the table that has the description's name, in each folder.
    files = [description.with_suffix(".csv").name]
    for key in ("channels", "inputs", "extra", "runs"):
        files += _collect_texts(meta.get(key), "file")
    folders = _collect_texts(meta.get("runs"), "folder") or [""]
    folder_of_all = description.parent
    paths = [folder_of_all / folder / file for folder in folders for file in dict.fromkeys(files)]
    model = meta.get("model")
    return [*paths, folder_of_all / model] if isinstance(model, str) else paths


def _collect_texts(tables: Any, key: str) -> list[str]:
    """Collect all texts under a key in nested tables, such as all stated file names."""
    if not isinstance(tables, dict):
        return []
    texts = [tables[key]] if isinstance(tables.get(key), str) else []
    return texts + [text for table in tables.values() for text in _collect_texts(table, key)]
