"""Load a recording with the simulator class of its system or robot, if it is not too large."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

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
