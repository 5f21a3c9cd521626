"""Columns of a recording that say when a robot's drives are on.

``[actuators.NAME] enable = "COLUMN"`` names a column that is zero while the drive is off, and
``disable`` one that is not zero then, as that of an emergency stop. An actuator that is off exerts
nothing in simulations of the run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sims.base import Array, InputError, unknown
from sims.user_toml import table, text, toml_key

Mask = NDArray[np.bool_]
Run: TypeAlias = Any
"""A `sims.recording.recording.Run`, whose module imports this one."""

KEYS = ("enable", "disable")
"""Keys of ``[actuators.NAME]`` that name such a column."""
FEWEST = 10
"""Smallest number of samples of a part of a run: fewer say nothing beside an initial state."""
MOST_RUNS = 6
"""Maximum number of runs that a message names."""


class DriveSwitch(NamedTuple):
    """A column that says when a drive is on.

    Attributes:
        actuator: of the model.
        column: of the table, one that is neither a channel nor an input.
        zero_is_off: whether the drive is off where the column is zero, or where it is not.
    """

    actuator: str
    column: str
    zero_is_off: bool

    def off(self, run: Run) -> Mask:
        """(T,) whether the drive is off at each sample; a missing cell is as the one before it."""
        values = run.extra[self.column]
        there = np.isfinite(values)
        last = np.maximum.accumulate(np.where(there, np.arange(values.size), -1))
        # Before the first cell the drive is taken to be as that says.
        first = int(np.argmax(there)) if there.any() else 0
        filled = values[np.where(last < 0, first, last)]
        off: Mask = (filled == 0) == self.zero_is_off
        return off & bool(there.any())

    @property
    def line(self) -> str:
        """The table of the description that states it."""
        key = "enable" if self.zero_is_off else "disable"
        return f'[actuators.{toml_key(self.actuator)}] {key} = "{self.column}"'

    @property
    def condition(self) -> str:
        """When the drive is off, in words."""
        return f"{self.column} is {'0' if self.zero_is_off else 'not 0'}"


def read_switches(path: Path, meta: Mapping[str, Any]) -> tuple[DriveSwitch, ...]:
    """Return the columns that a description names.

    Args:
        path: of the description, which messages begin with.
        meta: its content.

    Raises:
        InputError: a name is not a text, or a drive has both keys.
    """
    found = []
    for name, own in table(path, "actuators", meta.get("actuators", {})).items():
        keys = [key for key in KEYS if isinstance(own, dict) and key in own]
        if len(keys) > 1:
            raise InputError(f"{path}: actuators.{name}: expected enable or disable, found both")
        for key in keys:
            column = text(path, f"actuators.{name}.{key}", own[key], "the name of a column")
            found.append(DriveSwitch(name, column, key == "enable"))
    return tuple(found)


def without_switches(actuators: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of actuators that a model file lacks, without the keys of this module."""
    result = {}
    for name, own in actuators.items():
        if not isinstance(own, dict):
            result[name] = own
            continue
        rest = {key: value for key, value in own.items() if key not in KEYS}
        # A table that names a column alone is of an actuator that the file has.
        if rest or not own:
            result[name] = rest
    return result


def check_switches(
    path: Path,
    switches: Sequence[DriveSwitch],
    actuators: Sequence[str],
    taken: Sequence[str],
    are_logs: bool,
) -> None:
    """Check the columns that a description names.

    Args:
        path: of the description.
        switches: of `read_switches`.
        actuators: of the model.
        taken: names of columns with another meaning.
        are_logs: whether the columns stand in logs, and not in the table beside.

    Raises:
        InputError: there is no such actuator, or the column cannot be read.
    """
    for switch in switches:
        where = f"{path}: actuators.{switch.actuator}"
        if switch.actuator not in actuators:
            raise InputError(
                f"{where}: {unknown('actuator', switch.actuator, list(actuators) or ['none'])}"
            )
        if switch.column in taken:
            raise InputError(
                f"{where}: expected a column that says when the drive is on, found {switch.column},"
                " which is a channel or input; name a column of its own"
            )
        if are_logs:
            raise InputError(
                f"{where}: column {switch.column}: expected it in the table beside the description,"
                " found logs; write the table with simgap import first"
            )


class Switched(NamedTuple):
    """Runs with what is known of drives that are off, and what is to be said of it."""

    runs: tuple[Run, ...]
    notes: tuple[str, ...]


def switched_runs(path: Path, runs: Sequence[Run], switches: Sequence[DriveSwitch]) -> Switched:
    """State in which samples of runs drives are off.

    Args:
        path: of the table.
        runs: as they were read.
        switches: columns that say when drives are on.

    Raises:
        InputError: a drive is never on.
    """
    notes: dict[str, list[str]] = {}
    by_run: list[dict[str, Mask]] = [{} for _ in runs]
    for switch in switches:
        off = [switch.off(run) for run in runs]
        if all(mask.all() for mask in off):
            raise InputError(
                f"{path}: {switch.condition} in all samples: actuator {switch.actuator} is never "
                f"on; expected samples in which it is, or another column in {switch.line}"
            )
        for masks, mask in zip(by_run, off, strict=True):
            if mask.any():
                masks[switch.actuator] = mask
        if any(mask.any() for mask in off):
            note = f"where {switch.condition}: {spans_of_runs(runs, off)}"
            notes.setdefault(note, []).append(switch.actuator)
    said = [f"{_subject(names)} nothing {note}" for note, names in notes.items()]
    switched = tuple(
        replace(run, off=masks) if masks else run for run, masks in zip(runs, by_run, strict=True)
    )
    return Switched(switched, tuple(said))


def spans_of_runs(runs: Sequence[Run], off: Sequence[Mask]) -> str:
    """Describe in which spans of time of which runs a mask (T,) of each is set."""
    told = [
        f"run {run.name}, {_spans(run.times, mask)}"
        for run, mask in zip(runs, off, strict=True)
        if mask.any()
    ]
    more = f"; and {len(told) - MOST_RUNS} more runs" if len(told) > MOST_RUNS else ""
    return f"{'; '.join(told[:MOST_RUNS])}{more}"


def _subject(names: Sequence[str]) -> str:
    """Subject and verb of a sentence about actuators."""
    if len(names) == 1:
        return f"actuator {names[0]} exerts"
    return f"actuators {', '.join(names)} exert"


def _spans(times: Array, off: Mask) -> str:
    """Spans of time in which a mask is set."""
    return ", ".join(f"{times[first]:.4g} to {times[end - 1]:.4g} s" for first, end in spans(off))


def spans(mask: Mask) -> list[tuple[int, int]]:
    """Return the first rows of stretches in which a mask (T,) is set, and the rows after them."""
    edges = np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8))
    first, end = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    return list(zip(first.tolist(), end.tolist(), strict=True))


def parts_without(run: Run, off: Mask) -> list[Run]:
    """Return the parts of a run in which a mask (T,) is not set, the run itself if it is not set
    anywhere.
    """
    if not off.any():
        return [run]
    parts = []
    for first, end in spans(~off):
        if end - first < FEWEST:
            continue
        name = f"{run.name} from {run.times[first]:.4g} s" if first else run.name
        part = run.part(slice(first, end), name)
        if any(np.isfinite(values).any() for values in part.channels.values()):
            parts.append(part)
    return parts
