"""Score an extended simulator, or a robot's model file, on another recording.

Only the initial states are estimated on that recording.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from bench.gap.held_out import HeldOutRuns
from bench.gap.model.floor import noise_floor
from bench.gap.model.noise import Noise
from bench.gap.model.world import World
from bench.recordings.filter_start import leave_out_settling
from bench.recordings.inspection import refuse_huge
from bench.recordings.size import check_recording
from bench.recordings.stamps import refuse_odd
from bench.registry import robot, simulators
from bench.store.made import environment
from sims.base import Array, InputError, unknown
from sims.extended import Extended, opened, read
from sims.recording.description import ModelFile, model_of
from sims.recording.recording import Recording, read_recording, system_of
from sims.simulated import Simulated

MODEL_FILES = (".xml", ".mjcf", ".urdf")
"""File name extensions of robot model files."""


def scored(
    model: Path, recording: str | Path | Recording, held_out: bool = False, force: bool = False
) -> dict[str, Any]:
    """Compute the RMS error of a model on a recording, by channel and over all channels.

    Args:
        model: An extended.toml, or a robot's model file, such as extended.xml.
        recording: Recording, or the path of its table.
        held_out: Count only runs that are marked as held out.
        force: Use recordings that are otherwise refused.

    Returns:
        RMSE by channel in its unit, normalised RMSE over all channels in units of the noise, number
        of runs and samples, and units.

    Raises:
        InputError: A file cannot be read, or the recording is of another system.
    """
    memory = recording if isinstance(recording, Recording) else None
    path = recording.path if isinstance(recording, Recording) else Path(recording)
    if model.suffix not in MODEL_FILES:
        _check_plugin(model)
    # The description names the system of the recording before the table is read.
    of_robot = memory.model if memory is not None else model_of(path)
    if model.suffix in MODEL_FILES:
        extended, kind = _robot(model, of_robot)
    else:
        extended, kind, _ = opened(model, simulators.get)
        # A recording of another robot is recognised by its channels.
        if of_robot is None or extended.robot is None:
            _check_system(path, _system(memory or path, of_robot), extended, model)
    # All runs count by default, because only initial states are fitted here.
    data = memory or read_recording(path, kind, whole=True)
    # Constants of the recording take precedence over those that the model was fitted with.
    data = replace(data, constants={**extended.constants, **data.constants})
    data, _ = leave_out_settling(data, kind)
    runs = data.held_out() if held_out else data.runs
    if not runs:
        raise InputError(f"{path}: no run is marked held_out, and only such runs were to count")
    _check_channels(path, extended, list(runs[0].channels))
    engine = None if kind.own_engine else extended.engine
    refuse_huge(data)
    refuse_odd(data, kind, force)
    check_recording(data, kind(engine=engine), force)
    # Only the effects in the file are needed; the others are not part of the model.
    world = World(
        kind,
        data,
        runs,
        engine,
        candidates=list(extended.effects),
    )
    sigma = noise_floor(world, data).sigma
    squares = _squares(world, _simulated(world, extended, sigma))
    world.close()
    if not np.isfinite(squares).all():
        raise InputError(f"{path}: the simulation failed with the parameters of {model}")
    return _errors(world, squares, sigma)


def _check_plugin(model: Path) -> None:
    """Refuse the model of a user-defined simulator whose plugin is not loaded.

    Raises:
        InputError: The plugin is missing; the message names the option, with the plugin given to
            explain if it is stored in the folder.
    """
    extended = read(model)
    if extended.robot is not None or extended.system in simulators.names():
        return
    # The plugin is only named, not loaded: a data file must not decide which code is run.
    settings = environment(model.parent).get("settings")
    plugins = settings.get("plugin") if isinstance(settings, dict) else None
    files = [str(plugin) for plugin in plugins] if isinstance(plugins, list) else ["FILE.py"]
    options = " ".join(f"--plugin {file}" for file in files)
    raise InputError(
        f"{model}: extends simulator '{extended.system}', which is not one of "
        f"{', '.join(simulators.names())}; add the file that defines it: {options}"
    )


def _robot(model: Path, stated: ModelFile | None) -> tuple[Extended, type[Simulated]]:
    """Load a robot from its model file, without fitted numbers and without added effects."""
    from sims.robot.reading import read as read_robot

    tables = stated.actuators if stated else {}
    # A file written by explain contains the actuators of the recording already.
    there = {actuator.name for actuator in read_robot(model).actuators}
    lacking = {name: table for name, table in tables.items() if name not in there}
    # An MJCF contains its own step and integrator, which may be a result of the diagnosis.
    engine = stated.engine if stated and model.suffix == ".urdf" else {}
    kind = cast(type[Simulated], robot(model, lacking, engine))
    return Extended(kind.name, kind.name, None, "", {}, {}, {}, (), kind), kind


def _system(recording: Path | Recording, of_robot: ModelFile | None) -> str:
    """Return the system of a recording: the name of a robot's model file, or of a system."""
    if of_robot is not None:
        return of_robot.path.name
    return recording.system if isinstance(recording, Recording) else system_of(recording)


def _check_system(recording: Path, system: str, extended: Extended, model: Path) -> None:
    """Refuse a recording of another system."""
    if system not in (extended.system, extended.name):
        raise InputError(
            f"{recording}: expected a recording of {extended.system}, as {model} is; "
            f"found one of {system}"
        )


def _check_channels(recording: Path, extended: Extended, recorded: list[str]) -> None:
    """Refuse a recording that lacks a channel of the model."""
    for channel in extended.observe:
        # Otherwise the error would cover fewer channels than the model was fitted to.
        if channel not in recorded:
            raise unknown(f"channel of {recording}", channel, recorded)


def theta_of(world: World, extended: Extended) -> Array:
    """Build the parameter vector (P,) of an extended simulator; missing numbers are nominal.

    Args:
        world: Run evaluator with the effects of the extended simulator.
        extended: Extended simulator.
    """
    # Missing parameters are nominal, and missing coefficients are off.
    theta = world.nominal()
    own = world.parameters[: world.own]
    for place, parameter in enumerate(own):
        if parameter.name in extended.parameters:
            number = extended.parameters[parameter.name]
            theta[place] = number.value
    for name, numbers in extended.effects.items():
        coefficients = world.effects[name].on(world.simulator.system)
        places = world.places(name)
        for place, coefficient in zip(places, coefficients, strict=True):
            if coefficient.name in numbers:
                theta[place] = numbers[coefficient.name].value
    return theta


def _simulated(world: World, extended: Extended, sigma: Array) -> Array:
    """Simulate the runs (R, T, C) with the model's numbers, from fitted initial states."""
    white = np.zeros(len(sigma))
    runs = HeldOutRuns(world, Noise(sigma, white))
    (measured,) = runs.measure([theta_of(world, extended)])
    return measured.simulated


def _squares(world: World, simulated: Array) -> Array:
    """Compute the squared errors (R, T, C); zero where no sample was observed."""
    seen = np.isfinite(world.observed)
    errors = world.observed - simulated
    squares: Array = np.where(seen, np.square(errors), 0.0)
    return squares


def _errors(world: World, squares: Array, sigma: Array) -> dict[str, Any]:
    """Summarise the RMSE by channel, and over all channels in units of the noise."""
    seen = np.isfinite(world.observed)
    counts = seen.sum(axis=(0, 1))
    rmse = {}
    for c, name in enumerate(world.channels):
        # A channel without samples has no error.
        if counts[c]:
            total = squares[:, :, c].sum()
            rmse[name] = float(np.sqrt(total / counts[c]))
    # Errors of different channels can be added in units of their noise.
    in_noise = squares / np.square(sigma)
    normalised = np.sqrt(in_noise.sum() / counts.sum())
    channels = world.simulator.channels
    return {
        "rmse": rmse,
        "normalised_rmse": float(normalised),
        "runs": len(world.runs),
        "samples": int(seen.any(axis=2).sum()),
        "units": {channel.name: channel.unit for channel in channels},
    }
