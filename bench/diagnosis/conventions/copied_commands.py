"""Find commands that are copies of the measurement.

Some loggers write the measured position into the column of the command. A servo with such a command
exerts no force, so the log contains no input, and any cause would only imitate it. Equality in
every digit over a whole motion cannot be an accident: encoders have noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sims.core.simulator import Array, InputError, Simulator
from sims.recording.column_mapping import list_mapped_files
from sims.recording.log_formats.log_files import LogFile, read_log
from sims.recording.recording import Recording
from sims.recording.recording_description import read_meta

UNKNOWN_COLUMN = "NAME OF ITS COLUMN"
"""Stands for the column of a command where no column of the log can be it."""
MIN_SAMPLES = 20
"""Minimum number of samples, and of different values, that are compared."""
MIN_CORRELATION = 0.9
"""Minimum correlation of a position with the column that may be its command."""
MEASURED_QUANTITIES = {"position": "q", "velocity": "qd"}
"""Channel that a servo controls, by the kind of its actuator."""


def find_copied_commands(
    recording: Recording, kind: type[Simulator]
) -> Iterator[tuple[str, str, str]]:
    """Find commands of servos that equal the measurement of their joint in all samples.

    Args:
        recording: Recording of a robot.
        kind: Simulator class of the robot.

    Returns:
        Name of the input, name of the channel that it equals, and the column that may be the
        command instead, `UNKNOWN_COLUMN` if there is none.
    """
    robot: Any = kind.robot  # type: ignore[attr-defined]
    for actuator in robot.actuators:
        quantity = MEASURED_QUANTITIES.get(actuator.kind)
        command, channel = f"u.{actuator.name}", f"{quantity}.{actuator.joint}"
        runs = [run for run in recording.runs if command in run.inputs and channel in run.channels]
        if not runs:
            continue
        command_values = np.concatenate([run.inputs[command] for run in runs])
        measured_values = np.concatenate([run.channels[channel] for run in runs])
        is_recorded = np.isfinite(measured_values)
        command_values, measured_values = command_values[is_recorded], measured_values[is_recorded]
        if len(np.unique(measured_values)) >= MIN_SAMPLES and np.array_equal(
            command_values, measured_values
        ):
            yield command, channel, _find_likely_column(recording, channel)


def _find_likely_column(recording: Recording, channel: str) -> str:
    """Find the column of the log that is the likely command of a recorded position.

    It is the column with the highest correlation that the description does not use. Return
    `UNKNOWN_COLUMN` if none correlates enough.
    """
    try:
        description, meta = read_meta(recording.path)
    except InputError:  # A recording in memory has no description.
        return UNKNOWN_COLUMN
    tables = [table for kind in ("channels", "inputs") for table in meta.get(kind, {}).values()]
    used_columns = [
        column for table in tables if isinstance(table, dict) for column in _list_columns(table)
    ]
    channel_table = meta.get("channels", {}).get(channel, {})
    position_column = (_list_columns(channel_table) or [channel])[0]
    best, best_correlation = UNKNOWN_COLUMN, MIN_CORRELATION
    for log in _iterate_logs(description):
        if position_column not in log.list_columns():
            continue
        position = log.get_column(position_column)
        for column in log.list_columns():
            if column in (*used_columns, position_column):
                continue
            correlation = _compute_correlation(log.get_column(column), position)
            if correlation > best_correlation:
                best, best_correlation = column, correlation
        break
    return best


def _list_columns(table: dict[str, Any]) -> list[str]:
    """Return the columns that the table of a signal names."""
    column = table.get("column", [])
    return [column] if isinstance(column, str) else list(column)


def _iterate_logs(description: Path) -> Iterator[LogFile]:
    """Yield the logs of a description that can be read."""
    for path in list_mapped_files(description):
        try:
            yield read_log(path)
        except InputError:  # Such as the model file.
            continue


def _compute_correlation(u: Array, y: Array) -> float:
    """Return the correlation of two columns; 0 if they are equal, or one does not change."""
    if u.shape != y.shape or np.array_equal(u, y, equal_nan=True):
        return 0.0
    is_recorded = np.isfinite(u) & np.isfinite(y)
    u, y = u[is_recorded], y[is_recorded]
    if u.size < MIN_SAMPLES or np.ptp(u) == 0 or np.ptp(y) == 0:
        return 0.0
    return float(np.corrcoef(u, y)[0, 1])
