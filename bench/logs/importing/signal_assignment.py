"""Assign columns to signals: commands, positions and velocities.

Columns of one kind, such as ``velocity[0]`` and ``velocity[1]``, are decided together and over
several runs, so that all logs of one logger have the same velocities.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from bench.logs.importing import column_guessing
from bench.logs.importing.column_guessing import LogColumn
from bench.logs.importing.import_result import ImportResult
from bench.logs.importing.run_logs import MAX_RUNS, RunLogs
from bench.logs.quality.velocity_consistency import MIN_CORRELATION, VelocityComparison
from sims.core.simulator import Array, InputError
from sims.recording.recording import Run
from sims.recording.unit_conversion import compute_unit_scale
from sims.robot.robot_model import Actuator, Joint, RobotModel


class Placement(Enum):
    """Reason for assigning a column to its joint."""

    NAME = "by its name"
    MODEL_ORDER = "by the model's order of joints"
    CONFIRMED_ORDER = "by the model's order of joints (each follows its command)"
    COMMANDS = "in the order in which positions follow their commands"
    MODEL = "in the order in which the model explains the motion best"
    POSITIONS = "in the order of the positions"

    @property
    def is_order(self) -> bool:
        """True if the number of the column decides, in the model's order of joints."""
        return self in (Placement.MODEL_ORDER, Placement.CONFIRMED_ORDER)


@dataclass(frozen=True)
class Signal:
    """The column of a channel or an input.

    Attributes:
        column: Column of the log.
        unit: Unit of its numbers, after scale and offset.
        placement: Reason for the joint.
        reason: Reason for the unit, which follows that for the joint in messages.
        scale: Factor by which its numbers are multiplied.
        offset: Offset that is added after that.
    """

    column: LogColumn
    unit: str
    placement: Placement
    reason: str
    scale: float = 1.0
    offset: float = 0.0

    @property
    def description(self) -> str:
        """Reasons for joint and unit."""
        return f"{self.placement.value}{self.reason}"

    def with_placement(self, placement: Placement) -> Signal:
        """Return the signal with another reason for its joint."""
        return replace(self, placement=placement)

    def convert(self, unit: str, values: Array) -> Array:
        """Convert numbers of the column to an SI unit.

        Args:
            unit: SI unit of the result.
            values: (T,) numbers of the column.
        """
        conversion = compute_unit_scale(self.unit, unit)
        converted: Array = conversion.gain * (self.scale * values + self.offset) + conversion.offset
        return converted


@dataclass
class SignalAssignment:
    """Signals of a robot and their columns.

    Attributes:
        robot: Robot that was recorded.
        channels: Column of each channel.
        inputs: Column of each input.
        added_servos: Joint of each position servo that is missing in the model file, by the name
            that it gets.
        switches: Columns that may say when drives are on.
    """

    robot: RobotModel
    channels: dict[str, Signal] = field(default_factory=dict)
    inputs: dict[str, Signal] = field(default_factory=dict)
    added_servos: dict[str, Joint] = field(default_factory=dict)
    switches: list[LogColumn] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.joints = [joint for joint in self.robot.joints if joint.has_one_coordinate]
        self._actuators = {a.joint: a for a in self.robot.actuators if a.joint}

    def get_actuator(self, joint: str) -> Actuator | None:
        """Return the actuator of a joint in the model file; None if there is none."""
        return self._actuators.get(joint)

    def get_position(self, joint: str) -> Signal | None:
        """Return the position of a joint; None if there is none."""
        return self.channels.get(f"q.{joint}")

    def get_servo_input(self, joint: str) -> str:
        """Return the input of a joint's position servo; empty if it has none."""
        actuator = self.get_actuator(joint)
        if actuator is not None:
            return f"u.{actuator.name}" if actuator.kind == "position" else ""
        return f"u.m_{joint}" if f"m_{joint}" in self.added_servos else ""

    def get_joint(self, signal: str) -> str:
        """Return the joint of a channel or an input; the signal's own name if it has none."""
        name = signal.partition(".")[2]
        joint = next((a.joint for a in self.robot.actuators if a.name == name), None)
        added_servo = self.added_servos.get(name)
        return joint or (added_servo.name if added_servo is not None else name)

    def place_columns(
        self, columns: Sequence[LogColumn]
    ) -> list[tuple[LogColumn, Joint, Placement]]:
        """Assign columns of one kind to joints: by their names, else by their numbers."""
        assignments = []
        numbered: dict[tuple[str, str], list[LogColumn]] = {}
        for column in columns:
            joint = column_guessing.match_joint(column, self.joints)
            if joint is not None:
                assignments.append((column, joint, Placement.NAME))
            else:
                # Columns of one kind differ by the last number of their names.
                group = column.file, re.sub(r"\d+(?=\D*$)", "", column.bare)
                numbered.setdefault(group, []).append(column)
        for group_columns in numbered.values():
            joints = column_guessing.match_numbered_joints(group_columns, self.joints)
            assignments += [
                (column, joints[column.name], Placement.MODEL_ORDER)
                for column in group_columns
                if column.name in joints
            ]
        return assignments

    def has_number_of_joint(self, joint: str) -> bool:
        """Return whether the number in a joint's name is that of its column's name."""
        numbers = [
            [int(digits) for digits in re.findall(r"\d+", text)]
            for text in (joint, self._get_column_name(joint))
        ]
        return all(numbers) and numbers[0][-1] == numbers[1][-1]

    def _get_column_name(self, joint: str) -> str:
        """Return the column name of a joint's position, or else of its command."""
        position = self.get_position(joint)
        if position is not None and position.placement.is_order:
            return position.column.bare
        signals = (s for name, s in self.inputs.items() if self.get_joint(name) == joint)
        return next((signal.column.bare for signal in signals), "")


def is_convertible(unit: str, target: str) -> bool:
    """Return whether a unit converts to another one."""
    try:
        compute_unit_scale(unit, target)
    except InputError:
        return False
    return bool(unit)


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
