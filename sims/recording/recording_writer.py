"""Write recordings, `NAME.csv` and `NAME.toml`.

Either all files are written or none, and existing files are never overwritten.
"""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from sims.core.files import Content, write_files
from sims.core.simulator import Array, InputError, make_unknown_name_error
from sims.recording.recording import DeclaredSignals, Recording, Run
from sims.recording.recording_description import get_description_path

_LOSSLESS_DIGITS = 17
"""Number of significant digits with which a number is written without loss."""


def write_recording(
    path: str | Path,
    recording: Recording,
    declared: DeclaredSignals,
    *,
    digits: int = _LOSSLESS_DIGITS,
    extra_files: Mapping[Path, Content] | None = None,
) -> None:
    """Write a recording such that `read_recording` gives it back unchanged, in SI units.

    Args:
        path: Table to write; `recording.path` is not used.
        recording: Recording to write; its runs have different names and the same columns.
        declared: System, for the units.
        digits: Significant digits of a number; with 17, nothing is lost.
        extra_files: Other files to write together with it, all or none.

    Raises:
        InputError: A file exists already or cannot be written, or the runs do not fit into one
            table.
    """
    table = Path(path)
    if table.suffix != ".csv":
        raise InputError(f"{table}: expected a name that ends in .csv")
    if not recording.runs:
        raise InputError(f"{table}: expected at least one run, found none")
    texts: dict[Path, Content] = {
        table: format_table(recording.runs, digits),
        get_description_path(table): format_description(recording, declared, table.parent),
    }
    write_files({**texts, **(extra_files or {})})


def format_table(runs: Sequence[Run], digits: int) -> str:
    """Return the text of the CSV table with all runs.

    The columns are the run, the time, inputs, channels and extra signals.

    Args:
        runs: Runs with the same signals; those of the first determine the columns.
        digits: Number of significant digits.

    Raises:
        InputError: Two runs have the same name, or different signals.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    # Names of the signals by the attribute of a run that holds them.
    names = {kind: list(getattr(runs[0], kind)) for kind in ("inputs", "channels", "extra")}
    writer.writerow(["run", "t", *chain.from_iterable(names.values())])
    run_names: set[str] = set()
    for run in runs:
        if run.name in run_names:
            raise InputError(f"two runs are called {run.name!r}; expected different names")
        run_names.add(run.name)
        columns = [run.times]
        for kind, expected_names in names.items():
            signals: Mapping[str, Array] = getattr(run, kind)
            if set(expected_names) != set(signals):
                word = "extra column" if kind == "extra" else kind.removesuffix("s")
                raise make_unknown_name_error(
                    f"{word} of run {run.name}",
                    ", ".join(set(expected_names) ^ set(signals)),
                    expected_names or ["none"],
                )
            columns += [signals[name] for name in expected_names]
        writer.writerows(
            zip(
                [run.name] * len(run.times),
                *(_format_cells(c, digits) for c in columns),
                strict=True,
            )
        )
    return text.getvalue()


def _format_cells(values: Array, digits: int) -> list[str]:
    """Format a column of the table; a missing sample (NaN) becomes an empty cell.

    Shapes: T samples.

    Args:
        values: (T,) numbers of the column, NaN where missing.
        digits: significant digits of each cell.
    """
    # repr gives the shortest text that is read back as the same number.
    format_number = repr if digits >= _LOSSLESS_DIGITS else f"{{:.{digits}g}}".format
    return [format_number(v) if math.isfinite(v) else "" for v in values.tolist()]


def _describe_source(recording: Recording, folder: Path) -> dict[str, Any]:
    """Return the entries of a description that state what was recorded: a system, or a model file.

    Args:
        recording: Recording.
        folder: Folder of the description, to which the path of the model file is relative.
    """
    model = recording.model
    if model is None:
        return {"system": recording.system}
    try:
        file = os.path.relpath(model.path, folder)
    except ValueError:  # on another drive
        file = str(model.path.resolve())
    entries: dict[str, Any] = {"model": Path(file).as_posix()}
    for name, table in (("actuators", model.actuators), ("engine", model.engine)):
        if table:
            entries[name] = dict(table)
    return entries


def format_description(recording: Recording, declared: DeclaredSignals, folder: Path) -> str:
    """Return the text of the description in TOML: units, constants, and what is known of each run.

    Entries that would be empty or have the default value are left out.

    Args:
        recording: Recording to describe; its first run determines the signals.
        declared: System of the recording, or simulator of it, for the units.
        folder: Folder of the description, to which the path of the model file is relative.
    """
    import tomli_w

    units = {signal.name: signal.unit for signal in (*declared.inputs, *declared.channels)}
    first_run = recording.runs[0]
    document: dict[str, Any] = {**_describe_source(recording, folder), "title": recording.title}
    document["channels"] = {name: {"unit": units[name]} for name in first_run.channels}
    for name in recording.noise.keys() & first_run.channels.keys():
        if recording.noise[name]:
            document["channels"][name]["noise"] = recording.noise[name]
    if first_run.inputs:
        document["inputs"] = {name: {"unit": units[name]} for name in first_run.inputs}
        for name in first_run.linear & first_run.inputs.keys():
            document["inputs"][name]["hold"] = "linear"
    if first_run.offset:
        document["time"] = {"offset": first_run.offset}
    if first_run.extra:
        document["extra"] = {
            name: {"unit": recording.extra.get(name, "1")} for name in first_run.extra
        }
    if recording.constants:
        document["constants"] = dict(recording.constants)
    run_entries = {run.name: _describe_run(run) for run in recording.runs}
    if any(run_entries.values()):
        document["runs"] = {name: entries for name, entries in run_entries.items() if entries}
    return tomli_w.dumps(document)


def _describe_run(run: Run) -> dict[str, Any]:
    """Return what a description states of one run: use, constants and initial state."""
    marks: dict[str, Any] = {"held_out": True} if run.held_out else {}
    marks |= dict(run.constants)
    return {**marks, "initial": dict(run.initial)} if run.initial else marks
