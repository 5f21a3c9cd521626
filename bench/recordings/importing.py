"""`simgap import`: a description of logs as they lie, every guess in it marked."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.recordings import guess
from bench.recordings.census import rates
from bench.recordings.guess import Column
from bench.recordings.inspection import load
from bench.recordings.servos import Following, following
from sims.base import Array, InputError
from sims.recording.bags import ENDINGS, TIME, is_bag
from sims.recording.lerobot import is_dataset
from sims.recording.logs import Log, logs_in, read_log
from sims.recording.recording import Run
from sims.recording.write import publish
from sims.robot.model import Joint, Robot
from sims.robot.scales import scales
from sims.user_toml import known

QUICK, DAMPED = 20.0, 0.7
"""rad/s and share of critical damping of a servo whose gains nobody has stated or shown."""
TABLES = (".csv", ".tsv", ".npz", ".parquet")
"""Endings of what is taken from a folder; other texts may be anything."""
_GAINS = "actuator.stiffness", "actuator.damping"
"""What nobody has stated of a servo that a model file lacks."""


@dataclass
class Imported:
    """What has been made of logs.

    Attributes:
        text: the description.
        guessed: what was guessed, a line each.
        untold: what could not be told, a line each.
    """

    text: str
    guessed: list[str] = field(default_factory=list)
    untold: list[str] = field(default_factory=list)


def describe(
    logs: Sequence[Path], robot: Robot, model: Path, beside: Path, held_out: Collection[str] = ()
) -> Imported:
    """The description of logs of a robot.

    Args:
        logs: files of one run, folders that each hold those of one, or datasets of LeRobot.
        robot: what they are of.
        model: its model file.
        beside: the folder where the description will stand.
        held_out: runs that no fit is to see.

    Raises:
        InputError: they cannot be read, there is nothing in them that a robot has, or no such run.
    """
    runs = runs_of(logs)
    known("run held out", held_out, [name for name in runs if name])
    files = next(iter(runs.values()))
    read = {files.name(path): read_log(path) for path in files.paths}
    return _Describing(robot, model, beside, runs, read, held_out).made()


class Files(NamedTuple):
    """The logs of one run, and the folder, or the bag, that they are in."""

    folder: Path
    paths: list[Path]

    def name(self, path: Path) -> str:
        """What a description calls a log."""
        return path.relative_to(self.folder).as_posix()


def runs_of(logs: Sequence[Path]) -> dict[str, Files]:
    """Logs by run: those of each folder, bag or episode, or the files themselves as one run.

    Raises:
        InputError: there is no log.
    """
    files = [path for path in logs if not path.is_dir() and not is_bag(path)]
    runs: dict[str, Files] = {}
    for folder in (path for path in logs if path not in files):
        if is_dataset(folder):
            runs |= {path.parent.name: Files(path.parent, [path]) for path in logs_in(folder)}
            continue
        inside = [folder] if is_bag(folder) else [folder, *sorted(folder.iterdir())]
        for one in inside:
            if is_bag(one):
                own = [path for path in logs_in(one) if _is_log(path)]
            elif one.is_dir():
                own = [path for path in logs_in(one) if path.suffix.lower() in TABLES]
            else:
                continue
            if own:
                runs[one.stem if one.is_file() else one.name] = Files(one, own)
    if files and runs:
        raise InputError("expected files of one run, or folders of one run each, found both")
    if files:
        folders = {path.parent for path in files}
        if len(folders) > 1:
            raise InputError("expected the files of one run in one folder; name the folders")
        runs = {"": Files(folders.pop(), files)}
    if not runs:
        found = ", ".join(map(str, logs))
        kinds = ", ".join((*TABLES, *ENDINGS))
        raise InputError(f"{found}: expected logs ({kinds}), found none")
    return runs


def _is_log(topic: Path) -> bool:
    """Whether a topic holds numbers whose stamps increase."""
    try:
        log = read_log(topic)
    except InputError:
        return False
    times = log.column(TIME)
    return bool(times.size > 2 and (np.diff(times) > 0).all())


def checked(path: Path, text: str) -> None:
    """Write a description, and read what it describes; what cannot be read is not left there.

    Raises:
        InputError: it cannot be written, or read.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    publish({path: text})
    try:
        load(path)
    except BaseException:
        path.unlink()
        raise


class _Describing:
    def __init__(
        self,
        robot: Robot,
        model: Path,
        beside: Path,
        runs: Mapping[str, Files],
        logs: Mapping[str, Log],
        held_out: Collection[str],
    ) -> None:
        self.held_out = held_out
        self.robot, self.model, self.beside, self.runs, self.logs = robot, model, beside, runs, logs
        self.joints = [joint for joint in robot.joints if joint.single]
        self.made_of = Imported("")
        self.channels: dict[str, tuple[Column, str, str]] = {}
        self.inputs: dict[str, tuple[Column, str, str]] = {}
        self.added: dict[str, Joint] = {}
        self.seconds: dict[str, Array] = {}
        self.time, self.unit = "", ""
        self._read = {log.path: log for log in logs.values()}

    def made(self) -> Imported:
        """The description."""
        time, unit = self.time, self.unit = self._time()
        every = [
            Column(file, name, np.where(np.isfinite(values), values, np.nan))
            for file, log in self.logs.items()
            for name in log.names()
            for values in (log.column(name),)
            if name != time
        ]
        columns = [column for column in every if np.isfinite(column.values).any()]
        for column in every:
            if np.isnan(column.values).all():
                self._untold(column, "has no number")
        self._positions(columns)
        self._rates(columns)
        self._commands(columns)
        if not self.channels:
            there = ", ".join(f"{c.file}: {c.name}" for c in columns[:12])
            raise InputError(
                f"{next(iter(self.logs.values())).path}: no column is a joint's position by name, "
                f"number or range; there are {there}; write the description by hand"
            )
        self._say_rest(columns)
        self.made_of.text = self._text(time, unit)
        return self.made_of

    def _time(self) -> tuple[str, str]:
        """The column of stamps and its unit, the same in all files."""
        found: dict[str, str] = {}
        for file, log in self.logs.items():
            columns = [Column(file, name, log.column(name)) for name in log.names()]
            time = guess.time_of(columns)
            if time is None:
                raise InputError(
                    f"{log.path}: no column increases from row to row; expected one of stamps"
                )
            unit = guess.unit_of_time(time.values)
            if unit is None:
                interval = float(np.median(np.diff(time.values)))
                raise InputError(
                    f"{log.path}, column {time.name}: stamps {interval:g} apart are no log's in s, "
                    "ms, us or ns"
                )
            found.setdefault(time.name, unit)
            self.seconds[file] = guess.UNITS[unit] * (time.values - time.values[0])
            if len(found) > 1 or found.get(time.name) != unit:
                raise InputError(
                    f"{log.path}: its stamps are called {time.name} ({unit}), those of the files "
                    f"before {', '.join(f'{n} ({u})' for n, u in found.items())}; "
                    "give them one name"
                )
        ((name, unit),) = found.items()
        rate = 1.0 / float(np.median(np.diff(next(iter(self.seconds.values())))))
        self.made_of.guessed.append(f"time: column {name} in {unit}, {rate:.4g} Hz")
        return name, unit

    def _by_joint(self, columns: Sequence[Column]) -> list[tuple[Column, Joint, str]]:
        """Columns of one kind with their joints, and why."""
        found = []
        plain = []
        for column in columns:
            joint = guess.joint_of(column, self.joints)
            if joint is not None:
                found.append((column, joint, "by its name"))
            else:
                plain.append(column)
        groups: dict[tuple[str, str], list[Column]] = {}
        for column in plain:
            groups.setdefault((column.file, column.name.rstrip("0123456789[]")), []).append(column)
        for group in groups.values():
            numbered = guess.numbered(group, self.joints)
            for column in group:
                if column.name in numbered:
                    found.append((column, numbered[column.name], "by the model's order of joints"))
        return found

    def _positions(self, columns: Sequence[Column]) -> None:
        mine = [c for c in columns if guess.role_of(c) in ("position", None)]
        for column, joint, why in self._by_joint(mine):
            unit = guess.unit_of_position(column.values, joint)
            name = f"q.{joint.name}"
            if unit is None:
                low, high = joint.range or (-np.inf, np.inf)
                ends = f"{np.nanmin(column.values):.4g} to {np.nanmax(column.values):.4g}"
                self._untold(column, f"goes from {ends}, {joint.name} from {low:.4g} to {high:.4g}")
            elif name in self.channels:
                self._untold(column, f"{name} is {self.channels[name][0].name} already")
            else:
                self.channels[name] = column, unit, f"{why}; in {unit} by its range"

    def _rates(self, columns: Sequence[Column]) -> None:
        mine = [c for c in columns if guess.role_of(c) == "velocity"]
        for column, joint, why in self._by_joint(mine):
            position = self.channels.get(f"q.{joint.name}")
            if guess.still(column.values):
                self._untold(column, "never changes")
            elif position is None or position[0].file != column.file:
                self._untold(column, f"no position of {joint.name} beside it tells its unit")
            else:
                own, unit, _ = position
                rate = guess.unit_of_rate(column.values, own.values, self.seconds[own.file], unit)
                late = self._late(own, column)
                if rate is None:
                    self._untold(column, f"is not the derivative of {own.name}")
                elif late is not None:
                    behind = f"{late.samples:.2g} samples {late.word} the derivative of {own.name}"
                    self._untold(column, f"is {behind}, filtered or stamped at another time")
                else:
                    says = f"{why}; in {rate}, as the derivative of {own.name}"
                    self.channels[f"qd.{joint.name}"] = column, rate, says

    def _late(self, position: Column, rate: Column) -> rates.Late | None:
        """Whether a velocity follows behind its position, of which a model would make a cause."""
        times = self.seconds[position.file]
        shown = {"q": position.values, "v": rate.values}
        return rates.late([Run("", times, shown, {}, {}, {}, False)], "q", "v")

    def _commands(self, columns: Sequence[Column]) -> None:
        mine = [c for c in columns if guess.role_of(c) == "command"]
        actuators = {a.joint: a for a in self.robot.actuators if a.joint}
        for column, joint, why in self._by_joint(mine):
            own = actuators.get(joint.name)
            if own is None and self.robot.actuators:
                self._untold(column, f"no actuator drives {joint.name}")
                continue
            name = own.name if own is not None else f"m_{joint.name}"
            kind = own.kind if own is not None else "position"
            unit = guess.unit_of_position(column.values, joint)
            if kind != "position":
                unit = joint.force_unit if kind == "motor" else f"{joint.unit}/s"
            if unit is None or f"u.{name}" in self.inputs:
                self._untold(column, f"is no command of {joint.name} in rad or deg")
                continue
            if own is None:
                self.added[name] = joint
            self.inputs[f"u.{name}"] = column, unit, f"{why}; in {unit}"

    def _untold(self, column: Column, why: str) -> None:
        self.made_of.untold.append(f"{column.file}, column {column.name}: {why}; left out")

    def _say_rest(self, columns: Sequence[Column]) -> None:
        """Columns of which nothing has been said."""
        used = {(c.file, c.name) for c, *_ in (*self.channels.values(), *self.inputs.values())}
        said = " ".join(self.made_of.untold)
        for column in columns:
            if (column.file, column.name) in used or f"column {column.name}:" in said:
                continue
            force = guess.role_of(column) == "force"
            why = "its unit cannot be told" if force else "what it is cannot be told"
            self._untold(column, why)
        missing = [j.name for j in self.joints if f"q.{j.name}" not in self.channels]
        if missing:
            self.made_of.untold.append(f"joints without a position: {', '.join(missing)}")

    def _text(self, time: str, unit: str) -> str:
        lines = [f"model = {_quoted(self._from(self.model))}"]
        if self.added:
            names = ", ".join(_quoted(f"{name}@*") for name in _GAINS)
            lines.append(f"free = [{names}]  # not known: they are estimated")
        lines.append("")
        lines += ["[time]", f"column = {_quoted(time)}", f"unit = {_quoted(unit)}  # guess", ""]
        for run, files in self.runs.items():
            if run:
                lines += [f"[runs.{_key(run)}]", f"folder = {_quoted(self._from(files.folder))}"]
                lines += [*["held_out = true"] * (run in self.held_out), ""]
        alone = self.runs[""].folder if "" in self.runs else None
        for name, joint in self.added.items():
            lines += self._actuator(name, joint)
        for kind, signals in (("channels", self.channels), ("inputs", self.inputs)):
            for name, (column, of, why) in signals.items():
                file = self._from(alone / column.file) if alone is not None else column.file
                lines += [f"[{kind}.{_quoted(name)}]  # guess: {why}", f"file = {_quoted(file)}"]
                lines += [f"column = {_quoted(column.name)}", f"unit = {_quoted(of)}", ""]
                self.made_of.guessed.append(f"{name}: {column.file}, column {column.name}, {why}")
        return "\n".join(lines).rstrip("\n") + "\n"

    def _actuator(self, name: str, joint: Joint) -> list[str]:
        """A servo whose gains nobody knows."""
        inertia = scales(self.robot).inertia[self.joints.index(joint)]
        found = self._following(name, joint)
        quick, damped = found or (QUICK, DAMPED)
        kp, kv = inertia * quick**2, 2.0 * damped * quick * inertia
        what = "as it follows its command" if found else "as of any hobby servo"
        self.made_of.guessed.append(
            f"gains of the servo of {joint.name}: of one of {quick:.3g} rad/s and {damped:.2g} of "
            f"critical damping, {what}; free"
        )
        lines = [f"[actuators.{_key(name)}]", f"joint = {_quoted(joint.name)}"]
        lines += ['kind = "position"  # guess: its commands are positions']
        return [*lines, f"kp = {kp:.4g}  # guess", f"kv = {kv:.4g}  # guess", ""]

    def _following(self, name: str, joint: Joint) -> Following | None:
        """How a joint follows the command of its servo, over all runs."""
        (u, unit, _), there = self.inputs[f"u.{name}"], self.channels.get(f"q.{joint.name}")
        if there is None:
            return None
        q, own, _ = there
        sizes = {"deg": np.pi / 180.0, "mm": 1e-3}
        shown = []
        for run in self.runs:
            command, position = self._signal(run, u), self._signal(run, q)
            if command is None or position is None:
                continue
            # A command holds until the next one.
            held = np.searchsorted(command[0], position[0], side="right") - 1
            values = command[1][np.clip(held, 0, command[1].size - 1)]
            scaled = sizes.get(unit, 1.0) * values, sizes.get(own, 1.0) * position[1]
            shown.append((position[0], *scaled))
        return following(shown)

    def _signal(self, run: str, column: Column) -> tuple[Array, Array] | None:
        """Stamps in s and values of a column in one run; None where it lacks the file or that."""
        files = self.runs[run]
        paths = [path for path in files.paths if files.name(path) == column.file]
        if not paths:
            return None
        log = self._log(paths[0])
        if not {column.name, self.time} <= set(log.names()):
            return None
        return guess.UNITS[self.unit] * log.column(self.time), log.column(column.name)

    def _log(self, path: Path) -> Log:
        """A log, read once."""
        if path not in self._read:
            self._read[path] = read_log(path)
        return self._read[path]

    def _from(self, path: Path) -> str:
        try:
            return Path(os.path.relpath(path, self.beside)).as_posix()
        except ValueError:  # on another drive
            return path.resolve().as_posix()


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _key(name: str) -> str:
    bare = name.replace("_", "").replace("-", "")
    return name if bare.isascii() and bare.isalnum() else _quoted(name)
