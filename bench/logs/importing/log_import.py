"""Find what raw logs contain, and describe them as a recording (`simgap import`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeAlias

import numpy as np

from bench.core.option_dataclasses import takes_options
from bench.logs.importing.description_writer import DescriptionWriter
from bench.logs.importing.import_result import POSITION_UNITS, ImportOptions, ImportResult
from bench.logs.importing.joint_order import assign_order
from bench.logs.importing.run_logs import RunLogs, group_logs_by_run
from bench.logs.importing.signal_assignment import (
    ColumnAssigner,
    SignalAssignment,
    assign_velocities,
)
from bench.logs.recording_loading import load_recording
from sims.core.argument_checks import Expected
from sims.core.files import check_absent, write_files
from sims.core.simulator import InputError
from sims.core.toml_validation import check_known_names
from sims.robot.parsing.read_model_file import read_robot
from sims.robot.robot_model import RobotModel

Logs: TypeAlias = Annotated[
    str | Path | Sequence[str | Path], Expected("the path of a log, or a list of paths")
]
"""Files of one run, or folders with the files of one run each."""


@dataclass(frozen=True)
class ImportRequest(ImportOptions):
    """Logs to be described, with what the user states about them.

    Attributes:
        logs: Files of one run, or folders with the files of one run each.
        model: Model file of the robot, MJCF or URDF.
        out: Path NAME.toml of a new file.
    """

    logs: Logs
    model: str | Path
    out: str | Path


@takes_options(ImportRequest)
def import_logs(options: ImportRequest) -> ImportResult:
    """Write a description (TOML) of a robot's raw logs, so that all commands can read them.

    Args:
        options: Arguments, the attributes of `ImportRequest` and, by name, those of
            `bench.logs.importing.import_result.ImportOptions`.

    Returns:
        The guesses, the columns that were left out, and what to check.

    Raises:
        InputError: The logs cannot be read or contain nothing of the robot; the message is one
            line, and nothing is written.
    """
    logs = [options.logs] if isinstance(options.logs, str | Path) else options.logs
    model, path = Path(options.model), Path(options.out)
    if path.suffix != ".toml":
        raise InputError(f"expected a description to write, NAME.toml, found '{path}'")
    check_absent([path])
    paths = [Path(log) for log in logs]
    result = describe_logs(paths, read_robot(model), model, path.parent, options)
    write_checked_description(path, result.text)
    return result


def describe_logs(
    logs: Sequence[Path],
    robot: RobotModel,
    model: Path,
    folder: Path,
    options: ImportOptions | None = None,
) -> ImportResult:
    """Find what the columns of a robot's logs contain, and describe the recording.

    Columns are assigned to signals one kind after the other, since later kinds depend on earlier
    ones: positions, commands, velocities, efforts, and columns that may switch drives. Then the
    description is written, in which every guess is marked. The result lists the columns that are
    not used, and points that the user must check.

    Args:
        logs: Files of one run, folders with the files of one run each, or datasets of LeRobot.
        robot: Robot that was recorded.
        model: Its model file.
        folder: Folder in which the description will be written.
        options: Information that the user states.

    Raises:
        InputError: A log cannot be read, no column is a joint's position, or a run is unknown.
    """
    options = options or ImportOptions()
    check_known_names(
        "position unit", [options.position_unit] if options.position_unit else [], POSITION_UNITS
    )
    if options.rate is not None and not 0 < options.rate < np.inf:
        raise InputError(f"rate {options.rate:g}: expected a number of rows a second, more than 0")
    runs = group_logs_by_run(logs)
    check_known_names("run held out", options.held_out, [name for name in runs if name])
    result = ImportResult("")
    signals = SignalAssignment(robot)
    run_logs = RunLogs(runs, options.rate, [joint.name for joint in signals.joints], result)
    assigner = ColumnAssigner(run_logs, signals, options, result)
    assigner.assign_positions()
    assigner.assign_commands()
    # Joints whose position columns were exchanged, which velocity columns then follow.
    is_normalised = assigner.normalised is not None
    exchanged = assign_order(run_logs, signals, is_normalised, result)
    assign_velocities(run_logs, signals, exchanged, result)
    assigner.assign_efforts()
    assigner.find_switches()
    # Columns that nothing has used are reported last.
    assigner.report_missing_inputs()
    assigner.report_unused()
    result.text = DescriptionWriter(run_logs, signals, options, model, folder, result).write()
    return result


def write_checked_description(path: Path, text: str) -> None:
    """Write a description and read the recording; delete the description if that fails.

    Args:
        path: Path of the description.
        text: Description in TOML.

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
    except BaseException:  # also if the user interrupts the reading
        path.unlink()
        raise
