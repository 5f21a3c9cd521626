"""Load recordings that users name, cut them into runs, and join several recordings into one."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np

from bench.core.plugin_registries import make_robot_simulator, simulators
from bench.core.resource_estimates import (
    BYTES_PER_NUMBER,
    BYTES_PER_STEP,
    MIN_SIMULATION_SECONDS,
    MIN_STEP_SECONDS,
    ResourceNeed,
    check_feasible,
    get_machine_resources,
    get_max_step,
)
from sims.core.argument_checks import Expected, Name
from sims.core.files import hash_file
from sims.core.plain_values import MAX_NUMBER, format_count
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import InputError, Simulator
from sims.core.toml_validation import get_subtable
from sims.recording.column_mapping import list_mapped_files
from sims.recording.log_formats.hdf5_and_parquet import group_of
from sims.recording.log_formats.lerobot_dataset import list_episode_files, split_episode_path
from sims.recording.log_formats.ros_bags import split_bag_path
from sims.recording.recording import (
    MAX_FOLDS,
    Recording,
    read_recording,
    read_system_name,
    recording_of_frame,
    split_held_out,
)
from sims.recording.recording_description import (
    ModelFileReference,
    get_description_path,
    model_in,
    read_model_reference,
)
from sims.recording.recording_frame import Frame


def load_recording(
    source: str | Path | Recording,
    system: str | None = None,
    model: str | Path | None = None,
    free: Sequence[str] = (),
    divide: bool = True,
    fix_base: bool = False,
) -> tuple[Recording, type[Simulator]]:
    """Read a recording and find its simulator; its runs are divided for fitting and validation.

    Args:
        source: Path of the table, or a recording in memory.
        system: Registered system to use instead of the one that the recording names.
        model: Model file of a robot to use instead of the one that the recording names.
        free: Numbers of a robot's model file to tune; empty for those of the description.
        divide: Whether to divide the runs for fitting and validation as `simgap explain` does;
            False to hold out marked runs only.
        fix_base: Whether to fix floating bodies of a robot in the pose of its model file.

    Returns:
        The recording, and the simulator class of its system.

    Raises:
        InputError: It cannot be read, or there is no such system.
    """
    kind = get_simulator_class(source, system, model, free, fix_base)
    if isinstance(source, Recording):
        recording = source
    else:
        recording = read_recording(Path(source), kind, whole=True)
    if divide:
        recording = split_held_out(recording, folds=True)
    check_value_sizes(recording)
    return recording, kind


def get_simulator_class(
    source: str | Path | Recording,
    system: str | None = None,
    model: str | Path | None = None,
    free: Sequence[str] = (),
    fix_base: bool = False,
) -> type[Simulator]:
    """Find the simulator of the system or robot of a recording.

    A robot's simulator is made from its model file; other simulators are registered by name. What
    the caller gives precedes what the recording states.

    Args:
        source: The recording, or its path.
        system: Registered system to use instead of the one that the recording names.
        model: Model file of a robot to use instead of the one that the recording names.
        free: Numbers of a robot's model file to tune; empty for those of the description.
        fix_base: Whether to fix floating bodies of a robot in the pose of its model file.
    """
    if system is not None and model is not None:
        raise InputError("expected a system or a model file, found both; leave one out")
    if isinstance(source, Recording):
        path, reference = source.path, source.model
        if model is not None:
            reference = replace(reference or ModelFileReference(Path(), {}, {}), path=Path(model))
    else:
        path = Path(source)
        reference = None if system is not None else read_model_reference(path, model)
    if reference is not None and system is None:
        engine = {**reference.engine, **({"fix_base": True} if fix_base else {})}
        return make_robot_simulator(
            reference.path, reference.actuators, engine, free or reference.free
        )
    name = system or (source.system if isinstance(source, Recording) else read_system_name(path))
    return _find_system(path, name)


def _find_system(path: str | Path, name: str) -> type[Simulator]:
    """Return a registered simulator; `path` begins the message if there is none."""
    try:
        return simulators.get(name)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def check_value_sizes(recording: Recording) -> None:
    """Reject values that are so large that sums of their squares, as in an error, may overflow.

    Raises:
        InputError: There is such a value; the message is one line.
    """
    for run in recording.runs:
        for name, values in (*run.channels.items(), *run.inputs.items()):
            largest = float(np.nanmax(np.abs(values), initial=0.0))
            if largest > MAX_NUMBER:
                problem = f"expected values within ±{MAX_NUMBER:g}, found {largest:.3g}"
                raise InputError(f"{recording.path}: run {run.name}, column {name}: {problem}")


_BYTES_PER_NUMBER = 8
"""Size of a number in a table, in bytes."""
_CELL_SECONDS = 1e-7
"""Time to write a number, in seconds."""
_RUN_MEMORY = 3000
"""Memory of a run in addition to its samples, in bytes."""
_MIN_SIMULTANEOUS_SIMULATIONS = 10
"""Minimum number of simultaneous simulations for fitting a run."""
_MIN_FIT_SIMULATIONS = 100
"""Minimum number of simulations of a run for fitting it."""
_BYTES_PER_PIXEL = 100
"""Memory per pixel of a rendered image, in bytes."""
_PIXEL_SECONDS = 1e-8
"""Time to render a pixel, in seconds."""


def check_simulation_size(
    runs: int, samples: int, seconds: float, simulator: Simulator, force: bool = False
) -> None:
    """Refuse a recording that this machine cannot simulate.

    The need for memory, disk and time is estimated from the number of samples and of simulation
    steps, before anything is simulated.

    Args:
        runs: Number of runs.
        samples: Number of samples of each run.
        seconds: Duration of each run.
        simulator: Simulator of the recording.
        force: Whether the user insists.

    Raises:
        InputError: It needs more than is available; the message is one line.
    """
    columns = 1 + len(simulator.inputs) + len(simulator.channels)
    steps = max(seconds / get_max_step(simulator), samples)
    cells = float(runs) * samples * columns
    need = ResourceNeed(
        f"{runs:.4g} runs of {samples:.4g} samples and {steps:.3g} steps",
        "lower runs, seconds or rate",
        # The samples exist as numbers, and as the text of the table before it is written.
        memory=cells * (BYTES_PER_NUMBER + _BYTES_PER_NUMBER)
        + runs * _RUN_MEMORY
        + steps * BYTES_PER_STEP,
        disk=cells * _BYTES_PER_NUMBER,
        steps=steps,
        seconds=runs * (MIN_SIMULATION_SECONDS + MIN_STEP_SECONDS * steps) + cells * _CELL_SECONDS,
    )
    check_feasible(f"simulate {simulator.name}", need, get_machine_resources(), force)


def check_recording_size(recording: Recording, simulator: Simulator, force: bool = False) -> None:
    """Refuse a recording that this machine cannot fit.

    A fit simulates each run many times, several of them at once. Its minimum need is estimated
    from the longest run.

    Args:
        recording: Recording to explain or score.
        simulator: Simulator to fit.
        force: Whether the user insists.

    Raises:
        InputError: It needs more than is available; the message is one line.
    """
    longest = max(float(run.times[-1] - run.times[0]) for run in recording.runs)
    steps = longest / get_max_step(simulator)
    count = len(recording.runs)
    need = ResourceNeed(
        f"{count} runs of up to {longest:.4g} s, {steps:.3g} steps,",
        "explain shorter runs",
        memory=count * _MIN_SIMULTANEOUS_SIMULATIONS * steps * BYTES_PER_STEP,
        steps=steps,
        seconds=count * _MIN_FIT_SIMULATIONS * steps * MIN_STEP_SECONDS,
    )
    check_feasible(str(recording.path), need, get_machine_resources(), force)


def check_film_size(recording: Path, frames: int, pixels: int, force: bool = False) -> None:
    """Refuse a film that this machine cannot render.

    Args:
        recording: Path of the recording to film.
        frames: Number of images.
        pixels: Width and height of each image.
        force: Whether the user insists.

    Raises:
        InputError: It needs more than is available; the message is one line.
    """
    area = float(pixels) ** 2
    need = ResourceNeed(
        f"{frames} pictures of {pixels:.4g} x {pixels:.4g} pixels",
        "lower the size",
        memory=area * _BYTES_PER_PIXEL,
        seconds=frames * area * _PIXEL_SECONDS,
    )
    check_feasible(str(recording), need, get_machine_resources(), force)


Units: TypeAlias = Annotated[
    Mapping[str, str], Expected("units of columns by their names, as {'q': 'rad'}")
]
"""Units of a data frame's columns, by column name."""


@dataclass(frozen=True, kw_only=True)
class FrameDescription:
    """System of a recording, and the description of a data frame, which has no `NAME.toml` file.

    Attributes:
        system: Name of the system, instead of the one that the .toml file states.
        model: Model file of a robot, MJCF or URDF, instead of what the .toml file states.
        units: Units of a DataFrame's columns by name (default: those in ``df.attrs["units"]``).
        constants: Known numbers of the system in SI units, with a DataFrame.
        description: Any further entries about a DataFrame, with the keys of ``NAME.toml``.
    """

    system: Name | None = None
    model: str | Path | None = None
    units: Units | None = None
    constants: Mapping[str, float] | None = None
    description: Mapping[str, Any] | None = None

    def refuse_for_files(self, recording: object) -> None:
        """Reject a description of a data frame if the recording is a file, which has its own.

        Raises:
            InputError: units, constants or a description are given.
        """
        for name in ("units", "constants", "description"):
            if getattr(self, name):
                raise InputError(
                    f"{name}: expected only with a DataFrame; {recording} has a description "
                    "that states them"
                )


def read_frame_recording(
    frame: Frame, frame_description: FrameDescription, name: str = "DataFrame"
) -> Recording:
    """Read the recording in a data frame; only runs that are marked so are held out.

    The data frame replaces a table, and `frame_description` the description file next to it. What
    is given by name (system, model, constants) precedes the entries of its description.

    Args:
        frame: Columns ``run`` (if there are several), ``t`` and one for each channel and input.
        frame_description: Description by the user.
        name: Name of the recording in messages.

    Raises:
        InputError: The data frame or its description is malformed; the message is one line.
    """
    meta = dict(frame_description.description or {})
    if frame_description.system is not None:
        meta.pop("model", None)
        meta["system"] = frame_description.system
    if frame_description.model is not None:
        meta.pop("system", None)
        meta["model"] = str(frame_description.model)
    if frame_description.constants:
        stated_constants = get_subtable(name, meta, "constants")
        meta["constants"] = {**stated_constants, **frame_description.constants}
    kind = _get_simulator_class(name, meta)
    meta.setdefault("title", f"{kind.name}, {name}")
    return recording_of_frame(frame, kind, meta, frame_description.units or {}, name)


def _get_simulator_class(name: str, meta: Mapping[str, Any]) -> type[Simulator]:
    """Return the simulator class of the system or robot model that a description names.

    Args:
        name: path of the description, or name of a data frame, for messages.
        meta: content of the description.

    Raises:
        InputError: It names neither, or an unknown system.
    """
    file = model_in(Path(name), meta)
    if file is not None:
        return make_robot_simulator(file.path, file.actuators, file.engine, file.free)
    system = meta.get("system")
    if not isinstance(system, str):
        raise InputError(
            f"{name}: expected a system or model: system='NAME' or model='robot.xml'; "
            f"systems are {', '.join(simulators.names())}"
        )
    return _find_system(name, system)


_INCLUDE = re.compile(rb"<include\s+file\s*=\s*[\"']([^\"']+)[\"']")


def compute_recording_digest(path: Path, further_text: str = "") -> str:
    """Hash a recording: its table, its description, the mapped logs and bags, and its model.

    Args:
        path: Path of its table or description.
        further_text: Further text that is part of the hash.

    Raises:
        InputError: The table or the description cannot be read.
    """
    digest = hashlib.sha256(further_text.encode())
    description = get_description_path(path)
    for file in dict.fromkeys([path, description]):
        try:
            digest.update(file.read_bytes())
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from None
    for file in list_mapped_files(description):
        digest.update(read_content(file))
    return digest.hexdigest()


def read_content(path: Path) -> bytes:
    """Return a hash of the content of a file, a model file with its includes, a bag or an episode.

    The hash tells whether a recording has changed since it was explained. A bag is a folder or file
    of ROS, hashed as a whole; an episode of a LeRobot dataset consists of several files. Missing
    files contribute nothing; reading them later reports the error.
    """
    episode = split_episode_path(path)
    if episode is not None:
        try:
            return b"".join(read_content(file) for file in list_episode_files(*episode))
        except InputError:
            return b""
    bag = split_bag_path(path) or group_of(path)
    root = path if bag is None else bag[0]
    files = sorted(root.rglob("*")) if bag is not None and root.is_dir() else [root]
    content = hashlib.sha256()
    for file in files if root.suffix.lower() != ".xml" else _list_included_files(root):
        if file.is_file():
            file_stat = file.stat()
            content.update(hash_file(file, file_stat.st_mtime_ns, file_stat.st_size))
    return content.digest()


def _list_included_files(model: Path) -> list[Path]:
    """Return a model file and the files that it includes, directly or through others.

    They are searched in the folder of the model.
    """
    files = [model]
    # Files that are appended here are visited later in this loop.
    for file in files:
        names = _INCLUDE.findall(file.read_bytes()) if file.is_file() else []
        included_files = [model.parent / name.decode(errors="replace") for name in names]
        files += [included for included in dict.fromkeys(included_files) if included not in files]
    return files


def load_joined(
    sources: Sequence[str | Path | Recording],
    system: str | None = None,
    model: str | Path | None = None,
    free: Sequence[str] = (),
    prepared: Callable[[Recording, type[Simulator]], Recording] | None = None,
    fix_base: bool = False,
) -> tuple[Recording, type[Simulator]]:
    """Read several recordings, join them into one, and find their simulator.

    Each recording is read and, unless the runs are few, divided into runs for fitting and held-out
    runs on its own. Then the runs are renamed, as several logs may have the same run names, and
    put together.

    Two or three unmarked runs in total are cross-validated; otherwise each recording holds out the
    runs that it would hold out alone, at least one. A constant that the recordings state
    differently becomes a constant of the runs; a noise that they state differently is replaced by
    its root mean square.

    Args:
        sources: Paths of the tables, or recordings in memory.
        system: Registered system to use instead of the one that the recordings name.
        model: Model file of a robot to use instead of the one that the recordings name.
        free: Numbers of a robot's model file to tune; empty for those of the description.
        prepared: Function applied to each recording before its runs are divided.
        fix_base: Whether to fix floating bodies of a robot in the pose of its model file.

    Returns:
        The joined recording, and the simulator class of its system.

    Raises:
        InputError: One cannot be read, or they are not of one system with the same channels.
    """
    loaded = [
        load_recording(source, system, model, free, divide=False, fix_base=fix_base)
        for source in sources
    ]
    if prepared is not None:
        loaded = [(prepared(recording, kind), kind) for recording, kind in loaded]
    first_recording, kind = loaded[0]
    if len(loaded) == 1:
        return split_held_out(first_recording, folds=True), kind
    for recording, other_kind in loaded[1:]:
        _refuse_other(first_recording, kind, recording, other_kind)
    recordings = [recording for recording, _ in loaded]
    runs_of_all = [run for recording in recordings for run in recording.runs]
    is_cross_validated = len(runs_of_all) <= MAX_FOLDS and not any(
        run.held_out for run in runs_of_all
    )
    if not is_cross_validated:
        recordings = [split_held_out(recording) for recording in recordings]
    names = make_log_names([recording.path for recording in recordings])
    common_constants = {
        key: value
        for key, value in first_recording.constants.items()
        if all(recording.constants.get(key) == value for recording in recordings)
    }
    default_values = {c.name: c.value for c in kind.constants}
    stated_keys = {key for recording in recordings for key in recording.constants}
    differing = stated_keys - common_constants.keys()
    runs = [
        replace(
            run,
            name=f"{name}: {run.name}",
            log=name,
            constants={
                **{key: default_values.get(key, np.nan) for key in differing},
                **{key: value for key, value in recording.constants.items() if key in differing},
                **run.constants,
            },
        )
        for name, recording in zip(names, recordings, strict=True)
        for run in recording.runs
    ]
    joined_recording = replace(
        first_recording,
        title=f"{first_recording.title or first_recording.path.stem} and "
        + format_count(len(loaded) - 1, "more log"),
        constants=common_constants,
        # The noise of a channel for which some recording states none is not known.
        noise={
            name: compute_rms([recording.noise[name] for recording in recordings])
            for name in first_recording.noise
            if all(name in recording.noise for recording in recordings)
        },
        runs=tuple(runs),
        notes=tuple(note for recording in recordings for note in recording.notes),
    )
    if is_cross_validated:
        joined_recording = split_held_out(joined_recording, folds=True)
    return joined_recording, kind


def _refuse_other(
    first: Recording, kind: type[Simulator], other: Recording, other_kind: type[Simulator]
) -> None:
    """Reject a recording that cannot be joined with the first one.

    Both must be of one system (robots: one model file) and have the same channels and inputs, since
    the joined recording is fitted with one simulator.

    Raises:
        InputError: System, model file, channels or inputs of the recordings differ.
    """
    robots = kind.has_model and other_kind.has_model
    if (kind.has_model or other_kind.has_model) != robots or other_kind.name != kind.name:
        raise InputError(
            f"{other.path}: expected a log of {kind.name} as {first.path}, found one of "
            f"{other_kind.name}; explain it by itself"
        )
    if robots and vars(other_kind)["source_digest"] != vars(kind)["source_digest"]:
        raise InputError(
            f"{other.path}: expected the model file, the actuators and the free numbers of "
            f"{first.path}, found others; state the same, or give --model and --free"
        )
    first_run, other_run = first.runs[0], other.runs[0]
    for signal_type, first_names, other_names in (
        ("channels", set(first_run.channels), set(other_run.channels)),
        ("inputs", set(first_run.inputs), set(other_run.inputs)),
    ):
        if first_names != other_names:
            raise InputError(
                f"{other.path}: expected the {signal_type} of {first.path}, "
                f"{', '.join(sorted(first_names))}, found "
                f"{', '.join(sorted(other_names)) or 'none'}"
            )


def make_log_names(paths: Sequence[Path]) -> list[str]:
    """Return a short name for each log: its stem, with its folder if stems repeat."""
    stems = [path.stem for path in paths]
    if len(set(stems)) == len(stems):
        return stems
    qualified_names = [f"{path.parent.name}/{path.stem}" for path in paths]
    if len(set(qualified_names)) == len(qualified_names):
        return qualified_names
    return [f"{number}/{name}" for number, name in enumerate(qualified_names, start=1)]
