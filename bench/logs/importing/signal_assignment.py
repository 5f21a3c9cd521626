"""Signals of a robot and the log columns that are assigned to them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

from bench.logs.importing import column_guessing
from bench.logs.importing.column_guessing import LogColumn
from sims.core.simulator import Array, InputError
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
