"""Assign the columns of a log to the signals of a robot: positions, velocities, commands, torques.

Columns of one kind, such as ``velocity[0]`` and ``velocity[1]``, are decided together and over
several runs, so that all logs of one logger have the same velocities.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.logs.importing import column_guessing
from bench.logs.importing.column_guessing import LogColumn, Role
from bench.logs.importing.import_result import MAX_NAMES, ImportOptions, ImportResult
from bench.logs.importing.normalised_positions import (
    MAX_NORMALISED,
    UNIT_REMEDY,
    NormalisedPositions,
    find_position_conversion,
    is_lerobot,
)
from bench.logs.importing.run_logs import MAX_RUNS, RunLogs
from bench.logs.quality.velocity_checks import MIN_CORRELATION, VelocityComparison
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array, InputError
from sims.recording.recording import Run
from sims.recording.unit_conversion import compute_unit_scale, is_convertible
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

        Scale and offset give a value in `self.unit`, which is then converted.

        Args:
            unit: SI unit of the result.
            values: (T,) numbers of the column.
        """
        conversion = compute_unit_scale(self.unit, unit)
        converted: Array = conversion.gain * (self.scale * values + self.offset) + conversion.offset
        return converted


class PlacedColumn(NamedTuple):
    """Column of a log, its joint, and how it was assigned."""

    column: LogColumn
    joint: Joint
    placement: Placement


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

    def place_columns(self, columns: Sequence[LogColumn]) -> list[PlacedColumn]:
        """Assign columns of one role to joints: by their names, else by their numbers.

        Numbered columns are assigned together if they are in one file and differ by the last number
        of their names alone. Columns that match no joint are left out.

        Args:
            columns: Columns with the same role, such as positions.

        Returns:
            Each assigned column with its joint, and how it was assigned.
        """
        assignments = []
        numbered: dict[tuple[str, str], list[LogColumn]] = {}
        for column in columns:
            joint = column_guessing.match_joint(column, self.joints)
            if joint is not None:
                assignments.append(PlacedColumn(column, joint, Placement.NAME))
            else:
                # Without the last number of the name.
                name_without_number = re.sub(r"\d+(?=\D*$)", "", column.bare)
                numbered.setdefault((column.file, name_without_number), []).append(column)
        for group_columns in numbered.values():
            joints = column_guessing.match_numbered_joints(group_columns, self.joints)
            assignments += [
                PlacedColumn(column, joints[column.name], Placement.MODEL_ORDER)
                for column in group_columns
                if column.name in joints
            ]
        return assignments

    def has_number_of_joint(self, joint: str) -> bool:
        """Return whether the last number in a joint's name is also that of its column's name."""
        joint_numbers = re.findall(r"\d+", joint)
        column_numbers = re.findall(r"\d+", self._get_column_name(joint))
        if not joint_numbers or not column_numbers:
            return False
        return int(joint_numbers[-1]) == int(column_numbers[-1])

    def _get_column_name(self, joint: str) -> str:
        """Return the column name of a joint's position, or else of its command.

        The position counts only if it was assigned by the number of its column. The name is empty
        if there is neither.

        Args:
            joint: name of the joint.
        """
        position = self.get_position(joint)
        if position is not None and position.placement.is_order:
            return position.column.bare
        for name, signal in self.inputs.items():
            if self.get_joint(name) == joint:
                return signal.column.bare
        return ""


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
        """File, kind of joint, and words of the column's name without its joint and numbers.

        Columns of one kind, such as `q_hip` and `q_knee`, are assigned together.
        """
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

    A robot's velocity signal may be filtered, scaled or of another time; then it would mislead a
    fit. So each column is compared with the derivative of the position, which also confirms its
    unit. Columns whose names differ by joint or number only were written in the same way, so they
    are all assigned or all left out.

    Args:
        logs: Logs that are imported.
        signals: Signals to which velocities are added.
        exchanged: For each joint, the joint to which its position column had been assigned in the
            order of the model; empty if positions were not exchanged.
        result: Result to which messages are added.
    """
    columns = [c for c in logs.columns if column_guessing.guess_role(c) == "velocity"]
    assignments = signals.place_columns(columns)
    # Columns whose joint is only known by their number.
    columns_by_order = {
        joint.name: column
        for column, joint, placement in assignments
        if placement is Placement.MODEL_ORDER
    }
    candidates_by_kind: dict[tuple[str, ...], list[_Candidate]] = {}
    for own_column, joint, own_placement in assignments:
        column, placement = own_column, own_placement
        # Columns assigned by their numbers follow the order of the positions: if those were
        # exchanged, the joint gets the velocity column with the number of its position column.
        if placement is Placement.MODEL_ORDER and joint.name in exchanged:
            column = columns_by_order.get(exchanged[joint.name], own_column)
            placement = Placement.POSITIONS
        position = signals.get_position(joint.name)
        if position is None or position.column.file != column.file:
            result.leave_out(column, f"no position of {joint.name} in the same file shows its unit")
            continue
        comparison = _compare_with_derivative(logs, column, position, joint)
        unit = _confirm_unit(comparison, column, joint)
        candidate = _Candidate(column, joint, placement, position, comparison, unit)
        candidates_by_kind.setdefault(candidate.kind, []).append(candidate)
    for candidates in candidates_by_kind.values():
        _assign_kind(candidates, signals, result)


def _compare_with_derivative(
    logs: RunLogs, column: LogColumn, position: Signal, joint: Joint
) -> VelocityComparison | None:
    """Compare a velocity column with the derivative of its joint's position, over the first runs.

    At most `MAX_RUNS` runs are read. The velocity stays in the unit of its column, which is not
    known yet; the position is in rad or m.

    Args:
        logs: files of the runs.
        column: velocity column.
        position: position signal of the joint.
        joint: joint of the robot.

    Returns:
        The comparison; None if no run has enough motion for it.
    """
    runs = []
    for name in list(logs.runs)[:MAX_RUNS]:
        velocity_samples = logs.read(name, column)
        position_samples = logs.read(name, position.column)
        if velocity_samples is None or position_samples is None:
            continue
        # Both columns are in the same file, so they share their time stamps.
        seconds, velocities = velocity_samples
        _, recorded_positions = position_samples
        positions = position.convert(joint.unit, recorded_positions)
        is_new = np.diff(seconds, prepend=-np.inf) > 0  # not a repeated stamp
        channels = {"q": positions[is_new], "v": velocities[is_new]}
        runs.append(Run(name, seconds[is_new], channels, {}, {}, {}, False))
    return VelocityComparison.measure(runs, "q", "v")


def _confirm_unit(comparison: VelocityComparison | None, column: LogColumn, joint: Joint) -> str:
    """Return the unit in which a velocity is its position's derivative; empty if there is none.

    The unit of the column is tried first, then the usual ones. A unit is confirmed if its factor to
    rad/s or m/s is about the slope of the position's changes against the integrated velocity.

    Args:
        comparison: comparison with the position's derivative; None if the joint hardly moves.
        column: column of the log.
        joint: joint of the robot.
    """
    if comparison is None or comparison.correlation < MIN_CORRELATION:
        return ""
    si_unit = f"{joint.unit}/s"
    stated_units = [column.unit] if is_convertible(column.unit, si_unit) else []
    usual_units = VELOCITY_UNITS["hinge" if joint.kind == "hinge" else "slide"]
    min_ratio, max_ratio = SLOPE_RANGE
    for unit in (*stated_units, *usual_units):
        factor = compute_unit_scale(unit, si_unit).gain
        if min_ratio < factor / comparison.slope < max_ratio:
            return unit
    return ""


def _assign_kind(
    candidates: Sequence[_Candidate], signals: SignalAssignment, result: ImportResult
) -> None:
    """Assign velocity columns of one kind that agree with the derivative of their position.

    Columns of one kind have names that differ by joint or number only, and so share a unit and a
    filter. All are left out if the velocities lag behind the positions, or are ahead of them. A
    joint that hardly moves gets the unit of the others. Each column that is left out is reported
    with the reason.

    Args:
        candidates: columns of one kind.
        signals: assignment to which they are added.
        result: result of the import, to which messages are added.
    """
    # The comparison with the derivative confirms the unit of a candidate, or gives none.
    confirmed = [candidate for candidate in candidates if candidate.unit]
    units = [candidate.unit for candidate in confirmed]
    usual_unit = max(units, key=units.count) if units else ""
    comparisons = [c.comparison for c in confirmed if c.comparison is not None]
    delay = VelocityComparison.pool(comparisons).delay() if comparisons else None
    for column, joint, placement, position, comparison, confirmed_unit in candidates:
        name, source = f"qd.{joint.name}", position.column.name
        stated_unit = column.unit if is_convertible(column.unit, f"{joint.unit}/s") else ""
        # A joint that hardly moves has no comparison, and gets the unit of the others.
        unit = confirmed_unit or (usual_unit if comparison is None else "")
        # The first reason to leave the column out decides.
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


MIN_FOLLOWING_CORRELATION = 0.9
"""Minimum correlation of a motor's command with a position that makes it a desired position."""
MAX_FOLLOWING_DISTANCE = 0.5
"""Maximum distance (RMS) of such a command from the position, as a share of its deviation."""
COMMAND_QUANTITIES = {"motor": "force", "position": "position", "velocity": "velocity"}
"""Quantity that an actuator takes, by its kind."""


class ColumnAssigner:
    """Assignment of columns to the signals of a robot, with messages."""

    def __init__(
        self,
        logs: RunLogs,
        signals: SignalAssignment,
        options: ImportOptions,
        result: ImportResult,
    ) -> None:
        """Store the inputs; nothing is assigned yet.

        `normalised` is set by `assign_positions` if positions are normalised to the ranges of their
        joints.

        Args:
            logs: Logs that are imported.
            signals: Assignment to which signals are added.
            options: Information that the user states.
            result: Result to which messages are added.
        """
        self._logs, self._signals, self._result = logs, signals, result
        self._options = options
        self.normalised: NormalisedPositions | None = None

    def _select_by_role(self, *roles: Role | None) -> list[LogColumn]:
        """Return the columns that have one of some roles."""
        return [c for c in self._logs.columns if column_guessing.guess_role(c) in roles]

    # -- positions

    def assign_positions(self) -> None:
        """Assign the positions of the joints.

        Columns whose names show no role are tried, too.

        Raises:
            InputError: No column is a joint's position.
        """
        columns = self._select_by_role("position", None)
        self._find_normalised([column for column in columns if not column.unit])
        for column, joint, placement in self._signals.place_columns(columns):
            self._add_signal(
                self._signals.channels,
                f"q.{joint.name}",
                column,
                self._make_position_signal(column, joint, placement),
            )
        if not self._signals.channels:
            names = ", ".join(f"{c.file}: {c.name}" for c in self._logs.columns[:MAX_NAMES])
            raise InputError(
                f"{self._logs.first_path}: no column is a joint's position by name, number or "
                f"range; there are {names}; write the description by hand"
            )

    def _find_normalised(self, columns: Sequence[LogColumn]) -> None:
        """Decide whether positions are normalised to the joint ranges, as LeRobot records them.

        The result is stored in `normalised`. If it cannot be decided, the user is asked to check.

        Args:
            columns: Columns without a unit that may be positions.
        """
        assignments = [(column, joint) for column, joint, _ in self._signals.place_columns(columns)]
        if not assignments:
            return
        path, options = self._logs.first_path, self._options
        # Other runs may contain larger positions than the first, which the columns hold.
        largest = max(
            float(np.nanmax(np.abs(values), initial=0.0))
            for column, _ in assignments
            for values in (column.values, *self._logs.read_runs(column)[1:])
        )
        calibration = None if options.calibration is None else Path(options.calibration)
        self.normalised = find_position_conversion(
            path, largest, options.position_unit, calibration
        )
        if self.normalised is not None:
            self._result.guessed.append(f"positions: {self.normalised.description}")
        elif (
            not options.position_unit
            and largest <= MAX_NORMALISED
            and is_lerobot(path, (column.name for column, _ in assignments))
            and any(
                column_guessing.guess_position_unit(column.values, joint) in ("deg", None)
                for column, joint in assignments
            )
        ):
            self._result.checks.append(
                "positions lie within -100 to 100: they are read as degrees, but may be LeRobot's "
                f"normalised positions; {UNIT_REMEDY}"
            )

    def _make_position_signal(
        self, column: LogColumn, joint: Joint, placement: Placement
    ) -> Signal | None:
        """Determine the unit of a position or a position command, and make its signal.

        The unit is the first of these: the one that the log states; that to which normalised
        positions are converted; for a hinge, the one that the user states; the one in which the
        values fit the range of the joint.

        Args:
            column: column of the log.
            joint: joint of the robot.
            placement: reason for assigning the column to its joint.

        Returns:
            The signal; None, with a message, if no unit is known.
        """
        if column.unit:
            if not is_convertible(column.unit, joint.unit):
                expected = "an angle" if joint.kind == "hinge" else "a length"
                self._result.leave_out(
                    column,
                    f"is in {column.unit}, expected {expected}; state unit, scale and offset in "
                    "the description by hand",
                )
                return None
            origin = "the row of units" if column.units_row else "its name"
            return Signal(column, column.unit, placement, f"; in {column.unit} by {origin}")
        if self.normalised is not None:
            scale = self.normalised.get_position_scale(column.name, column.values, joint)
            if scale is None:
                reason = f"is normalised, and the range of {joint.name} is not known"
                self._result.leave_out(column, reason)
                return None
            unit, (gain, offset) = scale
            return Signal(column, unit, placement, "; normalised", gain, offset)
        if self._options.position_unit and joint.kind == "hinge":
            unit = self._options.position_unit
            return Signal(column, unit, placement, f"; in {unit} as the user states")
        guessed_unit = column_guessing.guess_position_unit(column.values, joint)
        if guessed_unit is None:
            low, high = joint.range or (-np.inf, np.inf)
            range_text = f"{np.nanmin(column.values):.4g} to {np.nanmax(column.values):.4g}"
            self._result.leave_out(
                column, f"ranges from {range_text}, {joint.name} from {low:.4g} to {high:.4g}"
            )
            return None
        return Signal(column, guessed_unit, placement, f"; in {guessed_unit} by its range")

    def _add_signal(
        self, table: dict[str, Signal], name: str, column: LogColumn, signal: Signal | None
    ) -> bool:
        """Add a signal unless one with this name exists, which is reported.

        Args:
            table: channels or inputs of the assignment, extended in place.
            name: name of the signal.
            column: its column.
            signal: the signal; None if its unit is not known, so that there is nothing to add.

        Returns:
            Whether the signal was added.
        """
        if name in table:
            self._result.leave_out(column, f"{name} is {table[name].column.name} already")
            return False
        if signal is not None:
            table[name] = signal
        return signal is not None

    # -- commands

    def assign_commands(self) -> None:
        """Assign commands to actuators, and to servos that are missing in the model file.

        Without any actuator in the model file, a position servo is assumed at each joint with a
        command.
        """
        for column, joint, placement in self._signals.place_columns(
            self._select_by_role("command")
        ):
            actuator = self._signals.get_actuator(joint.name)
            if actuator is not None:
                self._assign_command(column, joint, placement, actuator)
            elif self._signals.robot.actuators:
                self._result.leave_out(column, f"no actuator drives {joint.name}")
            else:
                self._assign_undriven(column, joint, placement)

    def _assign_undriven(self, column: LogColumn, joint: Joint, placement: Placement) -> None:
        """Assign a command of a joint in a model without actuators.

        A force or torque becomes a force on the joint, and a position, or an unknown quantity, the
        command of a position servo that is added. Other commands are left out.

        Args:
            column: column of the log.
            joint: joint of the robot.
            placement: reason for assigning the column to its joint.
        """
        quantity = column_guessing.get_commanded_role(column)
        if quantity == "force":
            self._assign_force(column, joint, f"force.{joint.name}", placement)
        elif quantity in (None, "position"):
            name = f"m_{joint.name}"
            signal = self._make_position_signal(column, joint, placement)
            if self._add_signal(self._signals.inputs, f"u.{name}", column, signal):
                self._signals.added_servos[name] = joint
        else:
            self._result.leave_out(
                column, f"commands a {quantity} of {joint.name}, but no actuator has this command"
            )

    def _assign_command(
        self, column: LogColumn, joint: Joint, placement: Placement, actuator: Actuator
    ) -> None:
        """Assign a column as command of an actuator, or report that the quantity is wrong.

        A motor takes a torque or force, a servo a position or velocity. If names and unit do not
        show the quantity of the column, it is the one that the actuator takes; but a column for a
        motor that is close to the recorded position is a desired position.

        Args:
            column: column of the log.
            joint: joint of the robot.
            placement: reason for assigning the column to its joint.
            actuator: actuator that receives the command.
        """
        quantity = column_guessing.get_commanded_role(column)
        expected = COMMAND_QUANTITIES.get(actuator.kind)
        if (
            actuator.kind == "motor"
            and quantity is None
            and self._resembles_position(column, joint)
        ):
            quantity = "position"
        name = f"u.{actuator.name}"
        if expected is not None and quantity is not None and quantity != expected:
            words = {"force": "torque"} if joint.kind == "hinge" else {}
            self._result.leave_out(
                column,
                f"is a desired {words.get(quantity, quantity)} of {joint.name}, and "
                f"{actuator.name} takes a {words.get(expected, expected)}",
            )
        elif actuator.kind == "motor":
            self._assign_force(column, joint, name, placement)
        elif actuator.kind == "position":
            signal = self._make_position_signal(column, joint, placement)
            self._add_signal(self._signals.inputs, name, column, signal)
        else:  # a velocity servo
            si_unit = f"{joint.unit}/s"
            unit = column.unit if is_convertible(column.unit, si_unit) else si_unit
            signal = Signal(column, unit, placement, f"; in {unit}")
            self._add_signal(self._signals.inputs, name, column, signal)

    def _resembles_position(self, column: LogColumn, joint: Joint) -> bool:
        """Return whether a command is close to the joint's position, and so a desired position.

        Args:
            column: column of the command.
            joint: joint that it may drive.
        """
        position = self._signals.get_position(joint.name)
        if position is None:
            return False
        u, q = self._logs.hold_command(column, position.column)
        finite = np.isfinite(u) & np.isfinite(q)
        u, q = u[finite], q[finite]
        if u.size < 3 or np.ptp(u) == 0 or np.ptp(q) == 0:
            return False
        # A torque may also correlate with a position, but does not share its mean and size.
        distance = compute_rms(u - q)
        return bool(
            np.corrcoef(u, q)[0, 1] > MIN_FOLLOWING_CORRELATION
            and distance < MAX_FOLLOWING_DISTANCE * float(np.std(q))
        )

    def _assign_force(
        self, column: LogColumn, joint: Joint, name: str, placement: Placement, origin: str = ""
    ) -> None:
        """Assign a column to an input that is a torque or force, unless its unit is wrong.

        Args:
            column: column of the log.
            joint: joint on which it acts.
            name: name of the input: that of a motor, or a force on the joint.
            placement: reason for the joint.
            origin: text of a message, why a measured column is used as an input; empty for a
                command.
        """
        unit = column.unit or joint.force_unit
        if not is_convertible(unit, joint.force_unit):
            self._result.leave_out(column, f"is in {unit}, expected {joint.force_unit}")
            return
        unit_origin = "as its file states" if column.unit else "which no file states"
        signal = Signal(column, unit, placement, f"{origin}; in {unit}, {unit_origin}")
        self._add_signal(self._signals.inputs, name, column, signal)

    def assign_efforts(self) -> None:
        """Assign measured torques to motors without a command and to undriven joints.

        A motor exerts its command, so its measured torque can replace a command that was not
        recorded. In a model without actuators, the torque is a force on the joint. If several
        columns fit one input, the only measured one is taken; if none or several are measured, no
        column is taken.
        """
        signals = self._signals
        columns = [column for column in self._select_by_role("force") if _is_torque(column)]
        torques: dict[str, list[PlacedColumn]] = {}
        for placed in signals.place_columns(columns):
            joint = placed.joint
            actuator = signals.get_actuator(joint.name)
            if actuator is not None and actuator.kind == "motor":
                name = f"u.{actuator.name}"
            elif not signals.robot.actuators and f"m_{joint.name}" not in signals.added_servos:
                name = f"force.{joint.name}"
            else:
                continue
            if name not in signals.inputs:
                torques.setdefault(name, []).append(placed)
        for name, candidates in torques.items():
            if len(candidates) > 1:
                # A log may also contain a controller's desired torque and a friction estimate.
                candidates = [c for c in candidates if column_guessing.is_measured(c.column)]
            if len(candidates) != 1:
                continue
            # One candidate is left.
            ((column, joint, placement),) = candidates
            origin = ", measured, because no column has its command"
            self._assign_force(column, joint, name, placement, origin)

    # -- other columns

    def find_switches(self) -> None:
        """Find the columns of zeros and ones that change: one may say when a drive is on.

        They become extra columns of the recording.
        """
        for column in self._select_by_role("other", "command"):
            if self._is_used(column) or self._result.is_left_out(column):
                continue
            # The column has the values of the first run.
            values = np.concatenate([column.values, *self._logs.read_runs(column)[1:]])
            if set(np.unique(values[np.isfinite(values)]).tolist()) == {0.0, 1.0}:
                self._signals.switches.append(column)
                self._result.guessed.append(
                    f"extra: {column.file}, column {column.name}, zeros and ones; if it shows when "
                    f'a drive is on, add [actuators.NAME] enable = "{column.name}"'
                )

    def report_missing_inputs(self) -> None:
        """Report actuators without a command column, and columns that may be the command.

        A model without actuators and without inputs is reported, too. Nothing is reported if every
        actuator has a command.
        """
        signals = self._signals
        # Actuators without a command column.
        undriven_actuators = [
            a for a in signals.robot.actuators if f"u.{a.name}" not in signals.inputs
        ]
        if not undriven_actuators and (signals.inputs or signals.robot.actuators):
            return
        # First the case of a model without actuators and inputs, then that of missing commands.
        text = "the model has no input, so no actuator drives it"
        table = f"force.{signals.joints[0].name}"
        if undriven_actuators:
            names = ", ".join(actuator.name for actuator in undriven_actuators[:MAX_NAMES])
            text = f"actuators without an input: {names}; their commands are assumed to be 0"
            table = f"u.{undriven_actuators[0].name}"
        candidates = [
            c.name for c in self._select_by_role("command", "force") if not self._is_used(c)
        ]
        candidates_text = f"possible columns: {', '.join(candidates[:6])}; " if candidates else ""
        self._result.checks.append(
            f'{text}; {candidates_text}add [inputs."{table}"] with file, column and unit'
        )

    def report_unused(self) -> None:
        """Report the columns that were neither used nor mentioned before.

        Joints without a position column are reported, too.
        """
        for column in self._logs.columns:
            if self._is_used(column) or self._result.is_left_out(column):
                continue
            reason = "its meaning is unknown"
            if column_guessing.guess_role(column) == "force":
                reason = "its unit is unknown"
                if column.unit:
                    reason = f"is in {column.unit}; no input of the model takes it"
            self._result.leave_out(column, reason)
        missing = [
            joint.name
            for joint in self._signals.joints
            if self._signals.get_position(joint.name) is None
        ]
        if missing:
            self._result.untold.append(f"joints without a position: {', '.join(missing)}")

    def _is_used(self, column: LogColumn) -> bool:
        """Return whether a column is a signal or a switch."""
        signals = (*self._signals.channels.values(), *self._signals.inputs.values())
        used_columns = [signal.column for signal in signals] + self._signals.switches
        return (column.file, column.name) in {(c.file, c.name) for c in used_columns}


def _is_torque(column: LogColumn) -> bool:
    """Return whether a measured column is a torque or force rather than a current or a load."""
    if column.unit:
        return column.quantity in ("torque", "force")
    vague = {"current", "currents", "load", "loads", "strom"}
    words = set(column_guessing.split_name(column.bare))
    return bool(words & (column_guessing.ROLE_KEYWORDS["force"] - vague))
