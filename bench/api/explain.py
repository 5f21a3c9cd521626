"""`simgap.explain` and `simgap.score`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, TypeAlias, cast

from bench.gap import explain as explaining
from bench.gap.explanation import Explanation
from bench.gap.model.crew import cores
from bench.gap.model.progress import ProgressListener
from bench.gap.model.watch import Watch
from bench.gap.score_model import MODEL_FILES, scored
from bench.recordings.frames import FrameDescription, recording_of
from bench.recordings.simulate import SimulatedRecording
from sims import extended as extended_file
from sims.arguments import Count, Expected, Name, Names, Seconds, check_arguments
from sims.base import InputError
from sims.recording.frame import Frame
from sims.recording.recording import Recording

_RECORDING = (
    "the path of NAME.csv, a Recording (of read_recording), a SimulatedRecording (of simulate) or "
    "a pandas DataFrame"
)
Source: TypeAlias = Annotated[
    str | Path | Recording | SimulatedRecording | Frame, Expected(_RECORDING)
]
"""What holds a recording."""
Sources: TypeAlias = Annotated[
    Source | Sequence[Source], Expected(f"{_RECORDING}, or a list of these")
]
"""What holds one recording, or several."""
Units: TypeAlias = Annotated[
    Mapping[str, str], Expected("units of columns by their names, as {'q': 'rad'}")
]
"""Of the columns of a data frame, by name."""


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
    """Show what the simulation of a recording gets wrong, name the cause, extend the simulator.

    Args:
        recording: the path of ``NAME.csv``, a recording that was read or simulated, or a pandas
            DataFrame (`read_recording` says what its columns are); several of one system are
            explained together, and each also by itself.
        system: take it for this system, whatever the description says; a DataFrame needs it, or:
        model: take it for this robot, whatever the description says: an MJCF or URDF.
        units: of the columns of a DataFrame.
        constants: known numbers of the system, with a DataFrame.
        description: anything else about a DataFrame, with the keys of ``NAME.toml``.
        engine: pybullet, mujoco or batch; a simulator that steps itself has its own.
        free: constants to estimate with the parameters; of a robot numbers of its file, as
            ``damping@*`` or ``mass@forearm``.
        tuner: a registered tuner that finds where the fit of the base parameters begins.
        seed: of the surrogates and the bootstrap.
        force: explain what needs more than this machine has, or has stamps that cannot be seconds.
        budget: seconds of the clock after which the search ends with what it has then; the
            answer's ``cut`` says what was not asked any more. None: it comes to its end.
        jobs: processes that work at once, where that pays; None: one for each core. The answer does
            not depend on it.
        whole: look at all of a long recording of a robot; else at pieces from all over it.
        pieces: seconds of the pieces that every run is cut into, each with an initial state of its
            own: for motion that drifts or is unstable.
        thorough: search on where causes are found and something is left over: further causes are
            taken that held-out runs bear out. Takes about twice as long there.
        say: told what the user should know of the recording and of the base model.
        stop: asked between two steps of the search; True ends it as a budget does.
        progress: told the share that is done, as far as can be known, and what is looked at.
        listener: receives the events of the search: its stages with their steps, and the best
            model so far.

    Raises:
        InputError: the recording cannot be read, is too short, or is of nothing that takes effects;
            or the budget is no number above 0, or ended before anything could be simulated.
    """
    about = FrameDescription(system, model, units or {}, constants or {}, description or {})
    sources = sources_of(recording, about)
    watch = Watch(budget, stop, progress, listener)
    given = system, engine, seed, free, tuner, say, force
    more = jobs or cores(), model, whole, pieces, thorough
    return explaining.explain(sources, *given, watch, *more)


def sources_of(
    recording: Source | Sequence[Source], about: FrameDescription | None = None
) -> list[str | Path | Recording]:
    """One or several recordings, each as a path or as a recording in memory.

    Args:
        recording: one, or several.
        about: what the user states of data frames among them.

    Raises:
        InputError: there is none, a data frame is malformed, or `about` states something of what is
            no data frame.
    """
    about = about or FrameDescription()
    single = isinstance(recording, str | Path | Recording | SimulatedRecording | Frame)
    each: list[Any] = [recording] if single else [*cast(Sequence[Source], recording)]
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
    recording: Source,
    *,
    units: Units | None = None,
    constants: Mapping[str, float] | None = None,
    description: Mapping[str, Any] | None = None,
    held_out: bool = False,
    force: bool = False,
) -> dict[str, Any]:
    """The error of an extended simulator on another recording; initial states are estimated there,
    nothing else.

    Args:
        model: extended.toml, or a robot's model file, as extended.xml.
        recording: as in `explain`; a DataFrame is of the model's system.
        units: as in `explain`.
        constants: as in `explain`.
        description: as in `explain`.
        held_out: count only runs that are marked so.
        force: as in `explain`.

    Returns:
        rmse by channel in its unit, normalised_rmse in units of the noise, runs, samples, units.

    Raises:
        InputError: a file cannot be read, or the recording is of another system.
    """
    about = FrameDescription(None, None, units or {}, constants or {}, description or {})
    if isinstance(recording, Frame):
        about = _of_model(Path(model), about)
    (source,) = sources_of(recording, about)
    return scored(Path(model), source, held_out, force)


def _of_model(model: Path, about: FrameDescription) -> FrameDescription:
    """What is stated of a data frame, of the system or robot that a model is of."""
    if model.suffix in MODEL_FILES:
        return replace(about, model=model)
    extended = extended_file.read(model)
    robot = extended.robot
    if robot is None:
        return replace(about, system=extended.system)
    stated = {"actuators": robot.actuators, "engine": robot.engine}
    return replace(about, model=robot.path, description={**stated, **about.description})
