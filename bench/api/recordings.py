"""Python API: `simgap.simulate`, `simgap.read_recording` and `simgap.import_logs`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeAlias, cast

from bench.core.option_dataclasses import takes_options
from bench.logs.recording_loading import load_recording, read_frame_recording
from bench.logs.synthetic_recording import (
    SimulatedRecording,
    SimulationSpec,
    simulate_recording,
)
from sims.core.argument_checks import Expected, Name, check_arguments
from sims.core.simulator import InputError
from sims.recording.recording import Recording
from sims.recording.recording_frame import Frame, FrameDescription, Units

simulate = takes_options(SimulationSpec, "simulate")(simulate_recording)

_EXPECTED_RECORDING = (
    "the path of NAME.csv, a Recording (of read_recording), a SimulatedRecording (of simulate) or "
    "a pandas DataFrame"
)

RecordingSource: TypeAlias = Annotated[
    str | Path | Recording | SimulatedRecording | Frame, Expected(_EXPECTED_RECORDING)
]
"""A source of one recording."""

Sources: TypeAlias = Annotated[
    RecordingSource | Sequence[RecordingSource],
    Expected(f"{_EXPECTED_RECORDING}, or a list of these"),
]
"""A source of one recording, or several."""


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


def list_sources(
    recording: RecordingSource | Sequence[RecordingSource],
    frame_description: FrameDescription | None = None,
) -> list[str | Path | Recording]:
    """Return recordings as a list of paths and of recordings in memory.

    Args:
        recording: One recording, or several.
        frame_description: Description of data frames among them.

    Raises:
        InputError: No recording is given, a data frame is malformed, or `frame_description`
            describes recordings that are not data frames.
    """
    frame_description = frame_description or FrameDescription()
    is_single = isinstance(recording, str | Path | Recording | SimulatedRecording | Frame)
    given_sources: list[Any] = (
        [recording] if is_single else [*cast(Sequence[RecordingSource], recording)]
    )
    if not given_sources:
        raise InputError(f"recording: expected {_EXPECTED_RECORDING}, found an empty list")
    frames = [source for source in given_sources if isinstance(source, Frame)]
    sources: list[str | Path | Recording] = []
    for source in given_sources:
        if isinstance(source, Frame):
            number = f" {len(sources) + 1}" if len(given_sources) > 1 else ""
            sources.append(read_frame_recording(source, frame_description, f"DataFrame{number}"))
        else:
            # Files have their own descriptions, so one that is given needs a data frame.
            if not frames:
                frame_description.refuse_for_files(source)
            sources.append(source.recording if isinstance(source, SimulatedRecording) else source)
    return sources
