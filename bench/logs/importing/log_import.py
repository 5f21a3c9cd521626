"""Write a recording description for raw logs (`simgap import`), with every guess marked."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from bench.core.options import option
from bench.logs.importing import column_guessing
from bench.logs.importing.column_guessing import LogColumn
from bench.logs.importing.joint_order import follow, order_of_commands
from bench.logs.importing.joint_order_by_model import preferred_order
from bench.logs.importing.log_runs import RunFiles, runs_of
from bench.logs.importing.normalised_positions import (
    LARGEST,
    REMEDY,
    NormalisedPositions,
    is_lerobot,
    normalised_positions,
)
from bench.logs.importing.servo_estimation import ServoResponse, estimate_servo_response
from bench.logs.inspection import load_recording
from bench.logs.quality import velocity_consistency
from sims.core.argument_checks import Name, Names
from sims.core.simulator import Array, InputError
from sims.core.toml_validation import check_known_names, toml_key, toml_text
from sims.recording.log_formats.log_files import LogFile, read_log
from sims.recording.recording import Run
from sims.recording.recording_writer import write_files
from sims.recording.unit_conversion import compute_unit_scale
from sims.robot.places.typical_forces import compute_joint_scales
from sims.robot.robot_model import Actuator, Joint, RobotModel

QUICK, DAMPED = 20.0, 0.7
"""Natural frequency in rad/s and damping ratio of a servo whose gains are unknown."""
_GAINS = "actuator.stiffness", "actuator.damping"
"""Free numbers of a servo that is missing in the model file."""
_BY_COMMANDS = "in the order in which positions follow their commands"
"""Reason for assigning a numbered column to another joint than the model's order gives."""
_BY_MODEL = "in the order in which the model explains the motion best"
"""Reason for assigning unnamed columns to other joints than the model's order gives."""
POSITION_UNITS = ("rad", "deg", "normalised")
"""Units of positions that a user may state; normalised positions are those of LeRobot."""
_BY_ORDER = "by the model's order of joints"
"""Reason for assigning a numbered column to its joint."""
FOLLOWS = 0.9
"""Minimum correlation of a motor's command with a position that makes it a desired position."""
MOST_RUNS = 8
"""Maximum number of runs in which the largest position is searched."""
MOST_NAMES = 12
"""Maximum number of names in a line."""


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Information about logs that the user states.

    Attributes:
        held_out: Names of the runs that are held out (default: every third one).
        rate: Rate of the rows in Hz, if the logs have no time stamps.
        position_unit: Unit of positions and their commands for which none is stated: rad, deg, or
            normalised (-100 to 100 of LeRobot) (default: derived from the joints' ranges).
        calibration: Calibration file of LeRobot, by which normalised positions become angles
            (default: the one in the folder of the dataset).
    """

    held_out: Names = ()
    rate: float | None = option(None, "HZ")
    position_unit: Name = option("", "UNIT")
    calibration: str | Path | None = None


@dataclass
class ImportResult:
    """Description of logs, with its guesses and warnings.

    Attributes:
        text: The description in TOML.
        guessed: Guesses, one line each.
        untold: Columns, files and stamps that were left out and why, one line each.
        checks: What the user must check before using the description, one line each.
    """

    text: str
    guessed: list[str] = field(default_factory=list)
    untold: list[str] = field(default_factory=list)
    checks: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Signal:
    """The column of a channel or an input.

    Attributes:
        column: Column of the log.
        unit: Unit of its numbers, after scale and offset.
        why: Reason for the assignment.
        scale: Factor by which its numbers are multiplied.
        offset: Offset that is added after that.
    """

    column: LogColumn
    unit: str
    why: str
    scale: float = 1.0
    offset: float = 0.0

    def si(self, unit: str, values: Array) -> Array:
        """Convert numbers of the column to an SI unit.

        Args:
            unit: SI unit of the result.
            values: (T,) numbers of the column.
        """
        own = compute_unit_scale(self.unit, unit)
        converted: Array = own.gain * (self.scale * values + self.offset) + own.offset
        return converted


def describe_logs(
    logs: Sequence[Path],
    robot: RobotModel,
    model: Path,
    beside: Path,
    options: ImportOptions | None = None,
) -> ImportResult:
    """Describe logs of a robot.

    Args:
        logs: Files of one run, folders with the files of one run each, or datasets of LeRobot.
        robot: Robot that was recorded.
        model: Its model file.
        beside: Folder in which the description will be written.
        options: Information that the user states.

    Raises:
        InputError: A log cannot be read, no column is a joint's position, or a run is unknown.
    """
    options = options or ImportOptions()
    check_known_names(
        "position unit", [options.position_unit] * bool(options.position_unit), POSITION_UNITS
    )
    if options.rate is not None and not 0 < options.rate < np.inf:
        raise InputError(f"rate {options.rate:g}: expected a number of rows a second, more than 0")
    runs = runs_of(logs)
    check_known_names("run held out", options.held_out, [name for name in runs if name])
    return _DescriptionBuilder(robot, model, beside, runs, options).made()


def write_checked_description(path: Path, text: str) -> None:
    """Write a description and read the recording; delete the description if that fails.

    Args:
        path: Path of the description.
        text: Its content.

    Raises:
        InputError: It cannot be written, or read.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    write_files({path: text})
    try:
        load_recording(path)
    except BaseException:
        path.unlink()
        raise


class _DescriptionBuilder:
    def __init__(
        self,
        robot: RobotModel,
        model: Path,
        beside: Path,
        runs: Mapping[str, RunFiles],
        options: ImportOptions,
    ) -> None:
        self.robot, self.model, self.beside = robot, model, beside
        self.runs, self.options = runs, options
        self.joints = [joint for joint in robot.joints if joint.has_one_coordinate]
        self.drives = {a.joint: a for a in robot.actuators if a.joint}
        self.made_of = ImportResult("")
        self.channels: dict[str, Signal] = {}
        self.inputs: dict[str, Signal] = {}
        self.added: dict[str, Joint] = {}
        self.seconds: dict[str, Array] = {}
        self._starts: dict[str, float] = {}
        self.time, self.unit = "", "s"
        self.normalised: NormalisedPositions | None = None
        self._read: dict[Path, LogFile] = {}

    def made(self) -> ImportResult:
        """Build the description."""
        logs = self._logs()
        columns = self._timed(logs)
        self._say_normalised(columns)
        self._positions(columns)
        if not self.channels:
            there = ", ".join(f"{c.file}: {c.name}" for c in columns[:MOST_NAMES])
            raise InputError(
                f"{next(iter(logs.values())).path}: no column is a joint's position by name, "
                f"number or range; there are {there}; write the description by hand"
            )
        self._commands(columns)
        moved = self._order()
        self._rates(columns, moved)
        self._efforts(columns)
        self._say_inputs(columns)
        self._say_rest(columns)
        self.made_of.text = self._text()
        return self.made_of

    # -- files and stamps

    def _logs(self) -> dict[str, LogFile]:
        """Read the logs of the first run, by name; leave out unreadable logs of a folder.

        Raises:
            InputError: A file that the user named cannot be read, or no file can.
        """
        files = next(iter(self.runs.values()))
        logs: dict[str, LogFile] = {}
        faults: list[InputError] = []
        for path in files.paths:
            try:
                log = self._log(path)
                if not log.named:
                    raise self._no_header(log)
            except InputError as error:
                if files.chosen:
                    raise
                faults.append(error)
                self._leave_out(files.name(path), error, path)
                continue
            logs[files.name(path)] = log
        if not logs:
            raise faults[0]
        return logs

    def _no_header(self, log: LogFile) -> InputError:
        """Make the error for a table whose first row contains numbers."""
        count = len(log.list_columns())
        names = ["t", *(f"{joint.name}_pos" for joint in self.joints)]
        shown = ",".join(names[:MOST_NAMES])
        return InputError(
            f"{log.path}, row {log.first}: expected a header that names the {count} columns, found "
            f"numbers; put one above, such as {shown},..."
        )

    def _leave_out(self, name: str, error: InputError, path: Path) -> None:
        text = str(error).removeprefix(str(path)).lstrip(",: ")
        self.made_of.untold.append(f"{name}: {text}; left out")

    def _timed(self, logs: dict[str, LogFile]) -> list[LogColumn]:
        """Return the columns of all files whose time stamps have a common name and unit.

        The columns of time stamps are not included.
        """
        if self.options.rate is not None:
            return self._at_rate(logs, self.options.rate)
        clocks = self._clocks(logs)
        names = [{column.name for column, _ in own} for own in clocks.values()]
        # Prefer a name that all files share: the stamp in a message's header over its time of
        # arrival.
        common = set.intersection(*names) if names else set()
        chosen = {
            file: next((pair for pair in own if pair[0].name in common), own[0])
            for file, own in clocks.items()
        }
        counts: dict[tuple[str, str], int] = {}
        for file, (column, unit) in chosen.items():
            known_ = [c for c in self._columns(file, logs[file]) if column_guessing.guess_role(c)]
            key = column.name, unit
            counts[key] = counts.get(key, 0) + len(known_)
        self.time, self.unit = max(counts, key=lambda key: counts[key])
        zero = min(float(column.values[0]) for column, _ in chosen.values())
        for file, (column, unit) in chosen.items():
            if (column.name, unit) != (self.time, self.unit):
                self._other_clock(file, logs[file], f"{column.name} ({unit})")
                continue
            # Robot clocks often count from 1970, and floats of that size resolve fractions of a
            # second coarsely, so the first stamp is subtracted before scaling.
            own = column.values - column.values[0]
            self.seconds[file] = column_guessing.TIME_UNITS[unit] * own
            self._starts[file] = column_guessing.TIME_UNITS[unit] * float(column.values[0] - zero)
            repeated = int((np.diff(own) == 0).sum())
            if repeated:
                self.made_of.untold.append(
                    f"{file}: {repeated} of {own.size} stamps repeat the one before; their rows "
                    "are left out"
                )
        steps = np.diff(next(iter(self.seconds.values())))
        rate = 1.0 / float(np.median(steps[steps > 0]))
        self.made_of.guessed.append(f"time: column {self.time} in {self.unit}, {rate:.4g} Hz")
        return self._with_numbers(logs)

    def _at_rate(self, logs: dict[str, LogFile], rate: float) -> list[LogColumn]:
        """Return the columns of all files whose rows have the rate that the user states."""
        for file, log in logs.items():
            count = max(log.get_column(name).size for name in log.list_columns())
            self.seconds[file] = np.arange(count) / rate
            self._starts[file] = 0.0
        return self._with_numbers(logs)

    def _clocks(self, logs: dict[str, LogFile]) -> dict[str, list[tuple[LogColumn, str]]]:
        """Return for each file the columns that may be its time stamps, with their units.

        Raises:
            InputError: A file that the user named has no such column, or no file has one.
        """
        found: dict[str, list[tuple[LogColumn, str]]] = {}
        faults: list[InputError] = []
        for file, log in logs.items():
            columns = column_guessing.clocks(self._columns(file, log))
            units = [(column, self._unit_of_time(column)) for column in columns]
            own = [(column, unit) for column, unit in units if unit is not None]
            if own:
                found[file] = own
                continue
            if columns:
                steps = np.diff(columns[0].values)
                interval = float(np.median(steps[steps > 0]))
                error = InputError(
                    f"{log.path}, column {columns[0].name}: stamps {interval:g} apart are no log's "
                    "in s, ms, us or ns"
                )
            else:
                error = InputError(
                    f"{log.path}: no column increases from row to row; expected one of stamps; "
                    "state the rate of the rows with --rate HZ if there is none"
                )
            if next(iter(self.runs.values())).chosen:
                raise error
            faults.append(error)
            self._leave_out(file, error, log.path)
        if not found:
            raise faults[0]
        return found

    @staticmethod
    def _unit_of_time(column: LogColumn) -> str | None:
        """Return the unit of time stamps: as in the file, else the one with a plausible rate."""
        if column.quantity == "time" and column.unit in column_guessing.TIME_UNITS:
            return column.unit
        return column_guessing.guess_time_unit(column.values)

    def _other_clock(self, file: str, log: LogFile, clock: str) -> None:
        """Leave out a file whose time stamps have another name or unit than the other files.

        Raises:
            InputError: The user named the file.
        """
        error = InputError(
            f"{log.path}: its stamps are called {clock}, those of the files before "
            f"{self.time} ({self.unit}); give them one name"
        )
        if next(iter(self.runs.values())).chosen:
            raise error
        self._leave_out(file, error, log.path)

    @staticmethod
    def _columns(file: str, log: LogFile) -> list[LogColumn]:
        """Return all numeric columns of a log."""
        columns = []
        for name in log.list_columns():
            values = log.get_column(name)
            finite = np.where(np.isfinite(values), values, np.nan)
            columns.append(LogColumn(file, name, finite, log.units.get(name, "")))
        return columns

    def _with_numbers(self, logs: dict[str, LogFile]) -> list[LogColumn]:
        """Return the columns that have one number for each time stamp of their file."""
        columns = []
        for file, seconds in self.seconds.items():
            for column in self._columns(file, logs[file]):
                if column.name == self.time:
                    continue
                if column.values.size != seconds.size:
                    self._untold(column, f"has {column.values.size} numbers, not {seconds.size}")
                elif np.isnan(column.values).all():
                    self._untold(column, "has no number")
                else:
                    columns.append(column)
        return columns

    # -- columns

    def _by_joint(self, columns: Sequence[LogColumn]) -> list[tuple[LogColumn, Joint, str]]:
        """Return columns of one kind with their joints and the reasons for the assignment."""
        found = []
        plain = []
        for column in columns:
            joint = column_guessing.match_joint(column, self.joints)
            if joint is not None:
                found.append((column, joint, "by its name"))
            else:
                plain.append(column)
        groups: dict[tuple[str, str], list[LogColumn]] = {}
        for column in plain:
            groups.setdefault((column.file, column.bare.rstrip("0123456789[]")), []).append(column)
        for group in groups.values():
            numbered = column_guessing.match_numbered_joints(group, self.joints)
            for column in group:
                if column.name in numbered:
                    found.append((column, numbered[column.name], _BY_ORDER))
        return found

    def _say_normalised(self, columns: Sequence[LogColumn]) -> None:
        """Decide whether positions are normalised, and report if it cannot be decided."""
        mine = [
            c for c in columns if column_guessing.guess_role(c) in ("position", None) and not c.unit
        ]
        placed = [(c, j) for c, j, _ in self._by_joint(mine)]
        if not placed:
            return
        path = next(iter(self.runs.values())).paths[0]
        # An episode has one log; other runs may contain larger positions than the first.
        largest = max(self._largest(c) for c, _ in placed)
        options = self.options
        calibration = None if options.calibration is None else Path(options.calibration)
        self.normalised = normalised_positions(path, largest, options.position_unit, calibration)
        if self.normalised is not None:
            self.made_of.guessed.append(f"positions: {self.normalised.description}")
        elif (
            not options.position_unit
            and largest <= LARGEST
            and is_lerobot(path, (c.name for c, _ in placed))
            and any(
                column_guessing.guess_position_unit(c.values, j) in ("deg", None) for c, j in placed
            )
        ):
            self.made_of.checks.append(
                "positions lie within -100 to 100: they are taken for degrees and may be LeRobot's "
                f"normalised positions; {REMEDY}"
            )

    def _largest(self, column: LogColumn) -> float:
        """Return the largest magnitude of a column in the first runs."""
        values = [float(np.nanmax(np.abs(column.values)))]
        for run in list(self.runs)[1:MOST_RUNS]:
            paths = [p for p in self.runs[run].paths if self.runs[run].name(p) == column.file]
            if paths and column.name in (log := self._log(paths[0])).list_columns():
                values.append(float(np.nanmax(np.abs(log.get_column(column.name)), initial=0.0)))
        return max(values)

    def _position_signal(self, column: LogColumn, joint: Joint, why: str) -> Signal | None:
        """Assign the unit of a position or position command, as stated or by the joint's range."""
        if column.unit:
            if not _converts(column.unit, joint.unit):
                what = "expected an angle" if joint.kind == "hinge" else "expected a length"
                remedy = "state unit, scale and offset in the description by hand"
                self._untold(column, f"is in {column.unit}, {what}; {remedy}")
                return None
            by = "the row of units" if column.units_row else "its name"
            return Signal(column, column.unit, f"{why}; in {column.unit} by {by}")
        if self.normalised is not None:
            found = self.normalised.scale_of(column.name, column.values, joint)
            if found is None:
                self._untold(column, f"is normalised, and nothing says the range of {joint.name}")
                return None
            unit, (gain, offset) = found
            return Signal(column, unit, f"{why}; normalised", gain, offset)
        if self.options.position_unit and joint.kind == "hinge":
            unit = self.options.position_unit
            return Signal(column, unit, f"{why}; in {unit} as the user states")
        told = column_guessing.guess_position_unit(column.values, joint)
        if told is None:
            low, high = joint.range or (-np.inf, np.inf)
            ends = f"{np.nanmin(column.values):.4g} to {np.nanmax(column.values):.4g}"
            self._untold(column, f"goes from {ends}, {joint.name} from {low:.4g} to {high:.4g}")
            return None
        return Signal(column, told, f"{why}; in {told} by its range")

    def _positions(self, columns: Sequence[LogColumn]) -> None:
        mine = [c for c in columns if column_guessing.guess_role(c) in ("position", None)]
        for column, joint, why in self._by_joint(mine):
            name = f"q.{joint.name}"
            if name in self.channels:
                self._untold(column, f"{name} is {self.channels[name].column.name} already")
                continue
            signal = self._position_signal(column, joint, why)
            if signal is not None:
                self.channels[name] = signal

    def _commands(self, columns: Sequence[LogColumn]) -> None:
        mine = [c for c in columns if column_guessing.guess_role(c) == "command"]
        for column, joint, why in self._by_joint(mine):
            own = self.drives.get(joint.name)
            if own is None and self.robot.actuators:
                self._untold(column, f"no actuator drives {joint.name}")
            elif own is None:
                self._command_of_none(column, joint, why)
            else:
                self._command(column, joint, why, own)

    def _command_of_none(self, column: LogColumn, joint: Joint, why: str) -> None:
        """Add a command of a joint that the model does not drive: a servo command or a force."""
        asks = column_guessing.commanded_role(column)
        if asks == "force":
            self._force(column, joint, f"force.{joint.name}", why)
        elif asks in (None, "position"):
            name = f"m_{joint.name}"
            signal = self._new_input(f"u.{name}", column, joint, why)
            if signal is not None:
                self.added[name] = joint
        else:
            self._untold(column, f"asks for a {asks} of {joint.name}, which no actuator takes")

    def _command(self, column: LogColumn, joint: Joint, why: str, own: Actuator) -> None:
        """Add the command of an actuator if its quantity is the one that the actuator takes."""
        asks = column_guessing.commanded_role(column)
        takes = {"motor": "force", "position": "position", "velocity": "velocity"}.get(own.kind)
        if own.kind == "motor" and asks is None and self._follows(column, joint):
            asks = "position"
        if takes is not None and asks is not None and asks != takes:
            words = {"force": "torque" if joint.kind == "hinge" else "force"}
            asked, taken = words.get(asks, asks), words.get(takes, takes)
            self._untold(
                column, f"is a desired {asked} of {joint.name}, and {own.name} takes a {taken}"
            )
        elif own.kind == "motor":
            self._force(column, joint, f"u.{own.name}", why)
        elif own.kind == "position":
            self._new_input(f"u.{own.name}", column, joint, why)
        else:
            unit = column.unit if _converts(column.unit, f"{joint.unit}/s") else f"{joint.unit}/s"
            self._take(f"u.{own.name}", Signal(column, unit, f"{why}; in {unit}"))

    def _follows(self, column: LogColumn, joint: Joint) -> bool:
        """Return whether a command resembles its joint's position, as a desired position does."""
        there = self.channels.get(f"q.{joint.name}")
        if there is None:
            return False
        u, q = self._held(column, there.column)
        seen = np.isfinite(u) & np.isfinite(q)
        u, q = u[seen], q[seen]
        if u.size < 3 or np.ptp(u) == 0 or np.ptp(q) == 0:
            return False
        # A torque may also correlate with a position, but does not share its mean and size.
        apart = float(np.sqrt(np.mean((u - q) ** 2)))
        return bool(np.corrcoef(u, q)[0, 1] > FOLLOWS and apart < 0.5 * float(np.std(q)))

    def _force(self, column: LogColumn, joint: Joint, name: str, why: str) -> None:
        """Add the torque of a motor, or a force along a joint."""
        unit = column.unit or joint.force_unit
        if not _converts(unit, joint.force_unit):
            self._untold(column, f"is in {unit}, expected {joint.force_unit}")
            return
        by = "as its file states" if column.unit else "which no file states"
        self._take(name, Signal(column, unit, f"{why}; in {unit}, {by}"))

    def _new_input(self, name: str, column: LogColumn, joint: Joint, why: str) -> Signal | None:
        """Add the command of a position servo."""
        if name in self.inputs:
            self._untold(column, f"{name} is {self.inputs[name].column.name} already")
            return None
        signal = self._position_signal(column, joint, why)
        if signal is not None:
            self.inputs[name] = signal
        return signal

    def _take(self, name: str, signal: Signal) -> None:
        """Add an input unless one with this name exists."""
        if name in self.inputs:
            self._untold(signal.column, f"{name} is {self.inputs[name].column.name} already")
        else:
            self.inputs[name] = signal

    # -- order of joints

    def _order(self) -> dict[str, str]:
        """Check each position against its command if the order of joints is a guess.

        Returns:
            For each joint, the joint at whose index its column is, if positions were exchanged.
        """
        servos = {
            joint.name: name
            for joint in self.joints
            for name in (self._servo(joint),)
            if name in self.inputs and f"q.{joint.name}" in self.channels
        }
        joints = list(servos)
        commands = [self.inputs[servos[joint]] for joint in joints]
        positions = [self.channels[f"q.{joint}"] for joint in joints]
        guessed = [_BY_ORDER in s.why for s in commands], [_BY_ORDER in s.why for s in positions]
        if len(joints) > 1 and (any(guessed[0]) or any(guessed[1])):
            held = [
                self._held(command.column, position.column)
                for command, position in zip(commands, positions, strict=True)
            ]
            # Positions of one file share their sample times; those of several files may not.
            if len({u.size for u, _ in held}) == 1:
                units = [self.robot.joint(joint).unit for joint in joints]
                u = [c.si(unit, v) for c, unit, (v, _) in zip(commands, units, held, strict=True)]
                q = [c.si(unit, v) for c, unit, (_, v) in zip(positions, units, held, strict=True)]
                moved = self._reorder(joints, servos, guessed, u, q)
                follows = follow(u, q) or bool(moved)
                if all(guessed[0]) and all(guessed[1]) and follows and not moved:
                    preferred = self._prefer(joints, servos, u, q)
                    if preferred:
                        return preferred
                self._say_order(joints, follows)
                return moved if all(guessed[1]) and not all(guessed[0]) else {}
        self._say_order(joints, False)
        return {}

    def _servo(self, joint: Joint) -> str:
        """Return the input of a joint's position servo; empty if it has none."""
        own = self.drives.get(joint.name)
        if own is not None:
            return f"u.{own.name}" if own.kind == "position" else ""
        return f"u.m_{joint.name}" if f"m_{joint.name}" in self.added else ""

    def _reorder(
        self,
        joints: Sequence[str],
        servos: Mapping[str, str],
        guessed: tuple[Sequence[bool], Sequence[bool]],
        commands: Sequence[Array],
        positions: Sequence[Array],
    ) -> dict[str, str]:
        """Exchange columns whose order is a guess if positions then follow the commands better."""
        order = order_of_commands(commands, positions)
        if order is None or not (all(guessed[0]) or all(guessed[1])):
            return {}
        why = _BY_COMMANDS
        if all(guessed[0]):
            own = {joint: self.inputs[servos[joint]] for joint in joints}
            for place, joint in zip(order, joints, strict=True):
                signal = own[joint]
                told = signal.why.replace(_BY_ORDER, why)
                self.inputs[servos[joints[place]]] = replace(signal, why=told)
        else:
            own = {joint: self.channels[f"q.{joint}"] for joint in joints}
            for place, joint in zip(order, joints, strict=True):
                signal = own[joints[place]]
                told = signal.why.replace(_BY_ORDER, why)
                self.channels[f"q.{joint}"] = replace(signal, why=told)
        return {joint: joints[place] for place, joint in zip(order, joints, strict=True)}

    def _prefer(
        self,
        joints: Sequence[str],
        servos: Mapping[str, str],
        commands: Sequence[Array],
        positions: Sequence[Array],
    ) -> dict[str, str]:
        """Exchange unnamed columns if the model then explains the motion far better.

        Returns:
            For each joint, the joint at whose index its column is; empty if the order is not
                changed.
        """
        drives = [self.drives.get(joint) for joint in joints]
        driven = [
            (self.robot.joint(joint), drive)
            for joint, drive in zip(joints, drives, strict=True)
            if drive is not None
        ]
        # Unknown gains explain nothing, and normalised numbers belong to their joints.
        if len(driven) < len(joints) or self.normalised is not None:
            return {}
        if all(map(self._has_its_number, joints)):
            return {}
        seconds = self.seconds[self.channels[f"q.{joints[0]}"].column.file]
        told = preferred_order(self.robot, driven, seconds, commands, positions)
        if told is None or not told.is_certain():
            return {}
        own = {joint: (self.channels[f"q.{joint}"], self.inputs[servos[joint]]) for joint in joints}
        moved = {joint: joints[place] for joint, place in zip(joints, told.order, strict=True)}
        for joint, other in moved.items():
            for table, name, signal in zip(
                (self.channels, self.inputs), (f"q.{joint}", servos[joint]), own[other], strict=True
            ):
                table[name] = replace(signal, why=signal.why.replace(_BY_ORDER, _BY_MODEL))
        columns = sorted(joints, key=lambda joint: told.order[joints.index(joint)])
        self.made_of.checks.append(
            "order of joints: the log does not name those of its columns; they are taken in the "
            f"order {', '.join(columns)}, in which the model explains the motion best (a residual "
            f"of {told.residual:.2g} of the drives' forces, {told.usual:.2g} in the model's order, "
            f"{', '.join(joints)}); it is a guess: compare it with the logger's order"
        )
        return moved

    def _say_order(self, joints: Sequence[str], follows: bool) -> None:
        """Report which positions follow their commands, and which joint orders are a guess.

        Args:
            joints: Joints with a servo, a command and a position.
            follows: Whether each of these positions follows the command of its own joint.
        """
        guessed: dict[str, set[str]] = {}
        for table in (self.channels, self.inputs):
            for name, signal in table.items():
                if _BY_ORDER not in signal.why and _BY_COMMANDS not in signal.why:
                    continue
                if follows and _BY_ORDER in signal.why and self._driven(name) in joints:
                    told = signal.why.replace(_BY_ORDER, f"{_BY_ORDER} (each follows its command)")
                    table[name] = replace(signal, why=told)
                guessed.setdefault(name.partition(".")[0], set()).add(self._driven(name))
        positions, commands = guessed.get("q", set()), guessed.get("u", set())
        # A position that follows a named command, and a command that a named position follows, are
        # certain.
        if follows and not (positions & commands):
            return
        doubted = positions | commands
        named = [joint.name for joint in self.joints if joint.name in doubted]
        if len(named) < 2 or all(map(self._has_its_number, named)):
            return
        model, alphabet = ", ".join(named[:MOST_NAMES]), ", ".join(sorted(named)[:MOST_NAMES])
        other = f" (sorted by name, as ROS drivers have it, they would be {alphabet})"
        what = "columns" if positions else "commands"
        self.made_of.checks.append(
            f"order of joints: the log does not name those of its {what}; they are taken in the "
            f"model's order, {model}, which is a guess{other if model != alphabet else ''}; if "
            "another order is right, exchange the `column` lines"
        )

    def _driven(self, signal: str) -> str:
        """Return the joint of a channel or an input; the signal's own name if it has none."""
        name = signal.partition(".")[2]
        own = next((a.joint for a in self.robot.actuators if a.name == name), None)
        added = self.added.get(name)
        return own or (added.name if added is not None else name)

    def _has_its_number(self, joint: str) -> bool:
        """Return whether the number in the column's name equals the number in the joint's name."""
        own, column = (
            [int(digits) for digits in re.findall(r"\d+", text)]
            for text in (joint, self._column_of(joint))
        )
        return bool(own and column and own[-1] == column[-1])

    def _column_of(self, joint: str) -> str:
        """Return the column name of a joint's position, or else of its command."""
        position = self.channels.get(f"q.{joint}")
        if position is not None and _BY_ORDER in position.why:
            return position.column.bare
        own = (s for name, s in self.inputs.items() if self._driven(name) == joint)
        return next((signal.column.bare for signal in own), "")

    def _held(self, command: LogColumn, position: LogColumn) -> tuple[Array, Array]:
        """Return (T,) a command at the times of a position (zero-order hold), and that position."""
        u, q = self.seconds[command.file], self.seconds[position.file]
        if command.file == position.file:
            return command.values, position.values
        offset = self._starts[command.file] - self._starts[position.file]
        places = np.searchsorted(u + offset, q, side="right") - 1
        return command.values[np.clip(places, 0, u.size - 1)], position.values

    # -- velocities and forces

    def _rates(self, columns: Sequence[LogColumn], moved: Mapping[str, str]) -> None:
        mine = [c for c in columns if column_guessing.guess_role(c) == "velocity"]
        placed = self._by_joint(mine)
        by_place = {joint.name: column for column, joint, why in placed if why == _BY_ORDER}
        for own, joint, told in placed:
            column, why = own, told
            if why == _BY_ORDER and joint.name in moved:
                column = by_place.get(moved[joint.name], own)
                why = "in the order of the positions"
            position = self.channels.get(f"q.{joint.name}")
            if column_guessing.is_constant(column.values):
                self._untold(column, "never changes")
            elif position is None or position.column.file != column.file:
                self._untold(column, f"no position of {joint.name} beside it tells its unit")
            elif f"qd.{joint.name}" in self.channels:
                there = self.channels[f"qd.{joint.name}"].column.name
                self._untold(column, f"qd.{joint.name} is {there} already")
            else:
                self._rate(column, joint, why, position)

    def _rate(self, column: LogColumn, joint: Joint, why: str, position: Signal) -> None:
        """Add a velocity if it is the derivative of its position and does not lag it."""
        name, seconds = position.column.name, self.seconds[column.file]
        stated = column.unit if _converts(column.unit, f"{joint.unit}/s") else ""
        first = np.diff(seconds, prepend=-np.inf) > 0
        angles = position.si(joint.unit, position.column.values)
        slope = np.gradient(angles[first], seconds[first])
        unit = column_guessing.guess_velocity_unit(column.values[first], slope, joint, stated)
        if unit is None:
            self._untold(column, f"is not the derivative of {name}")
            return
        shown = {"q": position.column.values[first], "v": column.values[first]}
        late = velocity_consistency.estimate_velocity_delay(
            [Run("", seconds[first], shown, {}, {}, {}, False)], "q", "v"
        )
        if late is not None:
            behind = f"{late.samples:.2g} samples {late.direction_word} the derivative of {name}"
            self._untold(column, f"is {behind}, filtered or stamped at another time")
            return
        if stated and unit != stated:
            self._untold(column, f"is in {stated} by its name and in {unit} by {name}")
            return
        self.channels[f"qd.{joint.name}"] = Signal(
            column, unit, f"{why}; in {unit}, as the derivative of {name}"
        )

    def _efforts(self, columns: Sequence[LogColumn]) -> None:
        """Add measured torques as inputs of motors without a command and of undriven joints."""
        mine = [c for c in columns if column_guessing.guess_role(c) == "force" and _is_torque(c)]
        torques: dict[str, list[tuple[LogColumn, Joint, str]]] = {}
        for column, joint, why in self._by_joint(mine):
            own = self.drives.get(joint.name)
            if own is not None and own.kind == "motor":
                name = f"u.{own.name}"
            elif own is None and f"m_{joint.name}" not in self.added and not self.robot.actuators:
                name = f"force.{joint.name}"
            else:
                continue
            if name not in self.inputs:
                torques.setdefault(name, []).append((column, joint, why))
        for name, found in torques.items():
            measured = [one for one in found if column_guessing.is_measured(one[0])]
            # A log may also contain a controller's desired torque and a friction estimate.
            if len(found) > 1 and len(measured) != 1:
                continue
            ((column, joint, why),) = measured if len(found) > 1 else found
            self._force(column, joint, name, f"{why}, measured, as nothing commands it")

    # -- messages

    def _untold(self, column: LogColumn, why: str) -> None:
        self.made_of.untold.append(f"{column.file}, column {column.name}: {why}; left out")

    def _say_inputs(self, columns: Sequence[LogColumn]) -> None:
        """Report which actuators or joints have no input."""
        idle = [a for a in self.robot.actuators if f"u.{a.name}" not in self.inputs]
        if self.inputs and not idle:
            return
        if self.robot.actuators and not idle:
            return
        names = ", ".join(a.name for a in idle[:MOST_NAMES])
        what = "the model has no input, so that nothing drives it"
        if idle:
            what = f"actuators without an input: {names}; their commands are taken for 0"
        used = {(s.column.file, s.column.name) for s in self.inputs.values()}
        perhaps = [
            c.name
            for c in columns
            if column_guessing.guess_role(c) in ("command", "force")
            and (c.file, c.name) not in used
        ]
        columns_ = f"columns that may be it: {', '.join(perhaps[:6])}; " if perhaps else ""
        table = (
            f'[inputs."u.{idle[0].name}"]' if idle else f'[inputs."force.{self.joints[0].name}"]'
        )
        self.made_of.checks.append(f"{what}; {columns_}add {table} with file, column and unit")

    def _say_rest(self, columns: Sequence[LogColumn]) -> None:
        """Report the columns that were neither used nor mentioned before."""
        signals = (*self.channels.values(), *self.inputs.values())
        used = {(s.column.file, s.column.name) for s in signals}
        said = " ".join(self.made_of.untold)
        for column in columns:
            if (column.file, column.name) in used or f"column {column.name}:" in said:
                continue
            force = column_guessing.guess_role(column) == "force" and not column.unit
            why = "its unit cannot be told" if force else "what it is cannot be told"
            if column.unit and column_guessing.guess_role(column) == "force":
                why = f"is in {column.unit}; no input of the model takes it"
            self._untold(column, why)
        missing = [j.name for j in self.joints if f"q.{j.name}" not in self.channels]
        if missing:
            self.made_of.untold.append(f"joints without a position: {', '.join(missing)}")

    def _text(self) -> str:
        lines = [*(f"# check: {line}" for line in self.made_of.checks)]
        lines += [f"model = {toml_text(self._from(self.model))}"]
        if self.added:
            names = ", ".join(toml_text(f"{name}@*") for name in _GAINS)
            lines.append(f"free = [{names}]  # not known: they are estimated")
        lines += ["", "[time]"]
        if self.options.rate is not None:
            lines += [f"rate = {float(self.options.rate)!r}", ""]
        else:
            lines += [
                f"column = {toml_text(self.time)}",
                f"unit = {toml_text(self.unit)}  # guess",
                "",
            ]
        for run, files in self.runs.items():
            if run:
                where = files.paths[0] if files.alone else files.folder
                word = "file" if files.alone else "folder"
                lines += [f"[runs.{toml_key(run)}]", f"{word} = {toml_text(self._from(where))}"]
                lines += [*["held_out = true"] * (run in self.options.held_out), ""]
        for name, joint in self.added.items():
            lines += self._actuator(name, joint)
        for kind, signals in (("channels", self.channels), ("inputs", self.inputs)):
            for name, signal in signals.items():
                lines += self._signal_lines(kind, name, signal)
        return "\n".join(lines).rstrip("\n") + "\n"

    def _signal_lines(self, kind: str, name: str, signal: Signal) -> list[str]:
        """Return the lines of the description for a channel or an input."""
        column = signal.column
        lines = [f"[{kind}.{toml_text(name)}]  # guess: {signal.why}"]
        first = next(iter(self.runs.values()))
        if not first.alone:
            inside = self.runs[""].folder / column.file if "" in self.runs else None
            file = self._from(inside) if inside is not None else column.file
            lines.append(f"file = {toml_text(file)}")
        lines += [f"column = {toml_text(column.name)}", f"unit = {toml_text(signal.unit)}"]
        stated = self.options.position_unit == "deg" and kind == "channels"
        if signal.scale != 1.0 or (stated and name.startswith("q.")):
            lines.append(f"scale = {signal.scale!r}")
        if signal.offset:
            lines.append(f"offset = {signal.offset!r}")
        self.made_of.guessed.append(f"{name}: {column.file}, column {column.name}, {signal.why}")
        return [*lines, ""]

    def _actuator(self, name: str, joint: Joint) -> list[str]:
        """Return the lines of the description for a servo with unknown gains."""
        inertia = compute_joint_scales(self.robot).inertia[self.joints.index(joint)]
        found = self._following(name, joint)
        quick, damped = found or (QUICK, DAMPED)
        kp, kv = inertia * quick**2, 2.0 * damped * quick * inertia
        what = "as it follows its command" if found else "as of any hobby servo"
        self.made_of.guessed.append(
            f"gains of the servo of {joint.name}: of one of {quick:.3g} rad/s and {damped:.2g} of "
            f"critical damping, {what}; free"
        )
        lines = [f"[actuators.{toml_key(name)}]", f"joint = {toml_text(joint.name)}"]
        lines += ['kind = "position"  # guess: its commands are positions']
        return [*lines, f"kp = {kp:.4g}  # guess", f"kv = {kv:.4g}  # guess", ""]

    def _following(self, name: str, joint: Joint) -> ServoResponse | None:
        """Estimate how a joint follows the command of its servo, over all runs."""
        u, q = self.inputs[f"u.{name}"], self.channels.get(f"q.{joint.name}")
        if q is None:
            return None
        shown = []
        for run in self.runs:
            command, position = self._signal(run, u.column), self._signal(run, q.column)
            if command is None or position is None:
                continue
            # A command holds until the next one.
            held = np.searchsorted(command[0], position[0], side="right") - 1
            values = command[1][np.clip(held, 0, command[1].size - 1)]
            shown.append((position[0], u.si(joint.unit, values), q.si(joint.unit, position[1])))
        return estimate_servo_response(shown)

    def _signal(self, run: str, column: LogColumn) -> tuple[Array, Array] | None:
        """Return time stamps in s and values of a column in one run; None if it is missing."""
        files = self.runs[run]
        paths = files.paths
        if not files.alone:
            paths = [path for path in paths if files.name(path) == column.file]
        if not paths:
            return None
        log = self._log(paths[0])
        if column.name not in log.list_columns():
            return None
        values = log.get_column(column.name)
        if self.options.rate is not None:
            return np.arange(values.size) / self.options.rate, values
        if self.time not in log.list_columns():
            return None
        return column_guessing.TIME_UNITS[self.unit] * log.get_column(self.time), values

    def _log(self, path: Path) -> LogFile:
        """Read a log; each file is read only once."""
        if path not in self._read:
            self._read[path] = read_log(path)
        return self._read[path]

    def _from(self, path: Path) -> str:
        try:
            return Path(os.path.relpath(path, self.beside)).as_posix()
        except ValueError:  # on another drive
            return path.resolve().as_posix()


def _is_torque(column: LogColumn) -> bool:
    """Return whether a measured column is a torque or force rather than a current or a load."""
    if column.unit:
        return column.quantity in ("torque", "force")
    vague = {"current", "currents", "load", "loads", "strom"}
    return bool(
        set(column_guessing.split_name(column.bare))
        & (column_guessing.ROLE_KEYWORDS["force"] - vague)
    )


def _converts(unit: str, target: str) -> bool:
    """Return whether a unit converts to another one."""
    try:
        compute_unit_scale(unit, target)
    except InputError:
        return False
    return bool(unit)
