"""Write a recording of a robot as the files of a user: model, table and description."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tomli_w

FORCE_UNITS = {"rad": "N*m", "m": "N"}


def signal_unit(name, position_unit, is_force=False):
    """Return the unit of a channel q.X, qd.X or tau.X, or of an input u.X.

    Args:
        name: name of the channel or input.
        position_unit: rad or m, the unit of the joint's position.
        is_force: whether an input is a force.
    """
    kind = name.partition(".")[0]
    if kind == "tau" or is_force:
        return FORCE_UNITS[position_unit]
    return f"{position_unit}/s" if kind == "qd" else position_unit


def write_robot_recording(folder, stem, inputs, channels, runs, model, time_format=".2f", **more):
    """Write STEM.csv, STEM.toml and the model file, and return the path of the first.

    Args:
        folder: folder of the files.
        stem: name of the recording.
        inputs: unit by name.
        channels: unit, and noise standard deviation or None, by name.
        runs: by name, whether the run is held out, times (T,), commands (T, U) and readings
            (T, C), and optionally the stated initial state.
        model: (name, text) of the model file.
        time_format: format of the times.
        **more: further tables of the description.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    name, text = model
    (folder / name).write_text(text)
    lines, tables = [",".join(["run", "t", *inputs, *channels])], {}
    for run, (is_held_out, times, commands, readings, *initial) in runs.items():
        for t, row in zip(times, np.hstack([commands, readings]), strict=True):
            lines.append(",".join([run, f"{t:{time_format}}", *(f"{x:.9g}" for x in row)]))
        tables[run] = {"held_out": True} if is_held_out else {}
        tables[run] |= {"initial": initial[0]} if initial and initial[0] else {}
    path = folder / f"{stem}.csv"
    path.write_text("\n".join(lines) + "\n")
    description = {
        "model": name,
        **more,
        "inputs": {key: {"unit": unit} for key, unit in inputs.items()},
        "channels": {
            key: {"unit": unit} | ({} if sigma is None else {"noise": float(f"{sigma:.6g}")})
            for key, (unit, sigma) in channels.items()
        },
        "runs": {run: table for run, table in tables.items() if table},
    }
    path.with_suffix(".toml").write_text(tomli_w.dumps(description))
    return path
