"""Assign velocity columns, whose unit is that of their position's derivative.

Columns of one kind, such as ``velocity[0]`` and ``velocity[1]``, are decided together and over
several runs, so that all logs of one logger have the same velocities.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from bench.logs.importing import column_guessing
from bench.logs.importing.column_guessing import LogColumn
from bench.logs.importing.import_result import ImportResult
from bench.logs.importing.run_logs import MAX_RUNS, RunLogs
from bench.logs.importing.signal_assignment import (
    Placement,
    Signal,
    SignalAssignment,
    is_convertible,
)
from bench.logs.quality.velocity_consistency import MIN_CORRELATION, VelocityComparison
from sims.recording.recording import Run
from sims.recording.unit_conversion import compute_unit_scale
from sims.robot.robot_model import Joint

SLOPE_RANGE = (0.7, 1.4)
"""Interval of slopes, divided by a unit's factor, that confirm the unit."""
VELOCITY_UNITS = {"hinge": ("rad/s", "deg/s", "rpm", "turn/s"), "slide": ("m/s", "mm/s")}
"""Units of velocities, by kind of joint, the most usual first."""


class _Candidate(NamedTuple):
    """A column that may be the velocity of a joint.

    Attributes:
        column: The column.
        joint: Joint.
        placement: Reason for the joint.
        position: Position of the joint.
        comparison: Comparison with the derivative of the position; None if the joint hardly moves.
        unit: Unit that the comparison confirms; empty if there is none.
    """

    column: LogColumn
    joint: Joint
    placement: Placement
    position: Signal
    comparison: VelocityComparison | None
    unit: str

    @property
    def kind(self) -> tuple[str, ...]:
        """File and words of the column's name, without those of its joint and without numbers."""
        joint_words = set(column_guessing.split_name(self.joint.name))
        words = column_guessing.split_name(self.column.bare)
        return (
            self.column.file,
            self.joint.kind,
            *(word for word in words if word not in joint_words and not word.isdigit()),
        )


def assign_velocities(
    logs: RunLogs, signals: SignalAssignment, exchanged: Mapping[str, str], result: ImportResult
) -> None:
    """Assign the columns that are the derivative of their joint's position and do not lag it.

    Args:
        logs: Logs that are imported.
        signals: Signals to which velocities are added.
        exchanged: For each joint, the joint at whose index its position is, if that differs.
        result: Result to which messages are added.
    """
    columns = [c for c in logs.columns if column_guessing.guess_role(c) == "velocity"]
    assignments = signals.place_columns(columns)
    by_order = {joint.name: c for c, joint, p in assignments if p is Placement.MODEL_ORDER}
    kinds: dict[tuple[str, ...], list[_Candidate]] = {}
    for own_column, joint, own_placement in assignments:
        column, placement = own_column, own_placement
        if placement is Placement.MODEL_ORDER and joint.name in exchanged:
            column = by_order.get(exchanged[joint.name], own_column)
            placement = Placement.POSITIONS
        position = signals.get_position(joint.name)
        if position is None or position.column.file != column.file:
            result.leave_out(column, f"no position of {joint.name} in the same file shows its unit")
            continue
        comparison = _compare_with_derivative(logs, column, position, joint)
        unit = _confirm_unit(comparison, column, joint)
        candidate = _Candidate(column, joint, placement, position, comparison, unit)
        kinds.setdefault(candidate.kind, []).append(candidate)
    for candidates in kinds.values():
        _assign_kind(candidates, signals, result)


def _compare_with_derivative(
    logs: RunLogs, column: LogColumn, position: Signal, joint: Joint
) -> VelocityComparison | None:
    """Compare a velocity column with the derivative of its joint's position, over the first runs.

    Return None if no run has enough motion for a comparison.
    """
    runs = []
    for name in list(logs.runs)[:MAX_RUNS]:
        velocities, positions = logs.read(name, column), logs.read(name, position.column)
        if velocities is None or positions is None:
            continue
        seconds, values = velocities
        is_new = np.diff(seconds, prepend=-np.inf) > 0
        angles = position.convert(joint.unit, positions[1])
        channels = {"q": angles[is_new], "v": values[is_new]}
        runs.append(Run(name, seconds[is_new], channels, {}, {}, {}, False))
    return VelocityComparison.measure(runs, "q", "v")


def _confirm_unit(comparison: VelocityComparison | None, column: LogColumn, joint: Joint) -> str:
    """Return the unit in which a velocity is its position's derivative; empty if there is none."""
    if comparison is None or comparison.correlation < MIN_CORRELATION:
        return ""
    si = f"{joint.unit}/s"
    stated_units = [column.unit] if is_convertible(column.unit, si) else []
    for unit in (*stated_units, *VELOCITY_UNITS["hinge" if joint.kind == "hinge" else "slide"]):
        gain = compute_unit_scale(unit, si).gain
        if SLOPE_RANGE[0] < gain / comparison.slope < SLOPE_RANGE[1]:
            return unit
    return ""


def _assign_kind(
    candidates: Sequence[_Candidate], signals: SignalAssignment, result: ImportResult
) -> None:
    """Assign velocity columns that agree with the derivative of their position.

    `candidates` are the columns of one kind, which share a unit and a filter. All are left out if
    the velocities lag behind the positions. A joint that hardly moves gets the unit of the others.
    """
    confirmed = [candidate for candidate in candidates if candidate.unit]
    units = [candidate.unit for candidate in confirmed]
    usual_unit = max(units, key=units.count) if units else ""
    comparisons = [c.comparison for c in confirmed if c.comparison is not None]
    delay = VelocityComparison.pool(comparisons).delay() if comparisons else None
    for column, joint, placement, position, comparison, confirmed_unit in candidates:
        name, source = f"qd.{joint.name}", position.column.name
        stated_unit = column.unit if is_convertible(column.unit, f"{joint.unit}/s") else ""
        unit = confirmed_unit or (usual_unit if comparison is None else "")
        if name in signals.channels:
            reason = f"{name} is {signals.channels[name].column.name} already"
        elif not unit:
            reason = f"is not the derivative of {source}"
            if column_guessing.is_constant(column.values):
                reason = "never changes"
            elif comparison is None:
                reason = f"{joint.name} hardly moves, so its unit cannot be inferred"
        elif delay is not None:
            reason = (
                f"is {delay.samples:.2g} samples {delay.direction_word} the derivative of "
                f"{source}, filtered or stamped at a different time"
            )
        elif stated_unit and unit != stated_unit:
            reason = f"is in {stated_unit} by its name and in {unit} by {source}"
        else:
            origin = f"the derivative of {source}"
            if not confirmed_unit:
                origin = f"the other velocities are; {joint.name} hardly moves"
            signals.channels[name] = Signal(column, unit, placement, f"; in {unit}, as {origin}")
            continue
        result.leave_out(column, reason)
