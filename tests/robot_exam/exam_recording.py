"""Write a benchmark case as files: recording, description and the robot's model file."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from tests.robot_exam import causes_outside_library
from tests.robot_exam.exam_settings import FITTED
from tests.robot_exam.reference_world import World
from tests.robot_exam.robot_items import rng_of, setting_of
from tests.robot_exam.sensor_models import observed

FORCES = {"rad": "N*m", "m": "N"}


def realise(item, folder):
    """Write recording.csv, recording.toml and robot.urdf, and return the path of the first.

    No file reveals the hidden cause.
    """
    setting, folder = setting_of(item.name), Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.urdf").write_text(setting.machine.urdf)
    (folder / "recording.toml").write_text(described(setting))
    path = folder / "recording.csv"
    path.write_text(_table(item, setting))
    return path


def recorded(item):
    """Return the recorded channels of every run, (T, C)."""
    setting, rng = setting_of(item.name), rng_of(item.name, "noise")
    world = World(setting.machine, _library(item), causes_outside_library.plant_of(item.effects))
    values = []
    for number, run in enumerate(setting.runs):
        slips = causes_outside_library.slips_of(item.effects, number)
        values.append(setting.noise.add_to(observed(world, run, setting.channels, slips), rng))
    return values


def _library(item):
    return {} if item.kind == "foreign" else item.effects


def _table(item, setting):
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    inputs = [f"u.{drive.name}" for drive in setting.machine.drives]
    writer.writerow(["run", "t", *inputs, *setting.channels])
    for number, (run, values) in enumerate(zip(setting.runs, recorded(item), strict=True)):
        commands = np.column_stack(list(run.commands.values()))
        for t, u, row in zip(run.times, commands, values, strict=True):
            writer.writerow([number, f"{t:.2f}", *(f"{x:.9g}" for x in (*u, *row))])
    return text.getvalue()


def described(setting):
    """Return the text of the recording's TOML description."""
    machine = setting.machine
    lines = ['model = "robot.urdf"', "", "[engine]", f"timestep = {machine.step}"]
    lines += [f'integrator = "{machine.integrator}"', ""]
    for drive in machine.drives:
        lines += [f"[actuators.{drive.name}]", f'joint = "{drive.joint}"', f'kind = "{drive.kind}"']
        if drive.kp:
            lines += [f"kp = {drive.kp}", f"kv = {drive.kv}"]
        lines += [f"force_range = [{-drive.force}, {drive.force}]", ""]
    for name in setting.channels:
        kind, _, joint = name.partition(".")
        unit = machine.unit(joint)
        unit = FORCES[unit] if kind == "tau" else f"{unit}/s" if kind == "qd" else unit
        sigma = setting.noise.sigma[name]
        lines += [f'[channels."{name}"]', f'unit = "{unit}"', f"noise = {sigma:.6g}", ""]
    for drive in machine.drives:
        unit = machine.unit(drive.joint)
        unit = unit if drive.kp else FORCES[unit]
        lines += [f'[inputs."u.{drive.name}"]', f'unit = "{unit}"', ""]
    for number in range(FITTED, len(setting.runs)):
        lines += [f"[runs.{number}]", "held_out = true", ""]
    return "\n".join(lines)
