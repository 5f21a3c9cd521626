"""Load a recording together with the simulator class of its system or robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.core.plugin_registries import make_robot_simulator, simulators
from sims.core.simulator import InputError, Simulator
from sims.core.values import MAX_NUMBER
from sims.recording.recording import Recording, read_recording, read_system_name, split_held_out
from sims.recording.recording_description import ModelFileReference, read_model_reference


def load_recording(
    source: str | Path | Recording,
    system: str | None = None,
    model: str | Path | None = None,
    free: Sequence[str] = (),
    divide: bool = True,
    fix_base: bool = False,
) -> tuple[Recording, type[Simulator]]:
    """Read a recording and find its simulator.

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

    The arguments are those of `load_recording`.

    Raises:
        InputError: A system and a model file are both given, or the system is unknown.
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
    try:
        return simulators.get(name)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def check_value_sizes(recording: Recording) -> None:
    """Reject values whose squares overflow.

    Raises:
        InputError: There is such a value; the message is one line.
    """
    for run in recording.runs:
        for name, values in (*run.channels.items(), *run.inputs.items()):
            largest = float(np.nanmax(np.abs(values), initial=0.0))
            if largest > MAX_NUMBER:
                problem = f"expected values within ±{MAX_NUMBER:g}, found {largest:.3g}"
                raise InputError(f"{recording.path}: run {run.name}, column {name}: {problem}")
