"""Load a recording, a table or data frame, together with the simulator of its system."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from bench.core.plugin_registries import make_robot_simulator, simulators
from bench.logs.quality.range_checks import check_value_sizes
from sims.core.simulator import InputError, Simulator
from sims.core.toml_validation import get_subtable
from sims.recording.recording import Recording, read_recording, read_system_name, split_held_out
from sims.recording.recording_description import (
    ModelFileReference,
    get_model_reference,
    read_model_reference,
)
from sims.recording.recording_frame import Frame, FrameDescription, make_frame_recording


def load_recording(
    source: str | Path | Recording,
    system: str | None = None,
    model: str | Path | None = None,
    free: Sequence[str] = (),
    divide: bool = True,
    fix_base: bool = False,
) -> tuple[Recording, type[Simulator]]:
    """Read a recording, find its simulator, and divide its runs for fitting and validation.

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
        # `whole` holds out marked runs only; unmarked ones are divided below.
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

    Raises:
        InputError: Both a system and a model file are given or stated, or the system is unknown.
    """
    if system is not None and model is not None:
        raise InputError("expected a system or a model file, found both; leave one out")
    if isinstance(source, Recording):
        path, reference = source.path, source.model
        if model is not None:
            # The other settings of a robot that the recording states still hold.
            reference = replace(reference or ModelFileReference(Path(), {}, {}), path=Path(model))
    else:
        path = Path(source)
        reference = None if system is not None else read_model_reference(path, model)
    if reference is not None and system is None:
        engine = {**reference.engine, **({"fix_base": True} if fix_base else {})}
        return make_robot_simulator(
            reference.path,
            reference.actuators,
            engine,
            free or reference.free,
            reference.description,
        )
    name = system or (source.system if isinstance(source, Recording) else read_system_name(path))
    return _find_system(path, name)


def _find_system(path: str | Path, name: str) -> type[Simulator]:
    """Return a registered simulator; `path` begins the message if there is none."""
    try:
        return simulators.get(name)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def read_frame_recording(
    frame: Frame, frame_description: FrameDescription, name: str = "DataFrame"
) -> Recording:
    """Read the recording in a data frame; only runs that are marked so are held out.

    The data frame replaces a CSV table, and `frame_description` the TOML file that describes it.
    What it gives by name (system, model, constants) precedes the entries of its `description`.

    Args:
        frame: Columns ``run`` (if there are several), ``t`` and one for each channel and input.
        frame_description: Description by the user.
        name: Name of the recording in messages.

    Raises:
        InputError: The data frame or its description is malformed; the message is one line.
    """
    meta = dict(frame_description.description or {})
    # A description states either a system or a model file. One that the user gives replaces
    # whatever the description states, also the other kind.
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
    return make_frame_recording(frame, kind, meta, frame_description.units or {}, name)


def _get_simulator_class(name: str, meta: Mapping[str, Any]) -> type[Simulator]:
    """Return the simulator class of the system or robot model that a description names.

    Args:
        name: path of the description, or name of a data frame, for messages.
        meta: content of the description.

    Raises:
        InputError: It names neither, or an unknown system.
    """
    file = get_model_reference(Path(name), meta)
    if file is not None:
        return make_robot_simulator(
            file.path, file.actuators, file.engine, file.free, file.description
        )
    system = meta.get("system")
    if not isinstance(system, str):
        raise InputError(
            f"{name}: expected a system or model: system='NAME' or model='robot.xml'; "
            f"systems are {', '.join(simulators.names())}"
        )
    return _find_system(name, system)
