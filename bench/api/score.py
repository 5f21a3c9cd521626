"""Python API: `simgap.score`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from bench.api.recordings import RecordingSource, list_sources
from bench.diagnosis.score_extended import MODEL_FILES, score_model
from sims import extended_simulator as extended_file
from sims.core.argument_checks import check_arguments
from sims.recording.recording_frame import Frame, FrameDescription, Units


@check_arguments
def score(
    model: str | Path,
    recording: RecordingSource,
    *,
    units: Units | None = None,
    constants: Mapping[str, float] | None = None,
    description: Mapping[str, Any] | None = None,
    held_out: bool = False,
    force: bool = False,
) -> dict[str, Any]:
    """Compute the error of an extended simulator on another recording.

    Only the initial states are estimated there.

    Args:
        model: Path of extended.toml, or of a robot's model file, such as extended.xml.
        recording: Path of the recording's CSV table, or a DataFrame of the model's system.
        units: Units of a DataFrame's columns by name.
        constants: Known numbers of the system in SI units, with a DataFrame.
        description: Any other entries about a DataFrame, with the keys of ``NAME.toml``.
        held_out: Whether to use only runs that are marked as held out.
        force: Whether to score a recording that is refused otherwise, as for `explain`.

    Returns:
        ``rmse`` by channel in its unit, ``normalised_rmse`` in units of the noise, the numbers of
        ``runs`` and ``samples``, and the ``units`` of the channels.

    Raises:
        InputError: A file cannot be read, or the recording is of another system.
    """
    frame_description = FrameDescription(units=units, constants=constants, description=description)
    if isinstance(recording, Frame):
        frame_description = _fill_in_from_model_file(Path(model), frame_description)
    (source,) = list_sources(recording, frame_description)
    return score_model(Path(model), source, held_out, force)


def _fill_in_from_model_file(model: Path, frame_description: FrameDescription) -> FrameDescription:
    """Fill in the system or robot to which a data frame belongs, taken from a model file.

    Unlike a recording file, a data frame has no description file that names them. Entries that
    `frame_description` already has take precedence.

    Args:
        model: A robot's model file (MJCF or URDF), or an extended simulator (TOML), which names a
            robot or a system.
        frame_description: Description of the data frame.
    """
    if model.suffix in MODEL_FILES:
        return replace(frame_description, model=model)
    extended = extended_file.read_extended(model)
    # What the file states about a robot: its model file, actuators and engine; None for a system.
    robot = extended.robot
    if robot is None:
        return replace(frame_description, system=extended.system)
    robot_settings = {"actuators": robot.actuators, "engine": robot.engine}
    return replace(
        frame_description,
        model=robot.path,
        description={**robot_settings, **(frame_description.description or {})},
    )
