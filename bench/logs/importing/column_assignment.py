"""Assign log columns to positions, commands and measured torques of a robot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

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
from bench.logs.importing.run_logs import RunLogs
from bench.logs.importing.signal_assignment import (
    Placement,
    Signal,
    SignalAssignment,
    is_convertible,
)
from sims.core.simulator import InputError
from sims.robot.robot_model import Actuator, Joint

MIN_FOLLOWING_CORRELATION = 0.9
"""Minimum correlation of a motor's command with a position that makes it a desired position."""
MAX_FOLLOWING_DISTANCE = 0.5
"""Maximum distance (RMS) of such a command from the position, as a share of its deviation."""
COMMAND_QUANTITIES = {"motor": "force", "position": "position", "velocity": "velocity"}
"""Quantity that an actuator takes, by its kind."""


class ColumnAssigner:
    """Assignment of columns to the signals of a robot, with messages.

    Args:
        logs: Logs that are imported.
        signals: Assignment to which signals are added.
        options: Information that the user states.
        result: Result to which messages are added.
    """

    def __init__(
        self,
        logs: RunLogs,
        signals: SignalAssignment,
        options: ImportOptions,
        result: ImportResult,
    ) -> None:
        """Store the inputs; nothing is assigned yet.

        `normalised` is set later if the log has positions as shares of a joint's range.
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
        """Decide whether positions are shares of the joint ranges, as LeRobot records them.

        If it cannot be decided, the user is asked to check.
        """
        assignments = [(column, joint) for column, joint, _ in self._signals.place_columns(columns)]
        if not assignments:
            return
        path, options = self._logs.first_path, self._options
        # An episode has one log; other runs may contain larger positions than the first.
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
        """Determine the unit of a position or a position command.

        The unit is the one that the log states, or the user, or the one that fits the range of the
        joint. Return None, with a message, if there is no such unit.
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
            scale = self.normalised.scale_of(column.name, column.values, joint)
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
        """Add a signal unless one with this name exists; return whether it was added."""
        if name in table:
            self._result.leave_out(column, f"{name} is {table[name].column.name} already")
            return False
        if signal is not None:
            table[name] = signal
        return signal is not None

    # -- commands

    def assign_commands(self) -> None:
        """Assign commands to actuators, and to servos that are missing in the model file."""
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
        """Assign a command of a joint that the model does not drive: a servo or a force."""
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

        A motor takes a torque or force, a servo a position or velocity.
        """
        given_quantity = column_guessing.get_commanded_role(column)
        expected = COMMAND_QUANTITIES.get(actuator.kind)
        if (
            actuator.kind == "motor"
            and given_quantity is None
            and self._resembles_position(column, joint)
        ):
            given_quantity = "position"
        name = f"u.{actuator.name}"
        if expected is not None and given_quantity is not None and given_quantity != expected:
            words = {"force": "torque" if joint.kind == "hinge" else "force"}
            given_words, expected_quantity = (
                words.get(word, word) for word in (given_quantity, expected)
            )
            self._result.leave_out(
                column,
                f"is a desired {given_words} of {joint.name}, and {actuator.name} takes a "
                f"{expected_quantity}",
            )
        elif actuator.kind == "motor":
            self._assign_force(column, joint, name, placement)
        elif actuator.kind == "position":
            signal = self._make_position_signal(column, joint, placement)
            self._add_signal(self._signals.inputs, name, column, signal)
        else:
            si_unit = f"{joint.unit}/s"
            unit = column.unit if is_convertible(column.unit, si_unit) else si_unit
            signal = Signal(column, unit, placement, f"; in {unit}")
            self._add_signal(self._signals.inputs, name, column, signal)

    def _resembles_position(self, column: LogColumn, joint: Joint) -> bool:
        """Return whether a command is close to the position, and so a desired position."""
        position = self._signals.get_position(joint.name)
        if position is None:
            return False
        u, q = self._logs.hold_command(column, position.column)
        finite = np.isfinite(u) & np.isfinite(q)
        u, q = u[finite], q[finite]
        if u.size < 3 or np.ptp(u) == 0 or np.ptp(q) == 0:
            return False
        # A torque may also correlate with a position, but does not share its mean and size.
        distance = float(np.sqrt(np.mean((u - q) ** 2)))
        return bool(
            np.corrcoef(u, q)[0, 1] > MIN_FOLLOWING_CORRELATION
            and distance < MAX_FOLLOWING_DISTANCE * float(np.std(q))
        )

    def _assign_force(
        self, column: LogColumn, joint: Joint, name: str, placement: Placement, origin: str = ""
    ) -> None:
        """Assign the torque of a motor, or a force along a joint."""
        unit = column.unit or joint.force_unit
        if not is_convertible(unit, joint.force_unit):
            self._result.leave_out(column, f"is in {unit}, expected {joint.force_unit}")
            return
        unit_origin = "as its file states" if column.unit else "which no file states"
        signal = Signal(column, unit, placement, f"{origin}; in {unit}, {unit_origin}")
        self._add_signal(self._signals.inputs, name, column, signal)

    def assign_efforts(self) -> None:
        """Assign measured torques to motors without a command and to undriven joints."""
        signals = self._signals
        columns = [column for column in self._select_by_role("force") if _is_torque(column)]
        torques: dict[str, list[tuple[LogColumn, Joint, Placement]]] = {}
        for column, joint, placement in signals.place_columns(columns):
            actuator = signals.get_actuator(joint.name)
            if actuator is not None and actuator.kind == "motor":
                name = f"u.{actuator.name}"
            elif not signals.robot.actuators and f"m_{joint.name}" not in signals.added_servos:
                name = f"force.{joint.name}"
            else:
                continue
            if name not in signals.inputs:
                torques.setdefault(name, []).append((column, joint, placement))
        for name, candidates in torques.items():
            measured = [c for c in candidates if column_guessing.is_measured(c[0])]
            # A log may also contain a controller's desired torque and a friction estimate.
            if len(candidates) > 1 and len(measured) != 1:
                continue
            ((column, joint, placement),) = measured if len(candidates) > 1 else candidates
            origin = ", measured, because no column has its command"
            self._assign_force(column, joint, name, placement, origin)

    # -- other columns

    def find_switches(self) -> None:
        """Keep the columns of zeros and ones that change: one may say when a drive is on."""
        for column in self._select_by_role("other", "command"):
            if self._is_used(column) or self._result.is_left_out(column):
                continue
            values = np.concatenate([column.values, *self._logs.read_runs(column)[1:]])
            if set(np.unique(values[np.isfinite(values)]).tolist()) == {0.0, 1.0}:
                self._signals.switches.append(column)
                self._result.guessed.append(
                    f"extra: {column.file}, column {column.name}, zeros and ones; if it shows when "
                    f'a drive is on, add [actuators.NAME] enable = "{column.name}"'
                )

    def report_missing_inputs(self) -> None:
        """Report actuators without a command column, and columns that may be the command."""
        signals = self._signals
        undriven_actuators = [
            a for a in signals.robot.actuators if f"u.{a.name}" not in signals.inputs
        ]
        if not undriven_actuators and (signals.inputs or signals.robot.actuators):
            return
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
        """Report the columns that were neither used nor mentioned before."""
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
