"""Python API: `simgap.simulate`, `simgap.read_recording` and `simgap.import_logs`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias

from bench.api.explain import RecordingSource, list_sources
from bench.core.options import takes_options
from bench.logs.importing.import_result import ImportOptions, ImportResult
from bench.logs.importing.log_import import describe_logs, write_checked_description
from bench.logs.recording_loading import FrameDescription, Units, load_recording
from bench.logs.synthetic_recording import (
    SimulationSpec,
    simulate_recording,
)
from sims.core.argument_checks import Expected, Name, check_arguments
from sims.core.files import check_absent
from sims.core.simulator import InputError
from sims.recording.recording import Recording
from sims.robot.parsing.read_model_file import read_robot

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


simulate = takes_options(SimulationSpec, "simulate")(simulate_recording)


@check_arguments
def read_recording(
    path: RecordingSource,
    system: Name | None = None,
    *,
    model: str | Path | None = None,
    units: Units | None = None,
    constants: Mapping[str, float] | None = None,
    description: Mapping[str, Any] | None = None,
) -> Recording:
    """Read and check ``NAME.csv`` with ``NAME.toml`` in the same folder, or a pandas DataFrame.

    The columns of a DataFrame are those of ``NAME.csv``: ``run`` (not needed for a single run),
    ``t`` in seconds, and channels and inputs under their names in the system; a missing sample is
    NaN. ``run`` and ``t`` may be levels of its index.

    Args:
        path: Path of the table, or a DataFrame.
        system: Name of the system, instead of the one that the description states. A DataFrame
            needs this or `model`.
        model: Model file of a robot, MJCF or URDF, instead of the one that the description states.
        units: Units of a DataFrame's columns by name; None for those in ``df.attrs["units"]``.
        constants: Known numbers of the system in SI units, with a DataFrame.
        description: Any other entries about a DataFrame, with the keys of ``NAME.toml``.

    Raises:
        InputError: The recording is malformed; the message is one line.
    """
    frame_description = FrameDescription(
        system=system, model=model, units=units, constants=constants, description=description
    )
    (source,) = list_sources(path, frame_description)
    return load_recording(source, system, model)[0]


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
