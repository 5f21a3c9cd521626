"""Description of a recording with corrected conventions: the keys to change, and a file."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from bench.diagnosis.conventions.convention_comparison import ConventionDifference
from bench.diagnosis.conventions.convention_hypotheses import ConventionHypothesis
from bench.diagnosis.conventions.signal_changes import SignalChange
from bench.logs.quality.servo_checks import UNKNOWN_COLUMN
from sims.core.files import write_files
from sims.core.simulator import InputError
from sims.core.toml_validation import join_nested_names, toml_key, toml_text
from sims.recording.recording_description import DeclaredSignals, read_meta
from sims.recording.unit_conversion import compute_unit_scale

KINDS = ("channels", "inputs")
"""Tables of the description that contain signals."""
CORRECTED_KEYS = ("column", "unit", "scale", "offset", "unwrap")
"""Keys of a signal that a correction changes, in the order in which they are shown."""


def correct_description(
    meta: Mapping[str, Any], declared: DeclaredSignals, differences: Sequence[ConventionDifference]
) -> dict[str, Any]:
    """Return the content of a description file with the conventions of the log corrected.

    The differences change columns, units, scales and offsets in the tables of the signals; late
    commands change the offset of the time stamps. The present content is not changed.

    Args:
        meta: Content of the present description file.
        declared: Simulator of the robot, with the units of its signals.
        differences: Differences to correct, one after another in this order.
    """
    corrected = copy.deepcopy(dict(meta))
    units = {
        "channels": {c.name: c.unit for c in declared.channels},
        "inputs": {c.name: c.unit for c in declared.inputs},
    }
    for kind in KINDS:
        corrected[kind] = join_nested_names(corrected.get(kind, {}), units[kind])
    for difference in differences:
        hypothesis = difference.hypothesis
        for kind in KINDS:
            # A change may need the unchanged table of another signal, if two are exchanged.
            before = copy.deepcopy(corrected[kind])
            for name, change in hypothesis.changes.items():
                if name in before:
                    table = _move_to_column(before, name, change)
                    corrected[kind][name] = _change_scale(
                        table, units[kind][name], change, hypothesis
                    )
        # Commands that are stamped late, in s, are moved to earlier times.
        if hypothesis.late:
            time_table = dict(corrected.get("time", {}))
            time_table["offset"] = _round_value(
                float(time_table.get("offset", 0.0)) - hypothesis.late
            )
            corrected["time"] = time_table
    return corrected


def _move_to_column(
    tables: Mapping[str, Mapping[str, Any]], name: str, change: SignalChange
) -> dict[str, Any]:
    """Return a copy of a signal's table that reads the column from which a change takes the values.

    The source of a change is one of these:

    - the signal itself: its table is returned unchanged;
    - another signal, if joints are exchanged: its table is taken over, with its column;
    - a column of the log that the description does not use: only the key ``column`` changes.

    A table without ``column`` means the column with the signal's name.

    Args:
        tables: Tables of the description by signal.
        name: Signal to change.
        change: Correction of the signal.
    """
    is_signal = change.source in tables
    table = dict(tables[change.source if is_signal else name])
    if change.source == name:
        return table
    if not is_signal:
        return {**table, "column": change.source}
    # The table of the other signal was copied: its column, by default of that signal's name, is
    # now stated, unless it is the default of the changed signal.
    table.setdefault("column", change.source)
    if table["column"] == name:
        del table["column"]
    return table


def _change_scale(
    table: dict[str, Any], si: str, change: SignalChange, hypothesis: ConventionHypothesis
) -> dict[str, Any]:
    """Return the table of a signal in the description with a corrected unit, scale or offset.

    With the gain g of the stated unit and the present scale k and offset b of the table, a recorded
    value r is g (k r + b) in SI units. The correction converts this to c (g (k r + b)) + d, with
    its factor c and its offset d in SI units. So the new scale is c k, and the new offset is
    c b + d / g. If the unit is wrong, only the key ``unit`` changes.

    Args:
        table: present table of the signal in the description; it is changed in place.
        si: SI unit of the signal.
        change: factor and offset that convert the present values to the right ones.
        hypothesis: the correction to which the change belongs, with the right unit if it has one.
    """
    unit_gain = compute_unit_scale(table["unit"], si).gain
    factor, offset = change.scale, change.offset
    if hypothesis.unit is not None:
        table["unit"] = hypothesis.unit
        return table
    old_scale, old_offset = float(table.get("scale", 1.0)), float(table.get("offset", 0.0))
    if factor != 1.0:
        table["scale"] = _round_value(factor * old_scale)
    if offset or old_offset:
        table["offset"] = _round_value(factor * old_offset + offset / unit_gain)
    # The name of the command that determines the turns of a wrapped angle or, without one, only
    # that whole turns are missing.
    if change.unwrap:
        table["unwrap"] = change.command or True
    return table


def _round_value(value: float) -> float:
    return float(f"{value:.9g}")


def list_changed_tables(
    meta: Mapping[str, Any], declared: DeclaredSignals, differences: Sequence[ConventionDifference]
) -> Iterator[str]:
    """Yield the lines that a user has to change in the description, one for each corrected signal.

    A line has the name of the table and its new keys, such as ``[channels."q.elbow"] scale = -1``.
    The last line corrects the time stamps, if commands are late.

    Args:
        meta: Content of the description.
        declared: Simulator of the robot, with the units of its signals.
        differences: Differences to correct.
    """
    corrected = correct_description(meta, declared, differences)
    # The present tables in the same form, without any correction.
    unchanged = correct_description(meta, declared, ())
    for kind in KINDS:
        names = [
            name
            for difference in differences
            for name in difference.hypothesis.changes
            if name in corrected[kind]
        ]
        for name in dict.fromkeys(names):
            table = corrected[kind][name]
            old_table = unchanged[kind][name]
            changed_keys = [
                key for key in CORRECTED_KEYS if key in table and table[key] != old_table.get(key)
            ]
            assignments = [f"{key} = {_format_value(table[key])}" for key in changed_keys]
            yield f"[{kind}.{toml_key(name)}] {', '.join(assignments)}"
    if any(difference.hypothesis.late for difference in differences):
        yield f"[time] offset = {corrected['time']['offset']:.9g}"


def _format_value(value: Any) -> str:
    """Format a value of a TOML file."""
    if isinstance(value, bool):
        return str(value).lower()
    return toml_text(value) if isinstance(value, str) else f"{value:.9g}"


def write_corrected(
    recording: Path,
    declared: DeclaredSignals,
    differences: Sequence[ConventionDifference],
    path: Path,
) -> list[Path]:
    """Write the corrected description to a new file.

    A description refers to its model and its table by relative paths and by name. So the path of
    the model is adapted; a table with the name of the description is copied next to the new one,
    with the new name.

    Args:
        recording: Table or description of the recording.
        declared: Simulator of the robot.
        differences: Differences to correct.
        path: ``NAME.toml``, a new file.

    Returns:
        The files that were written.

    Raises:
        InputError: A file exists already, the path does not end in ``.toml``, or a column is
            unknown.
    """
    import tomli_w

    if path.suffix != ".toml":
        raise InputError(f"{path}: expected NAME.toml for the corrected description")
    # Commands that are copies of measurements, and for which no other column was found.
    unknown = [
        name
        for difference in differences
        for name, change in difference.hypothesis.changes.items()
        if change.source == UNKNOWN_COLUMN
    ]
    if unknown:
        raise InputError(
            f"{recording}: no column of the log can be the command {', '.join(unknown)}; record "
            f'it, or write its column into [inputs."{unknown[0]}"] by hand'
        )
    description, meta = read_meta(recording)
    old_folder, new_folder = description.parent.resolve(), path.parent.resolve()
    content = correct_description(meta, declared, differences)
    if "model" in content:
        content["model"] = os.path.relpath((old_folder / content["model"]).resolve(), new_folder)
    contents: dict[Path, str | bytes] = {path: tomli_w.dumps(content)}
    table = description.with_suffix(".csv")
    # A table of the same name is found by this name alone, so it gets the new name.
    if table.exists():
        contents[path.with_suffix(".csv")] = table.read_bytes()
    elif new_folder != old_folder:
        # Without such a table, the description names the files of a log relative to its folder.
        raise InputError(
            f"{path}: expected a file in {description.parent}, where the log's files are"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_files(contents)
    return list(contents)
