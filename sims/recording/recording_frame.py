"""Make recordings from pandas data frames, and state what their columns are.

Columns of a ``DataFrame`` are checked by the same rules as those of `NAME.csv`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

from sims.core.argument_checks import Expected, Name
from sims.core.number_limits import is_plausible_number
from sims.core.simulator import Array, InputError, make_unknown_name_error, similar
from sims.core.toml_validation import format_value, get_subtable, join_nested_names, to_toml_value
from sims.recording.column_mapping import SignalSource
from sims.recording.csv_table import CsvRun, RecordingTable
from sims.recording.drive_switches import read_switches
from sims.recording.recording import Recording, assemble_recording
from sims.recording.recording_description import (
    DeclaredSignals,
    RecordingDescription,
    check_description,
    get_floating_state_units,
    get_model_reference,
)

Units: TypeAlias = Annotated[
    Mapping[str, str], Expected("units of columns by their names, as {'q': 'rad'}")
]
"""Units of a data frame's columns, by column name."""


@runtime_checkable
class Frame(Protocol):
    """Protocol of the parts of a pandas ``DataFrame`` that are used here, without pandas."""

    @property
    def attrs(self) -> Any:
        """Metadata that the user attached to the frame."""

    @property
    def columns(self) -> Any:
        """Names of the columns."""

    @property
    def index(self) -> Any:
        """Labels of the rows."""

    @property
    def iloc(self) -> Any:
        """Access to rows by number."""


@dataclass(frozen=True, kw_only=True)
class FrameDescription:
    """System of a recording, and the description of a data frame, which has no `NAME.toml` file.

    Attributes:
        system: Name of the system, instead of the one that the .toml file states.
        model: Model file of a robot, MJCF or URDF, instead of what the .toml file states.
        units: Units of a DataFrame's columns by name (default: those in ``df.attrs["units"]``).
        constants: Known numbers of the system in SI units, with a DataFrame.
        description: Any further entries about a DataFrame, with the keys of ``NAME.toml``.
    """

    system: Name | None = None
    model: str | Path | None = None
    units: Units | None = None
    constants: Mapping[str, float] | None = None
    description: Mapping[str, Any] | None = None

    def refuse_for_files(self, recording: object) -> None:
        """Reject a description of a data frame if the recording is a file, which has its own.

        Args:
            recording: path of the file, for the message.

        Raises:
            InputError: units, constants or a description are given.
        """
        for name in ("units", "constants", "description"):
            if getattr(self, name):
                raise InputError(
                    f"{name}: expected only with a DataFrame; {recording} has a description "
                    "that states them"
                )


def make_frame_recording(
    frame: Frame,
    declared: DeclaredSignals,
    meta: Mapping[str, Any],
    units: Mapping[str, str],
    name: str = "DataFrame",
) -> Recording:
    """Make a recording from a data frame, checked as `read_recording` checks files.

    Only the marked runs are held out.

    Args:
        frame: Data frame with columns ``run`` (for several runs), ``t`` and one for each channel
            and input.
        declared: System, or simulator of it.
        meta: Description of the frame, with the keys of `NAME.toml`.
        units: Units of columns by name; missing ones are taken from `meta` and
            ``frame.attrs["units"]``.
        name: Name of the frame in messages.

    Raises:
        InputError: The frame is malformed; the message is one line.
    """
    path = Path(name)
    indexed_frame = _move_index_to_columns(path, frame)
    document = _build_frame_description(path, indexed_frame, declared, meta, units)
    description = check_description(path, document, declared)
    parts = _read_frame(path, indexed_frame, description)
    return assemble_recording(path, parts, description, path, get_model_reference(path, document))


def _move_index_to_columns(path: Path, frame: Frame) -> Any:
    """Return the frame with ``run`` and ``t`` as columns if they are levels of its index.

    Args:
        path: Name of the frame, for messages.
        frame: Data frame of the user, which is not changed.

    Raises:
        InputError: The name of a column is not a text, or is not unique.
    """
    indexed_frame: Any = frame
    levels = [name for name in indexed_frame.index.names if name in ("run", "t")]
    levels = [name for name in levels if name not in indexed_frame.columns]
    if levels:
        indexed_frame = indexed_frame.reset_index(level=levels)
    names = list(indexed_frame.columns)
    for index, name in enumerate(names):
        if not isinstance(name, str):
            raise InputError(f"{path}: column {format_value(name)}: expected a name, found no text")
        if name in names[:index]:
            raise InputError(f"{path}: column {format_value(name)} is given twice")
    return indexed_frame


def _build_frame_description(
    path: Path,
    frame: Frame,
    declared: DeclaredSignals,
    meta: Mapping[str, Any],
    units: Mapping[str, str],
) -> dict[str, Any]:
    """Build the description of a frame's columns, as it would be written in `NAME.toml`.

    So data frames and files are checked by the same rules. Three steps:

    1. Read what the user states in `meta`.
    2. Assign each column that is not mentioned there by its name: a channel, an input, an initial
       pose of a floating body, or a column that switches drives.
    3. Add the unit of each column, from `units`, from `meta`, or from ``frame.attrs["units"]``.

    Args:
        path: Name of the frame, for messages.
        frame: Data frame with columns as returned by `_move_index_to_columns`.
        declared: System, or simulator of it.
        meta: Statements of the user, with the keys of `NAME.toml`.
        units: Units of columns, by name.

    Returns:
        The complete description.

    Raises:
        InputError: A column belongs to no signal, or a unit is missing.
    """
    description: dict[str, Any] = to_toml_value(meta)
    pose_units = get_floating_state_units(declared)
    si_units = {**pose_units, **{s.name: s.unit for s in (*declared.channels, *declared.inputs)}}
    columns = [name for name in frame.columns if name != "run"]
    for name in units:
        # The same dict of units may be used for frames with different columns.
        if name not in columns and name not in si_units:
            raise make_unknown_name_error(f"column in units of {path}", name, columns)
    channels = join_nested_names(get_subtable(path, description, "channels"), si_units)
    inputs = join_nested_names(get_subtable(path, description, "inputs"), si_units)
    extra = join_nested_names(get_subtable(path, description, "extra"), pose_units)
    time = get_subtable(path, description, "time")
    tables = {"channels": channels, "inputs": inputs, "extra": extra, "time": time}

    switches = [switch.column for switch in read_switches(path, description)]
    time_column = _list_signal_columns("t", time)[0]
    used_columns = {time_column, *extra}
    for name, table in (*channels.items(), *inputs.items(), *extra.items()):
        used_columns.update(_list_signal_columns(name, table))
    for name in columns:
        if name in used_columns:
            continue
        if name in _list_names(declared.channels):
            channels[name] = {}
        elif name in _list_names(declared.inputs):
            inputs[name] = {}
        elif name in pose_units:
            extra[name] = {}
        elif name in switches:
            extra[name] = {"unit": "1"}
        else:
            raise _make_unassigned_column_error(path, name, declared)

    # Attributes of a frame may hold anything; only a mapping of units is used.
    noted_units = frame.attrs.get("units", {})
    noted_units = noted_units if isinstance(noted_units, Mapping) else {}
    _state_unit(time, time_column, units, noted_units)
    # SI unit by column for which no unit is stated, as a suggestion.
    missing = {}
    for name, table in (*channels.items(), *inputs.items(), *extra.items()):
        # Entries that are not tables are refused when the description is checked.
        # The columns of a signal have one unit, which is looked up by the first of them.
        column = _list_signal_columns(name, table)[0]
        if isinstance(table, dict) and not _state_unit(table, column, units, noted_units):
            missing[column] = si_units.get(name, "1")
    if missing:
        raise InputError(
            f"{path}: expected the unit of each column, found none of "
            f"{', '.join(map(str, missing))}; pass units={missing}, if these are the units"
        )
    return {**description, **{key: entries for key, entries in tables.items() if entries}}


def _list_signal_columns(name: str, table: Any) -> list[str]:
    """Return the names of the columns of a signal, at least one.

    Entries of a wrong type are left out here; they are refused when the description is checked.

    Args:
        name: name of the signal, which is the default column.
        table: entry of the signal in the description.
    """
    column = table.get("column") if isinstance(table, dict) else None
    columns = column if isinstance(column, list) else [column]
    return [column for column in columns if isinstance(column, str)] or [name]


def _state_unit(
    table: dict[str, Any], column: str, units: Mapping[str, str], noted_units: Mapping[str, Any]
) -> bool:
    """Write the unit of a column into its table, and return whether a unit is known.

    The first of these counts: `units`, the table itself, `noted_units`.

    Args:
        table: table of the column in the description; changed in place.
        column: name of the column.
        units: units that the caller states, by column.
        noted_units: units in the metadata of the data frame, by column.
    """
    if column in units:
        table["unit"] = units[column]
    elif "unit" not in table and column in noted_units:
        table["unit"] = noted_units[column]
    return "unit" in table


def _list_names(signals: Iterable[Any]) -> list[str]:
    return [signal.name for signal in signals]


def _make_unassigned_column_error(path: Path, name: str, declared: DeclaredSignals) -> InputError:
    """Make the error for a column that is neither channel nor input.

    Args:
        path: name of the data frame in messages.
        name: name of the column.
        declared: channels and inputs that the system declares.
    """
    channels, inputs = _list_names(declared.channels), _list_names(declared.inputs)
    declared_names = f"channels {', '.join(channels)}"
    declared_names += f" and inputs {', '.join(inputs)}" if inputs else " and no inputs"
    suggestion = similar(name, [*channels, *inputs])
    return InputError(
        f"{path}: column {format_value(name)}: expected a channel or input of {declared.name}, "
        f"which has {declared_names}{suggestion}; rename the column, drop it, or state what it is "
        f"with description={{'extra': {{{name!r}: {{'unit': '1'}}}}}}"
    )


def _read_frame(path: Path, frame: Frame, description: RecordingDescription) -> list[CsvRun]:
    """Read the runs of a frame in order of appearance.

    Args:
        path: Name of the frame, for messages.
        frame: Data frame with columns as returned by `_move_index_to_columns`; it is one run if it
            has no column ``run``.
        description: Checked description of the frame.

    Raises:
        InputError: The frame is malformed; the message is one line.
    """
    sources = description.sources
    if sources.folders or any(
        source.file for source in (*sources.signals.values(), *sources.extra.values())
    ):
        raise InputError(f"{path}: expected no file and no folder in the description of a frame")
    return _FrameTable(
        path, list(description.channels), list(description.inputs), list(description.extra)
    ).read_frame(frame, description)


class _FrameTable(RecordingTable):
    """Table of a recording in a data frame."""

    def format_location(self, record: int) -> str:
        """Return the location of row `record` (counted from 0) for a message."""
        return f"{self.path}.iloc[{record}]"

    def read_frame(self, frame: Frame, description: RecordingDescription) -> list[CsvRun]:
        """Return the runs of a frame, with columns by the names of the signals.

        Args:
            frame: the data frame.
            description: its checked description, which maps signals to columns.

        Raises:
            InputError: a column is missing, or has a cell of a wrong type; or a run is malformed.
        """
        sources = description.sources
        source_by_name = {
            "t": SignalSource("", (sources.time,)),
            **sources.signals,
            **sources.extra,
        }
        columns = {}
        for name, source in source_by_name.items():
            for column in source.columns:
                if column not in frame.columns:
                    raise self.make_missing_column_error(column, list(map(str, frame.columns)))
            columns[name] = source.combine(partial(self._get_values, name, frame))
        if sources.second != 1.0:
            columns["t"] = sources.second * columns["t"]
        return self.split_into_runs(self._run_names(frame, len(columns["t"])), columns)

    def _run_names(self, frame: Any, count: int) -> list[str]:
        """Return the name of the run of each row; "1" if the frame has no column ``run``.

        Args:
            frame: the data frame.
            count: number of its rows.
        """
        if "run" not in frame.columns:
            return ["1"] * count
        cells = frame["run"]
        missing = cells.isna().to_numpy()
        if missing.any():
            self.raise_error(
                int(np.argmax(missing)), "run", "expected the name of a run, found none"
            )
        # A column of integers that once had missing cells has the type float.
        is_float = cells.dtype.kind == "f"
        return [f"{cell:.15g}" if is_float else str(cell).strip() for cell in cells]

    def _get_values(self, name: str, frame: Any, column: str) -> Array:
        """Return a column as numbers (T,); NaN where a cell is missing.

        Shapes: T rows.

        Absolute time stamps become seconds from the first one, and time differences seconds.

        Args:
            name: name of the signal; ``t`` for the times.
            frame: the data frame.
            column: name of the column.

        Raises:
            InputError: a cell is not a finite number, or is missing in an input or the times.
        """
        cells = frame[column]
        if name == "t" and cells.dtype.kind == "M":  # datetime
            cells = cells - cells.min()
        if name == "t" and cells.dtype.kind == "m":  # timedelta
            cells = cells.dt.total_seconds()
        missing = cells.isna().to_numpy()
        if cells.dtype.kind not in "iuf":  # neither integers nor floating-point numbers
            for record, cell in enumerate(cells):
                if not missing[record] and not is_plausible_number(cell):
                    self.raise_error(
                        record, column, f"expected a number, found {format_value(cell)}"
                    )
        values: Array = cells.to_numpy(dtype=float, na_value=np.nan)
        is_bad = np.isinf(values) if name in self.gaps else ~np.isfinite(values)
        if is_bad.any():
            record = int(np.argmax(is_bad))
            note = "; an input has no missing samples" if name in self.inputs else ""
            found_text = "none" if missing[record] else f"{values[record]}"
            self.raise_error(record, column, f"expected a finite number, found {found_text}{note}")
        return values
