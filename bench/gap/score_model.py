"""The error of an extended simulator, or of a robot's model file, on another recording: initial
states are estimated there, nothing else.
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
"""Endings of a robot's files."""


def scored(
    model: Path, recording: str | Path | Recording, held_out: bool = False, force: bool = False
) -> dict[str, Any]:
    """RMSE by channel in its unit, in units of the noise over all channels, runs and samples
    counted.

    Args:
        model: extended.toml, or a robot's model file, as extended.xml.
        recording: the table, or a recording that is in memory.
        held_out: count only runs that are marked so.
        force: whether the user insists on a recording that is refused otherwise.

    Raises:
        InputError: a file cannot be read, or the recording is of another system.
    """
    memory = recording if isinstance(recording, Recording) else None
    path = recording.path if isinstance(recording, Recording) else Path(recording)
    if model.suffix not in MODEL_FILES:
        _check_plugin(model)
    # The description of a file says what it is a recording of, before the table is read.
    of_robot = memory.model if memory is not None else model_of(path)
    if model.suffix in MODEL_FILES:
        extended, kind = _robot(model, of_robot)
    else:
        extended, kind, _ = opened(model, simulators.get)
        # Another robot's recording shows by its channels.
        if of_robot is None or extended.robot is None:
            _check_system(path, _system(memory or path, of_robot), extended, model)
    # Every run counts, unless asked otherwise: nothing is fitted here but initial states.
    data = memory or read_recording(path, kind, whole=True)
    # What the recording states of itself stands above what the model was fitted with.
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
    # Effects that the file does not name are not in the model, so they need not be at hand.
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
    """Refuse a file that extends a simulator of the user's own, where its plugin is not given.

    Raises:
        InputError: it does; the message names the option, with the plugin that explain was given
            where the folder still says so.
    """
    extended = read(model)
    if extended.robot is not None or extended.system in simulators.names():
        return
    # It is named and not loaded: a file of numbers must not decide which code is run.
    settings = environment(model.parent).get("settings")
    plugins = settings.get("plugin") if isinstance(settings, dict) else None
    files = [str(plugin) for plugin in plugins] if isinstance(plugins, list) else ["FILE.py"]
    options = " ".join(f"--plugin {file}" for file in files)
    raise InputError(
        f"{model}: extends simulator '{extended.system}', which is not one of "
        f"{', '.join(simulators.names())}; add the file that defines it: {options}"
    )


def _robot(model: Path, stated: ModelFile | None) -> tuple[Extended, type[Simulated]]:
    """A robot as its file states it: no number of it is fitted, no effect is added."""
    from sims.robot.reading import read as read_robot

    tables = stated.actuators if stated else {}
    # A file that explain has written has the recording's actuators already.
    there = {actuator.name for actuator in read_robot(model).actuators}
    lacking = {name: table for name, table in tables.items() if name not in there}
    # An MJCF states how it is stepped; it may be what was found.
    engine = stated.engine if stated and model.suffix == ".urdf" else {}
    kind = cast(type[Simulated], robot(model, lacking, engine))
    return Extended(kind.name, kind.name, None, "", {}, {}, {}, (), kind), kind


def _system(recording: Path | Recording, of_robot: ModelFile | None) -> str:
    """What a recording says that it is of: the name of a robot's model file, or of a system."""
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
        # Without it the error would be one over fewer channels than the model was fitted to.
        if channel not in recorded:
            raise unknown(f"channel of {recording}", channel, recorded)


def theta_of(world: World, extended: Extended) -> Array:
    """(P,) the numbers of an extended simulator, nominal where it has none."""
    # Parameters that the file does not state are nominal, coefficients that it does not are off.
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
    """(R, T, C) the runs with the model's numbers, from initial states that are fitted to them."""
    white = np.zeros(len(sigma))
    runs = HeldOutRuns(world, Noise(sigma, white))
    (measured,) = runs.measure([theta_of(world, extended)])
    return measured.simulated


def _squares(world: World, simulated: Array) -> Array:
    """(R, T, C) squared errors; zero where nothing was seen."""
    seen = np.isfinite(world.observed)
    errors = world.observed - simulated
    squares: Array = np.where(seen, np.square(errors), 0.0)
    return squares


def _errors(world: World, squares: Array, sigma: Array) -> dict[str, Any]:
    """RMSE by channel, and over all of them in units of the noise."""
    seen = np.isfinite(world.observed)
    counts = seen.sum(axis=(0, 1))
    rmse = {}
    for c, name in enumerate(world.channels):
        # A channel without samples here has no error.
        if counts[c]:
            total = squares[:, :, c].sum()
            rmse[name] = float(np.sqrt(total / counts[c]))
    # Each channel in units of its noise, so that all of them may be added.
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
