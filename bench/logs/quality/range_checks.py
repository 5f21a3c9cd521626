"""Check the size of recorded values.

Positions, forces and commands of a robot are compared with the ranges of its model file. The values
of any recording must be small enough for computing with their squares.
"""

from __future__ import annotations

from collections.abc import Iterator
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np

from bench.logs.quality.quality_finding import Anomaly
from sims.core.number_limits import MAX_NUMBER
from sims.core.simulator import Array, InputError, Simulator
from sims.recording.recording import Recording

if TYPE_CHECKING:  # A recording without a robot needs no model.
    from sims.robot.robot_model import Joint, RobotModel


MAX_RANGE_EXCESS = 1.0
"""Maximum plausible distance of a position beyond its joint's range, as a fraction of the range."""
RANGE_TOLERANCE = 0.02
"""Distance beyond a joint's range explained by noise or an offset, as a fraction of the range."""
MAX_PLAUSIBLE_TURNS = 8.0
"""Maximum plausible number of turns of a joint without limits."""
_SMALLER_UNITS = {"rad": (np.pi / 180.0, "degrees"), "m": (1e-3, "millimetres")}
"""Smaller unit in which positions are often recorded, by SI unit: its value and name."""

LIMIT_TOLERANCE = 0.01
"""Tolerance beyond a limit, as a fraction of the range, for soft limits and encoder offsets."""
MAX_NAMED_RUNS = 4
"""Maximum number of runs that are named in one line."""


def check_joint_ranges(recording: Recording, kind: type[Simulator]) -> Iterator[Anomaly]:
    """Find positions of a robot's joints beyond their limits; none for other systems.

    Args:
        recording: Recording to check.
        kind: Simulator class of its system.
    """
    if not kind.has_model:
        return
    for joint in kind.robot.joints:  # type: ignore[attr-defined]
        if joint.has_one_coordinate:
            yield from _check_joint_range(recording, joint)


def _check_joint_range(recording: Recording, joint: Joint) -> Iterator[Anomaly]:
    """Find positions beyond the limits of a joint, which a wrong unit or a wrong limit explains.

    An anomaly is certain if no correct recording can have it. There are three cases:

    * A joint without limits turns very often: not certain.
    * Positions are slightly beyond the limits: not certain, the limits may be wrong.
    * Positions are far beyond the limits: certain, the unit is wrong.

    Only the first run with such positions is reported.

    Args:
        recording: recording of the robot.
        joint: joint of its model; its range is in rad or m.
    """
    column = f"q.{joint.name}"
    # Size of the smaller unit (degree or millimetre) in the unit of the range, and its name.
    unit, (smaller_unit, smaller_unit_name) = joint.unit, _SMALLER_UNITS[joint.unit]
    for run in recording.runs:
        positions = run.channels.get(column)
        if positions is None or not np.isfinite(positions).any():
            continue
        lowest, highest = float(np.nanmin(positions)), float(np.nanmax(positions))
        extreme = max(lowest, highest, key=abs)
        if joint.range is None:
            if joint.kind == "hinge" and abs(extreme) > MAX_PLAUSIBLE_TURNS * 2.0 * np.pi:
                turns = f"{abs(extreme) / (2.0 * np.pi):.3g} turns"
                message = f"found {extreme:.4g} rad, {turns}; is the unit degrees?"
                yield Anomaly(f"run {run.name}, column {column}: {message}", False)
                return
            continue
        low, high = joint.range
        if is_within_widened_range((lowest, highest), joint.range, MAX_RANGE_EXCESS):
            # Plausible, but perhaps slightly beyond one end of the range.
            excess, limit, reached = max(
                (low - lowest, low, lowest), (highest - high, high, highest), key=itemgetter(0)
            )
            if excess > RANGE_TOLERANCE * (high - low):
                stop = f"joint {joint.name} of the model stops at {limit:.4g}"
                message = f"goes to {reached:.4g} {unit}, and {stop}; is its range right?"
                yield Anomaly(f"run {run.name}, column {column}: {message}", False)
                return
            continue
        # Suggest the smaller unit if the numbers, read in that unit, lie within the limits.
        converted_extremes = smaller_unit * lowest, smaller_unit * highest
        is_smaller_unit = is_within_widened_range(converted_extremes, joint.range, MAX_RANGE_EXCESS)
        doubt = f"is the unit {smaller_unit_name}?" if is_smaller_unit else "is the unit right?"
        message = f"expected within {low:.4g} to {high:.4g} {unit}, the joint's range"
        yield Anomaly(
            f"run {run.name}, column {column}: {message}, found {extreme:.4g}; {doubt}", True
        )
        return


def is_within_widened_range(
    extremes: tuple[float, float] | Array, limits: tuple[float, float], share: float
) -> bool:
    """Return whether positions lie within a joint's range, widened at both ends by a share of it.

    Args:
        extremes: Lowest and highest position.
        limits: Range of the joint, in the same unit.
        share: Width by which each end is moved outwards, as a fraction of the range.
    """
    lowest, highest = extremes
    low, high = limits
    slack = share * (high - low)
    return bool(low - slack <= lowest and highest <= high + slack)


def list_exceeded_ranges(recording: Recording, robot: RobotModel) -> Iterator[str]:
    """Yield a warning for each signal that leaves its range in the model file.

    Checked are the positions and forces of joints with one coordinate, and the commands.

    Args:
        recording: recorded runs, with their channels, inputs and constants.
        robot: model of the robot, with its ranges.
    """
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
    """Yield a warning if a recorded signal clearly leaves the range that the model file states.

    It names the runs and the extreme values, and asks whether unit, sign or zero is wrong.

    Args:
        recording: recorded runs, with their channels, inputs and constants.
        name: name of the channel or input.
        limits: range of the model file; None if it states none.
        unit: unit of signal and range.
        model: name of the model file.
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
        # The two parts of a divided run have the same name, which is stated once.
        run_names = ", ".join(dict.fromkeys(runs[:MAX_NAMED_RUNS])) + (
            " ..." if len(runs) > MAX_NAMED_RUNS else ""
        )
        states = f"{model} states {low:.4g} to {high:.4g}"
        yield f"{name} ranges from {min_value:.4g} to {max_value:.4g} {unit}".rstrip() + (
            f" in runs {run_names}, and {states}: another unit, sign or zero?"
        )


def check_value_sizes(recording: Recording) -> None:
    """Reject values that are so large that sums of their squares may overflow.

    Args:
        recording: Recording to check; missing values (NaN) are ignored.

    Raises:
        InputError: A value of a channel or input exceeds `MAX_NUMBER`; the message is one line.
    """
    for run in recording.runs:
        for name, values in (*run.channels.items(), *run.inputs.items()):
            largest = float(np.nanmax(np.abs(values), initial=0.0))
            if largest > MAX_NUMBER:
                problem = f"expected values within ±{MAX_NUMBER:g}, found {largest:.3g}"
                raise InputError(f"{recording.path}: run {run.name}, column {name}: {problem}")
