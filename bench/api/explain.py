"""Python API: `simgap.explain` and `simgap.score`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, TypeAlias, cast

from bench.diagnosis import explain as explaining
from bench.diagnosis.evaluation.progress_events import ProgressListener
from bench.diagnosis.evaluation.search_control import SearchControl
from bench.diagnosis.evaluation.worker_pool import count_available_cores
from bench.diagnosis.explanation import Explanation
from bench.diagnosis.score_extended import MODEL_FILES, score_model
from bench.logs.data_frames import FrameDescription, recording_of
from bench.logs.synthetic_recording import SimulatedRecording
from sims import extended_simulator as extended_file
from sims.core.argument_checks import Count, Expected, Name, Names, Seconds, check_arguments
from sims.core.simulator import InputError
from sims.recording.recording import Recording
from sims.recording.recording_frame import Frame

_RECORDING = (
    "the path of NAME.csv, a Recording (of read_recording), a SimulatedRecording (of simulate) or "
    "a pandas DataFrame"
)
RecordingSource: TypeAlias = Annotated[
    str | Path | Recording | SimulatedRecording | Frame, Expected(_RECORDING)
]
"""A source of one recording."""
Sources: TypeAlias = Annotated[
    RecordingSource | Sequence[RecordingSource], Expected(f"{_RECORDING}, or a list of these")
]
"""A source of one recording, or several."""
Units: TypeAlias = Annotated[
    Mapping[str, str], Expected("units of columns by their names, as {'q': 'rad'}")
]
"""Units of a data frame's columns, by column name."""


@check_arguments
def explain(
    recording: Sources,
    *,
    system: Name | None = None,
    model: str | Path | None = None,
    units: Units | None = None,
    constants: Mapping[str, float] | None = None,
    description: Mapping[str, Any] | None = None,
    engine: Name = "batch",
    free: Names = (),
    tuner: Name | None = None,
    seed: int = 0,
    force: bool = False,
    budget: Seconds | None = None,
    jobs: Count | None = None,
    whole: bool = False,
    pieces: Seconds | None = None,
    thorough: bool = False,
    say: Callable[[str], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[float, str], None] | None = None,
    listener: ProgressListener | None = None,
) -> Explanation:
    """Find the effects that a simulator of a recorded system lacks, and add them to it.

    Args:
        recording: Path of ``NAME.csv``, a recording that was read or simulated, or a pandas
            DataFrame with the columns that `read_recording` describes. Several recordings of one
            system are explained together, and each also separately.
        system: Name of the system, instead of the one that the description states. A DataFrame
            needs this or `model`.
        model: Model file of a robot, MJCF or URDF, instead of the one that the description states.
        units: Units of a DataFrame's columns by name; None for those in ``df.attrs["units"]``.
        constants: Known numbers of the system in SI units, with a DataFrame.
        description: Any other entries about a DataFrame, with the keys of ``NAME.toml``.
        engine: ``pybullet``, ``mujoco`` or ``batch``; not used for a simulator that steps itself.
        free: Constants to estimate together with the parameters; for a robot, numbers of its model
            file, as ``damping@*`` or ``mass@forearm``.
        tuner: Name of a tuner that finds the starting point of the base fit; None for a grid.
        seed: Seed of the surrogate data and the bootstrap.
        force: Explain a recording that needs more than this machine has, or whose stamps cannot be
            seconds.
        budget: Time limit of the search in seconds; None for no limit. At the limit the search ends
            with its results so far, and ``cut`` of the answer says what was not tested.
        jobs: Number of processes; None for one per core. The answer does not depend on it.
        whole: Use all samples of a long recording of a robot; otherwise segments from all over it.
        pieces: Length in seconds of the segments that runs are cut into. Each segment has its own
            initial state, for motion that drifts or is unstable.
        thorough: If causes are found and a residual remains, search for further causes that
            held-out runs confirm. This takes about twice as long.
        say: Called with notes on the recording and the base model.
        stop: Called between two steps; if it returns True, the search ends as at its time limit.
        progress: Called with the share that is done (an estimate) and the current step.
        listener: Receives the events of the search: its stages with their steps, and the best model
            so far.

    Returns:
        The verdict, its causes, the extended simulator and the figures.

    Raises:
        InputError: An argument is wrong; the recording cannot be read, is too short or is of a
            simulator that takes no effects; or the search ended before the first simulation.
    """
    about = FrameDescription(system, model, units or {}, constants or {}, description or {})
    sources = list_sources(recording, about)
    watch = SearchControl(budget, stop, progress, listener)
    given = system, engine, seed, free, tuner, say, force
    more = jobs or count_available_cores(), model, whole, pieces, thorough
    return explaining.explain(sources, *given, watch, *more)


def list_sources(
    recording: RecordingSource | Sequence[RecordingSource], about: FrameDescription | None = None
) -> list[str | Path | Recording]:
    """Return recordings as a list of paths and of recordings in memory.

    Args:
        recording: One recording, or several.
        about: Description of data frames among them.

    Raises:
        InputError: No recording is given, a data frame is malformed, or `about` describes
            recordings that are not data frames.
    """
    about = about or FrameDescription()
    single = isinstance(recording, str | Path | Recording | SimulatedRecording | Frame)
    each: list[Any] = [recording] if single else [*cast(Sequence[RecordingSource], recording)]
    if not each:
        raise InputError(f"recording: expected {_RECORDING}, found an empty list")
    frames = [one for one in each if isinstance(one, Frame)]
    sources: list[str | Path | Recording] = []
    for one in each:
        if isinstance(one, Frame):
            number = f" {len(sources) + 1}" if len(each) > 1 else ""
            sources.append(recording_of(one, about, f"DataFrame{number}"))
        else:
            if not frames:
                about.refuse_for_files(one)
            sources.append(one.recording if isinstance(one, SimulatedRecording) else one)
    return sources


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
        recording: As for `explain`; a DataFrame is of the model's system.
        units: As for `explain`.
        constants: As for `explain`.
        description: As for `explain`.
        held_out: Whether to use only runs that are marked as held out.
        force: As for `explain`.

    Returns:
        rmse by channel in its unit, normalised_rmse in units of the noise, runs, samples, units.

    Raises:
        InputError: A file cannot be read, or the recording is of another system.
    """
    about = FrameDescription(None, None, units or {}, constants or {}, description or {})
    if isinstance(recording, Frame):
        about = _of_model(Path(model), about)
    (source,) = list_sources(recording, about)
    return score_model(Path(model), source, held_out, force)


def _of_model(model: Path, about: FrameDescription) -> FrameDescription:
    """Complete the description of a data frame by the system or robot of a model."""
    if model.suffix in MODEL_FILES:
        return replace(about, model=model)
    extended = extended_file.read_extended(model)
    robot = extended.robot
    if robot is None:
        return replace(about, system=extended.system)
    stated = {"actuators": robot.actuators, "engine": robot.engine}
    return replace(about, model=robot.path, description={**stated, **about.description})
