"""Recordings in data frames: the columns of a pandas ``DataFrame`` as those of `NAME.csv`, checked
by the same rules.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from numbers import Real
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from sims.base import Array, InputError, similar, unknown
from sims.recording.description import Declared, Description, afloat, dotted
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
    signals = {kind: _signals(path, result, kind, declared) for kind in ("channels", "inputs")}
    poses = afloat(declared)
    extra = dotted(table(path, "extra", result.get("extra", {})), poses)
    time = table(path, "time", result.get("time", {}))
    noted = frame.attrs.get("units", {})
    noted = noted if isinstance(noted, Mapping) else {}
    columns = [name for name in frame.columns if name != "run"]
    usual = {**poses, **{s.name: s.unit for s in (*declared.channels, *declared.inputs)}}
    for name in units:
        # One dict of units may serve frames with different columns.
        if name not in columns and name not in usual:
            raise unknown(f"column in units of {path}", name, columns)
    stated = {**noted, **units}

    stamps = time.get("column", "t")
    if stamps in stated and ("unit" not in time or stamps in units):
        time["unit"] = stated[stamps]
    taken = {stamps}
    for own in signals.values():
        for name, entry in own.items():
            if isinstance(entry, dict):
                taken.add(entry.get("column", name))
    for name in columns:
        if name in taken or name in extra:
            continue
        if name in _names(declared.channels):
            signals["channels"][name] = {}
        elif name in _names(declared.inputs):
            signals["inputs"][name] = {}
        elif name in poses:
            extra[name] = {}
        else:
            raise _belongs_to_nothing(path, name, declared)
    missing = {}
    for entries in (*signals.values(), extra):
        for name, entry in entries.items():
            if isinstance(entry, dict):
                column = entry.get("column", name)
                if column in units or (column in noted and "unit" not in entry):
                    entry["unit"] = stated[column]
                if "unit" not in entry:
                    missing[column] = usual.get(name, "1")
    if missing:
        raise InputError(
            f"{path}: expected the unit of each column, found none of {', '.join(missing)}; pass "
            f"units={missing}, if these are the units"
        )
    tables = {**signals, "extra": extra, "time": time}
    return {**result, **{key: entries for key, entries in tables.items() if entries}}


def _plain(value: Any) -> Any:
    """A copy with dicts, lists and numbers of Python's own, as TOML gives them."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return value.item() if isinstance(value, np.generic) else value


def _signals(path: Path, meta: Mapping[str, Any], kind: str, declared: Declared) -> dict[str, Any]:
    """The tables of the channels or inputs that a description states."""
    return dotted(table(path, kind, meta.get(kind, {})), _names(getattr(declared, kind)))


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
                number = isinstance(cell, Real) and not isinstance(cell, bool)
                if not number and not missing[record]:
                    self.fault(record, column, f"expected a number, found {shown(cell)}")
        values: Array = cells.to_numpy(dtype=float, na_value=np.nan)
        bad = np.isinf(values) if name in self.gaps else ~np.isfinite(values)
        if bad.any():
            record = int(np.argmax(bad))
            more = "; an input has no missing samples" if name in self.inputs else ""
            found = "none" if missing[record] else f"{values[record]}"
            self.fault(record, column, f"expected a finite number, found {found}{more}")
        return values
