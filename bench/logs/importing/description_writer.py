"""Write the description of imported logs in TOML, with every guess marked by a comment."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from bench.logs.importing.import_result import ImportOptions, ImportResult
from bench.logs.importing.run_logs import RunLogs
from bench.logs.importing.servo_estimation import AddedServo, estimate_added_servos
from bench.logs.importing.signal_assignment import Signal, SignalAssignment
from sims.core.toml_validation import toml_key, toml_text

FREE_GAINS = "actuator.stiffness", "actuator.damping"
"""Free numbers of a servo that is missing in the model file."""


class DescriptionWriter:
    """Writer of the description of imported logs.

    Args:
        logs: Logs that are imported.
        signals: Signals and their columns.
        options: Information that the user states.
        model: Model file of the robot.
        folder: Folder in which the description will be written.
        result: Result to which messages are added.
    """

    def __init__(
        self,
        logs: RunLogs,
        signals: SignalAssignment,
        options: ImportOptions,
        model: Path,
        folder: Path,
        result: ImportResult,
    ) -> None:
        """Store the inputs; nothing is written yet.

        Args:
            logs: Files of the runs.
            signals: Columns that were assigned to channels and inputs.
            options: Facts that the user has stated.
            model: Model file of the robot.
            folder: Folder of the description, to which its paths are relative.
            result: Result of the import, whose guesses are marked in the text.
        """
        self._logs, self._signals, self._options = logs, signals, options
        self._model, self._folder, self._result = model, folder, result

    def write(self) -> str:
        """Return the text of the description in TOML.

        Its body has the time, the runs, servos that are missing in the model file, channels, inputs
        and columns that may switch drives. Its head, which depends on the body, has what the user
        must check as comments, the model file, and the unknown gains of servos. Guesses have a
        comment.
        """
        servos = estimate_added_servos(self._logs, self._signals)
        for servo in servos:
            self._report_gains(servo)
        body = [*self._list_time_lines(), *self._run_lines()]
        for servo in servos:
            body += [
                f"[actuators.{toml_key(servo.name)}]",
                f"joint = {toml_text(servo.joint.name)}",
                'kind = "position"  # guess: its commands are positions',
                f"kp = {servo.kp:.4g}  # guess",
                f"kv = {servo.kv:.4g}  # guess",
                "",
            ]
        for kind, table in (
            ("channels", self._signals.channels),
            ("inputs", self._signals.inputs),
        ):
            for name, signal in table.items():
                body += self._format_signal_lines(kind, name, signal)
        for column in self._signals.switches:
            body += [f"[extra.{toml_key(column.name)}]  # guess: zeros and ones"]
            body += [*self._format_file_lines(column.file), f"column = {toml_text(column.name)}"]
            body += ['unit = "1"', ""]
        head = [*(f"# check: {line}" for line in self._result.checks)]
        head += [f"model = {toml_text(self._make_relative(self._model))}"]
        free_servos = [servo.name for servo in servos if servo.is_free]
        if free_servos:
            # An asterisk stands for all servos: it is used if all of them have free gains.
            places = ["*"] if len(free_servos) == len(servos) else free_servos
            names = [f"{gain}@{place}" for place in places for gain in FREE_GAINS]
            name_list = ", ".join(map(toml_text, names))
            head.append(f"free = [{name_list}]  # not known: they are estimated")
        return "\n".join([*head, "", *body]).rstrip("\n") + "\n"

    def _list_time_lines(self) -> Iterator[str]:
        """Yield the lines of the table `[time]`: a sampling rate (Hz) or the time stamp column."""
        yield "[time]"
        if self._logs.rate is not None:
            yield f"rate = {float(self._logs.rate)!r}"
        else:
            yield f"column = {toml_text(self._logs.time_column)}"
            yield f"unit = {toml_text(self._logs.time_unit)}  # guess"
        yield ""

    def _run_lines(self) -> Iterator[str]:
        """Yield the lines of a table `[runs.NAME]` for each run.

        It has the file or folder of the run, and whether it is held out. A single run without a
        name has no table.
        """
        for run, files in self._logs.runs.items():
            if run:
                # `alone` means that the run is one file, and not all files of a folder.
                path = files.paths[0] if files.alone else files.folder
                key = "file" if files.alone else "folder"
                yield f"[runs.{toml_key(run)}]"
                yield f"{key} = {toml_text(self._make_relative(path))}"
                if run in self._options.held_out:
                    yield "held_out = true"
                yield ""

    def _format_file_lines(self, file: str) -> list[str]:
        """Return the line that names the file of a signal, in a list.

        The list is empty if each run is one file, because the table of the run names it.

        Args:
            file: name of the file in the folder of its run.
        """
        runs = self._logs.runs
        if next(iter(runs.values())).alone:  # each run is one file
            return []
        # A single run without a name has no table that states its folder.
        if "" in runs:
            file = self._make_relative(runs[""].folder / file)
        return [f"file = {toml_text(file)}"]

    def _format_signal_lines(self, kind: str, name: str, signal: Signal) -> list[str]:
        """Return the lines of a channel or an input, and list it as a guess in the import's result.

        Args:
            kind: table of the signal, ``channels`` or ``inputs``.
            name: name of the signal, such as ``q.elbow``.
            signal: its column, unit and scale.
        """
        column = signal.column
        lines = [f"[{kind}.{toml_text(name)}]  # guess: {signal.description}"]
        lines += self._format_file_lines(column.file)
        lines += [f"column = {toml_text(column.name)}", f"unit = {toml_text(signal.unit)}"]
        # Degrees without a scale may raise the warning that the positions may be normalised. A
        # scale of 1 shows later checks that the user has stated the unit.
        is_stated = self._options.position_unit == "deg" and name.startswith("q.")
        if signal.scale != 1.0 or is_stated:
            lines.append(f"scale = {signal.scale!r}")
        if signal.offset:
            lines.append(f"offset = {signal.offset!r}")
        self._result.guessed.append(
            f"{name}: {column.file}, column {column.name}, {signal.description}"
        )
        return [*lines, ""]

    def _report_gains(self, servo: AddedServo) -> None:
        """Report the gains of a servo that is missing in the model file.

        * If the log moves the joint, the gains are free: `explain` fits them, starting from values
          measured from the response to the command, or else from those of a typical servo. This is
          listed with the guesses.
        * If the log does not move the joint, the gains are fixed and only hold its position. The
          user has to check this, so it is listed with the checks.

        Args:
            servo: the new servo with its gains.
        """
        joint = servo.joint
        frequency, damping = servo.response
        gains = f"for {frequency:.3g} rad/s and a damping ratio of {damping:.2g}"
        if servo.is_free:
            origin = (
                "as it follows its command" if servo.is_measured else "typical of a hobby servo"
            )
            self._result.guessed.append(
                f"gains of the servo of {joint.name}: {gains}, {origin}; free"
            )
        else:
            self._result.checks.append(
                f"gains of the servo of {joint.name}: the log does not move this joint and cannot "
                f"show them; kp = {servo.kp:.4g} and kv = {servo.kv:.4g} ({gains}) only hold its "
                f"position and are not fitted; state those of the drive in "
                f"[actuators.{toml_key(servo.name)}], or import a log that moves the joint"
            )

    def _make_relative(self, path: Path) -> str:
        """Return a path relative to the folder of the description, with forward slashes.

        On another drive of Windows no relative path exists, so the path is absolute.

        Args:
            path: path of a log or of the model file.
        """
        try:
            return Path(os.path.relpath(path, self._folder)).as_posix()
        except ValueError:
            return path.resolve().as_posix()
