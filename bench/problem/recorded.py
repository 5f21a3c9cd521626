"""A recording as scenarios and observations: what an experiment on real data fits, and what it
measures on.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sims.base import Array, InputError, Scenario, Simulator, unknown
from sims.recording.recording import Recording, Run, read_recording


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
    for channel in simulator.channels:
        if channel.name not in recording.runs[0].channels:
            raise unknown(
                f"channel of {recording.path}", channel.name, list(recording.runs[0].channels)
            )
    return Measured(
        _side(recording, recording.training(), simulator),
        _side(recording, recording.held_out(), simulator),
        recording.noise,
    )


def _side(recording: Recording, runs: tuple[Run, ...], simulator: Simulator) -> Side:
    observed = [
        np.stack([run.channels[c.name] for c in simulator.channels], axis=1) for run in runs
    ]
    nothing = np.empty((0, len(simulator.channels)))
    scenarios = tuple(scenario_of(run, simulator, recording.constants) for run in runs)
    return Side(scenarios, np.concatenate([nothing, *observed]))


def scenario_of(run: Run, simulator: Simulator, constants: Mapping[str, float]) -> Scenario:
    """The scenario of a recorded run: it starts in the measured state where the run does not state
    its own.
    """
    start = {
        n: float(v[0])
        for n, v in run.channels.items()
        if n in simulator.states and np.isfinite(v[0])
    }
    return Scenario(run.times, {**start, **run.initial}, run.inputs, {**constants, **run.constants})


def find_recording(path: str) -> Path:
    """The file `path` below $SIMGAP_DATA, below ../shared/data, or as it stands.

    Raises:
        InputError: it is in none of these places.
    """
    project = Path(__file__).resolve().parents[2]
    folders = [Path("../shared/data"), project.parent / "shared" / "data"]
    if os.environ.get("SIMGAP_DATA"):
        folders = [Path(os.environ["SIMGAP_DATA"])]
    for candidate in [*(folder / path for folder in folders), Path(path)]:
        if candidate.is_file():
            return candidate
    places = ", ".join(map(str, folders))
    raise InputError(
        f"recording {path}: not found in {places}; set SIMGAP_DATA to the folder of recordings"
    )
