"""A recording as scenarios and observations: what an experiment on real data fits, and what it
measures on.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.datasets import catalogue as datasets
from sims.base import Array, InputError, Scenario, Simulator
from sims.recording.recording import Recording, Run, read_recording
from sims.user_toml import known


class Side(NamedTuple):
    """Runs with what was observed in them: scenarios, one a run, and (T, C) all runs' samples one
    after another.
    """

    scenarios: tuple[Scenario, ...]
    observed: Array


class Measured(NamedTuple):
    """A recording's two sides, and the noise of each channel where it is stated (1 sigma)."""

    fitting: Side
    held_out: Side
    noise: Mapping[str, float]


def measured(path: str, simulator: Simulator) -> Measured:
    """The recording at `path` as the simulator's channels see it.

    Raises:
        InputError: it cannot be found or read, or lacks a channel of the simulator.
    """
    recording = read_recording(find_recording(path), type(simulator))
    wanted = [channel.name for channel in simulator.channels]
    known(f"channel of {recording.path}", wanted, recording.runs[0].channels)
    return Measured(
        _side(recording, recording.training(), simulator),
        _side(recording, recording.held_out(), simulator),
        recording.noise,
    )


def _side(recording: Recording, runs: tuple[Run, ...], simulator: Simulator) -> Side:
    names = [channel.name for channel in simulator.channels]
    observed = [np.stack([run.channels[name] for name in names], axis=1) for run in runs]
    # Where nothing is held out there is nothing to join, and yet channels.
    nothing = np.empty((0, len(names)))
    scenarios = tuple(scenario_of(run, simulator, recording.constants) for run in runs)
    return Side(scenarios, np.concatenate([nothing, *observed]))


def scenario_of(run: Run, simulator: Simulator, constants: Mapping[str, float]) -> Scenario:
    """The scenario of a recorded run: it starts in the measured state where the run does not state
    its own.
    """
    first = {name: float(values[0]) for name, values in run.channels.items()}
    # A channel that is no state, such as an acceleration, says nothing of where the run starts.
    start = {
        name: value
        for name, value in first.items()
        if name in simulator.states and np.isfinite(value)
    }
    return Scenario(
        run.times,
        {**start, **run.initial},
        run.inputs,
        {**constants, **run.constants},
        run.linear,
        run.offset,
        off=run.off,
    )


def beside(path: str, experiment: Path) -> str:
    """The path of an experiment's recording, made absolute where it lies beside the experiment's
    file: a worker or a folder of results does not know where that was.
    """
    file = experiment.parent / path
    # The folders of recordings come first wherever the path is looked up.
    return path if datasets.find("recording", path) or not file.is_file() else str(file.resolve())


def find_recording(path: str) -> Path:
    """The file `path` below $SIMGAP_DATA or the user's folder of data sets, or as it stands.

    Raises:
        InputError: it is in none of these places; the message says how to get it.
    """
    in_folder = datasets.find("recording", path)
    if in_folder is not None:
        return in_folder
    if Path(path).is_file():
        return Path(path)
    if data_set := datasets.providing("recording", path):
        raise InputError(f"recording {path}: this experiment {data_set.advice}")
    folder = os.environ.get("SIMGAP_DATA")
    places = f"in {folder} (SIMGAP_DATA)" if folder else "here (SIMGAP_DATA is not set)"
    remedy = "set SIMGAP_DATA to the folder of recordings"
    raise InputError(f"recording {path}: no such file {places} or beside the experiment; {remedy}")
