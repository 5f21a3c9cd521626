"""Describe a robot's model file, signals missing in its log, and positions beyond limits."""

from __future__ import annotations

from collections.abc import Iterator
from typing import cast

import numpy as np

from sims.core.simulator import Simulator
from sims.recording.recording import Recording
from sims.robot.robot_model import RobotModel
from sims.robot.robot_simulator import RobotSimulator

LIMIT_TOLERANCE = 0.01
"""Tolerance beyond a limit, as a fraction of the range, for soft limits and encoder offsets."""
MAX_NAMED_RUNS = 4
"""Maximum number of runs that are named in one line."""


def format_robot_summary(kind: type[Simulator]) -> Iterator[str]:
    """Yield lines about the robot of a simulator: its file, its parts and notes on repairs.

    Other simulators have no lines.
    """
    if not kind.has_model:
        return
    simulator = cast(type[RobotSimulator], kind)
    robot = simulator.robot
    counts = (
        (len(robot.joints), "joint"),
        (len(robot.actuators), "actuator"),
        (len(robot.bodies), "moving body"),
        (len(robot.sensors), "sensor row"),
    )
    words = ", ".join(f"{n} {_pluralise(word, n)}" for n, word in counts if n)
    step, integrator = simulator.numerics
    form = robot.format.upper()
    yield f"robot {robot.path} ({form}): {words}; {integrator} at {1e3 * step:g} ms"
    yield from (f"note: {note}" for note in robot.notes)


def _pluralise(word: str, count: int) -> str:
    return word if count == 1 else word.replace("body", "bodie") + "s"


def format_log_warnings(recording: Recording, kind: type[Simulator]) -> Iterator[str]:
    """Yield lines about signals missing in the log and signals beyond their limits.

    Args:
        recording: Recording to check.
        kind: Simulator class of its system.
    """
    if not kind.has_model:
        return
    robot = cast(type[RobotSimulator], kind).robot
    yield from _list_missing_signals(recording, robot)
    yield from _list_exceeded_ranges(recording, robot)


def _list_missing_signals(recording: Recording, robot: RobotModel) -> Iterator[str]:
    """Yield a line for the commands and one for the joint positions missing in the log."""
    run = recording.runs[0]
    missing_commands = [f"u.{a.name}" for a in robot.actuators if f"u.{a.name}" not in run.inputs]
    if missing_commands:
        yield f"not in the log, assumed to be zero: {', '.join(missing_commands)}"
    joints = [joint.name for joint in robot.joints if joint.has_one_coordinate]
    unseen = [name for name in joints if f"q.{name}" not in run.channels]
    if unseen:
        joint_names = ", ".join(unseen)
        yield (
            "positions that are not in the log, with initial values from the model file: "
            f"{joint_names}"
        )


def _list_exceeded_ranges(recording: Recording, robot: RobotModel) -> Iterator[str]:
    """Yield a line for each signal that leaves its range."""
    model = robot.path.name
    for joint in robot.joints:
        if joint.has_one_coordinate:
            yield from _format_exceeded_range(
                recording, f"q.{joint.name}", joint.range, joint.unit, model
            )
            effort = None if joint.effort is None else (-joint.effort, joint.effort)
            yield from _format_exceeded_range(
                recording, f"tau.{joint.name}", effort, joint.force_unit, model
            )
    for actuator in robot.actuators:
        yield from _format_exceeded_range(
            recording, f"u.{actuator.name}", actuator.range, "", model
        )


def _format_exceeded_range(
    recording: Recording, name: str, limits: tuple[float, float] | None, unit: str, model: str
) -> Iterator[str]:
    """Yield a line if a recorded signal leaves the range that the model file states.

    The line has the runs and the extreme values. `model` is the name of the model file.
    """
    if limits is None:
        return
    low, high = limits
    slack = LIMIT_TOLERANCE * (high - low)
    runs, min_value, max_value = [], np.inf, -np.inf
    for run in recording.runs:
        signal = run.channels.get(name, run.inputs.get(name))
        if signal is None or not np.isfinite(signal).any():
            continue
        lowest, highest = float(np.nanmin(signal)), float(np.nanmax(signal))
        if lowest < low - slack or highest > high + slack:
            runs.append(run.name)
            min_value, max_value = min(min_value, lowest), max(max_value, highest)
    if runs:
        run_names = ", ".join(dict.fromkeys(runs[:MAX_NAMED_RUNS])) + (
            " ..." if len(runs) > MAX_NAMED_RUNS else ""
        )
        states = f"{model} states {low:.4g} to {high:.4g}"
        yield f"{name} ranges from {min_value:.4g} to {max_value:.4g} {unit}".rstrip() + (
            f" in runs {run_names}, and {states}: another unit, sign or zero?"
        )
