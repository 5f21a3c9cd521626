"""Columns of a recording that say when the drives of a robot are on.

``[actuators.NAME] enable = "COLUMN"`` names a column that is zero while the drive is off;
``disable`` names one that is not zero then, such as an emergency stop. An actuator that is off
exerts no force in simulations of the run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import InputError, make_unknown_name_error
from sims.core.toml_validation import check_text, get_subtable, toml_key

Mask = NDArray[np.bool_]
Run: TypeAlias = Any
"""Alias for `sims.recording.recording.Run`, whose module imports this one."""

SWITCH_KEYS = ("enable", "disable")
"""Keys of ``[actuators.NAME]`` that name a switch column."""
MAX_LISTED_RUNS = 6
"""Maximum number of runs named in a message."""


class DriveSwitch(NamedTuple):
    """Column that says when a drive is on.

    Attributes:
        actuator: Name of the actuator in the model.
        column: Name of the column, which is neither a channel nor an input.
        zero_is_off: True if the drive is off where the column is zero, False if it is off where the
            column is not zero.
    """

    actuator: str
    column: str
    zero_is_off: bool

    def off(self, run: Run) -> Mask:
        """Return whether the drive is off at each sample (T,).

        Shapes: T samples.

        A missing cell has the value of the previous one, and before the first value, that value. A
        column without any value never switches the drive off.
        """
        values = run.extra[self.column]
        is_recorded = np.isfinite(values)
        if not is_recorded.any():
            return np.zeros(values.size, dtype=np.bool_)
        # Index of the last recorded sample up to each sample; the first one before that.
        indices = np.where(is_recorded, np.arange(values.size), int(np.argmax(is_recorded)))
        filled = values[np.maximum.accumulate(indices)]
        off: Mask = (filled == 0) == self.zero_is_off
        return off

    @property
    def line(self) -> str:
        """Line of the description that states this switch."""
        key = "enable" if self.zero_is_off else "disable"
        return f'[actuators.{toml_key(self.actuator)}] {key} = "{self.column}"'

    @property
    def condition(self) -> str:
        """Condition under which the drive is off, in words."""
        return f"{self.column} is {'0' if self.zero_is_off else 'not 0'}"


def read_switches(path: Path, meta: Mapping[str, Any]) -> tuple[DriveSwitch, ...]:
    """Read the switch columns from a description.

    While a drive is off, for example after an emergency stop, its actuator exerts no force. The
    keys ``enable`` and ``disable`` of an actuator name the column that says when.

    Args:
        path: Path of the description, for messages.
        meta: Content of the description.

    Returns:
        The switch column of each actuator that has one.

    Raises:
        InputError: A column name is not a text, or a drive has both keys.
    """
    switches = []
    for name, table in get_subtable(path, meta, "actuators").items():
        keys = [key for key in SWITCH_KEYS if isinstance(table, dict) and key in table]
        if len(keys) > 1:
            raise InputError(f"{path}: actuators.{name}: expected enable or disable, found both")
        for key in keys:
            column = check_text(path, f"actuators.{name}.{key}", table[key], "the name of a column")
            switches.append(DriveSwitch(name, column, key == "enable"))
    return tuple(switches)


def remove_switch_keys(actuators: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of the actuators to be added to the model file, without switch keys.

    A switch key names the column that says when the drive is on; it does not describe an actuator.
    A table with nothing else belongs to an actuator of the model file and is left out.

    Args:
        actuators: Tables ``[actuators.NAME]`` of a description. Entries of a wrong type are kept,
            so that they are refused later.
    """
    kept_tables = {}
    for name, table in actuators.items():
        if not isinstance(table, dict):
            kept_tables[name] = table
            continue
        other_entries = {key: value for key, value in table.items() if key not in SWITCH_KEYS}
        if other_entries or not table:
            kept_tables[name] = other_entries
    return kept_tables


def check_switches(
    path: Path,
    switches: Sequence[DriveSwitch],
    actuators: Sequence[str],
    used_columns: Sequence[str],
) -> None:
    """Check the switch columns of a description.

    Args:
        path: Path of the description, for messages.
        switches: Switch columns from `read_switches`.
        actuators: Names of the actuators of the model.
        used_columns: Names of columns with another meaning.

    Raises:
        InputError: There is no such actuator, or the column is a channel or an input.
    """
    for switch in switches:
        location = f"{path}: actuators.{switch.actuator}"
        if switch.actuator not in actuators:
            names = list(actuators) or ["none"]
            raise InputError(
                f"{location}: {make_unknown_name_error('actuator', switch.actuator, names)}"
            )
        if switch.column in used_columns:
            raise InputError(
                f"{location}: expected a column that says when the drive is on, found "
                f"{switch.column}, which is a channel or input; name a separate column"
            )


class Switched(NamedTuple):
    """Runs with masks of the drives that are off, and notes about them."""

    runs: tuple[Run, ...]
    notes: tuple[str, ...]


def apply_drive_switches(
    path: Path, runs: Sequence[Run], switches: Sequence[DriveSwitch]
) -> Switched:
    """Add to each run the masks of samples at which its drives are off, with notes for the user.

    A drive that is off exerts no force, whatever its command is. Drives that are off in the same
    samples share a note.

    Args:
        path: Path of the table, for messages.
        runs: Runs as read from the table.
        switches: Columns that say when drives are on.

    Raises:
        InputError: A drive is never on.
    """
    # Names of the actuators by the condition and the time spans in which they are off.
    actuators_by_condition: dict[str, list[str]] = {}
    masks_by_run: list[dict[str, Mask]] = [{} for _ in runs]
    for switch in switches:
        off_masks = [switch.off(run) for run in runs]
        if all(mask.all() for mask in off_masks):
            raise InputError(
                f"{path}: {switch.condition} in all samples: actuator {switch.actuator} is never "
                f"on; expected samples in which it is, or another column in {switch.line}"
            )
        for masks, mask in zip(masks_by_run, off_masks, strict=True):
            if mask.any():
                masks[switch.actuator] = mask
        if any(mask.any() for mask in off_masks):
            condition = f"where {switch.condition}: {format_run_spans(runs, off_masks)}"
            actuators_by_condition.setdefault(condition, []).append(switch.actuator)
    notes = []
    for condition, names in actuators_by_condition.items():
        if len(names) == 1:
            notes.append(f"actuator {names[0]} exerts nothing {condition}")
        else:
            notes.append(f"actuators {', '.join(names)} exert nothing {condition}")
    switched_runs = tuple(
        replace(run, off=masks) if masks else run
        for run, masks in zip(runs, masks_by_run, strict=True)
    )
    return Switched(switched_runs, tuple(notes))


def format_run_spans(runs: Sequence[Run], masks: Sequence[Mask]) -> str:
    """Format the time spans of each run in which a mask is set, for a message.

    Shapes: T samples.

    Args:
        runs: Runs; at most `MAX_LISTED_RUNS` of those with a span are listed.
        masks: Mask (T,) of each run.
    """
    run_texts = []
    for run, mask in zip(runs, masks, strict=True):
        span_texts = [
            f"{run.times[first]:.4g} to {run.times[end - 1]:.4g} s" for first, end in spans(mask)
        ]
        if span_texts:
            run_texts.append(f"run {run.name}, {', '.join(span_texts)}")
    text = "; ".join(run_texts[:MAX_LISTED_RUNS])
    if len(run_texts) > MAX_LISTED_RUNS:
        text += f"; and {len(run_texts) - MAX_LISTED_RUNS} more runs"
    return text


def spans(mask: Mask) -> list[tuple[int, int]]:
    """Return the blocks in which a mask (T,) is set: first row, and the row after the last."""
    edges = np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8))
    first, end = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    return list(zip(first.tolist(), end.tolist(), strict=True))
