"""Recordings in data frames: the columns of a pandas ``DataFrame`` as those of `NAME.csv`, checked
by the same rules.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from sims.base import Array, InputError, similar, unknown
from sims.limits import is_number
from sims.recording.description import Declared, Description, afloat, dotted
from sims.recording.drive_switches import read_switches
from sims.recording.table import Table, TableRun
from sims.user_toml import shown, table


@runtime_checkable
class Frame(Protocol):
    """What is used of a pandas ``DataFrame``; pandas itself is not imported for it."""

    @property
    def attrs(self) -> Any:
        """Anything that the user noted about it."""

    @property
    def columns(self) -> Any:
        """Names of its columns."""

    @property
    def index(self) -> Any:
        """Labels of its rows."""

    @property
    def iloc(self) -> Any:
        """Rows by number."""


def with_index(path: Path, frame: Frame) -> Any:
    """The frame with ``run`` and ``t`` as columns, where they are levels of its index.

    Raises:
        InputError: a column has no name of its own; messages begin with `path`.
    """
    whole: Any = frame
    levels = [name for name in whole.index.names if name in ("run", "t")]
    levels = [name for name in levels if name not in whole.columns]
    if levels:
        whole = whole.reset_index(level=levels)
    names = list(whole.columns)
    for place, name in enumerate(names):
        if not isinstance(name, str):
            raise InputError(f"{path}: column {shown(name)}: expected a name, found no text")
        if name in names[:place]:
            raise InputError(f"{path}: column {shown(name)} stands twice")
    return whole


def described(
    path: Path, frame: Frame, declared: Declared, meta: Mapping[str, Any], units: Mapping[str, str]
) -> dict[str, Any]:
    """The description of a frame's columns, as it would stand in `NAME.toml`.

    A column is the channel or input of its name unless `meta` says otherwise. Its unit is that of
    `units`, of `meta`, or of ``frame.attrs["units"]``.

    Args:
        path: what messages begin with.
        frame: with columns as `with_index` gives them.
        declared: the system, or a simulator of it.
        meta: what the user states of it, with the keys of `NAME.toml`.
        units: of columns, by name.

    Raises:
        InputError: a column belongs to nothing, or a unit is missing.
    """
    result: dict[str, Any] = _plain(meta)
    poses = afloat(declared)
    usual = {**poses, **{s.name: s.unit for s in (*declared.channels, *declared.inputs)}}
    columns = [name for name in frame.columns if name != "run"]
    for name in units:
        # One dict of units may serve frames with different columns.
        if name not in columns and name not in usual:
            raise unknown(f"column in units of {path}", name, columns)
    channels = dotted(table(path, "channels", result.get("channels", {})), usual)
    inputs = dotted(table(path, "inputs", result.get("inputs", {})), usual)
    extra = dotted(table(path, "extra", result.get("extra", {})), poses)
    time = table(path, "time", result.get("time", {}))
    tables = {"channels": channels, "inputs": inputs, "extra": extra, "time": time}

    switches = [switch.column for switch in read_switches(path, result)]
    stamps = _column("t", time)
    taken = {stamps, *extra}
    taken.update(_column(name, own) for name, own in (*channels.items(), *inputs.items()))
    for name in (name for name in columns if name not in taken):
        if name in _names(declared.channels):
            channels[name] = {}
        elif name in _names(declared.inputs):
            inputs[name] = {}
        elif name in poses:
            extra[name] = {}
        elif name in switches:
            extra[name] = {"unit": "1"}
        else:
            raise _belongs_to_nothing(path, name, declared)

    noted = frame.attrs.get("units", {})
    noted = noted if isinstance(noted, Mapping) else {}
    _state_unit(time, stamps, units, noted)
    missing = {}
    for name, own in (*channels.items(), *inputs.items(), *extra.items()):
        # Whatever is no table is refused where the description is checked.
        if isinstance(own, dict) and not _state_unit(own, _column(name, own), units, noted):
            missing[_column(name, own)] = usual.get(name, "1")
    if missing:
        raise InputError(
            f"{path}: expected the unit of each column, found none of "
            f"{', '.join(map(str, missing))}; pass units={missing}, if these are the units"
        )
    return {**result, **{key: entries for key, entries in tables.items() if entries}}


def _column(name: str, own: Any) -> str:
    """The column that a signal stands in; what is no table or text is refused elsewhere."""
    column = own.get("column") if isinstance(own, dict) else None
    return column if isinstance(column, str) else name


def _state_unit(
    own: dict[str, Any], column: str, units: Mapping[str, str], noted: Mapping[str, Any]
) -> bool:
    """State the unit of a column in its table; returns whether there is one."""
    if column in units:
        own["unit"] = units[column]
    elif "unit" not in own and column in noted:
        own["unit"] = noted[column]
    return "unit" in own


def _plain(value: Any) -> Any:
    """A copy with dicts, lists and numbers of Python's own, as TOML gives them."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return value.item() if isinstance(value, np.generic) else value


def _names(signals: Iterable[Any]) -> list[str]:
    return [signal.name for signal in signals]


def _belongs_to_nothing(path: Path, name: str, declared: Declared) -> InputError:
    """The error for a column that is neither channel nor input."""
    channels, inputs = _names(declared.channels), _names(declared.inputs)
    there = f"channels {', '.join(channels)}"
    there += f" and inputs {', '.join(inputs)}" if inputs else " and no inputs"
    near = similar(name, [*channels, *inputs])
    return InputError(
        f"{path}: column {shown(name)}: expected a channel or input of {declared.name}, which has "
        f"{there}{near}; rename the column, drop it, or state what it is with "
        f"description={{'extra': {{{name!r}: {{'unit': '1'}}}}}}"
    )


def read_frame(path: Path, frame: Frame, about: Description) -> list[TableRun]:
    """The runs of a frame in order of appearance.

    Args:
        path: what messages begin with.
        frame: with columns as `with_index` gives them; without ``run`` it is one run.
        about: its description, checked.

    Raises:
        InputError: anything malformed, in one line.
    """
    sources = about.sources
    if sources.folders or any(source.file for source in sources.signals.values()):
        raise InputError(f"{path}: expected no file and no folder in the description of a frame")
    return _FrameTable(path, list(about.channels), list(about.inputs), list(about.extra)).of(
        frame, about
    )


class _FrameTable(Table):
    """The table in a frame."""

    def row(self, record: int) -> str:
        """Where row `record` (from 0) stands, as a message says it."""
        return f"{self.path}.iloc[{record}]"

    def of(self, frame: Frame, about: Description) -> list[TableRun]:
        """The runs of a frame."""
        sources = about.sources
        signals = {name: source.column for name, source in sources.signals.items()}
        places = {"t": sources.time, **signals, **{name: name for name in about.extra}}
        for name in places.values():
            if name not in frame.columns:
                raise InputError(
                    f"{self.path}: expected column '{name}', found columns "
                    f"{', '.join(map(str, frame.columns))}"
                )
        columns = {name: self._values(name, frame, column) for name, column in places.items()}
        if sources.second != 1.0:
            columns["t"] = sources.second * columns["t"]
        return self.runs(self._run_names(frame, len(columns["t"])), columns)

    def _run_names(self, frame: Any, count: int) -> list[str]:
        """The name of the run of each row."""
        if "run" not in frame.columns:
            return ["1"] * count
        cells = frame["run"]
        missing = cells.isna().to_numpy()
        if missing.any():
            self.fault(int(np.argmax(missing)), "run", "expected the name of a run, found none")
        # A column of whole numbers that had gaps once is one of floats.
        whole = cells.dtype.kind == "f"
        return [f"{cell:g}" if whole else str(cell).strip() for cell in cells]

    def _values(self, name: str, frame: Any, column: str) -> Array:
        """A column as numbers; NaN where a cell is missing."""
        cells = frame[column]
        if name == "t" and cells.dtype.kind == "M":  # stamps of a clock
            cells = cells - cells.min()
        if name == "t" and cells.dtype.kind == "m":
            cells = cells.dt.total_seconds()
        missing = cells.isna().to_numpy()
        if cells.dtype.kind not in "iuf":
            for record, cell in enumerate(cells):
                if not missing[record] and not is_number(cell):
                    self.fault(record, column, f"expected a number, found {shown(cell)}")
        values: Array = cells.to_numpy(dtype=float, na_value=np.nan)
        bad = np.isinf(values) if name in self.gaps else ~np.isfinite(values)
        if bad.any():
            record = int(np.argmax(bad))
            more = "; an input has no missing samples" if name in self.inputs else ""
            found = "none" if missing[record] else f"{values[record]}"
            self.fault(record, column, f"expected a finite number, found {found}{more}")
        return values
