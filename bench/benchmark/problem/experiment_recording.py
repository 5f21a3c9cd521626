"""Convert a recording to scenarios and observations for fitting and for validation."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.datasets import public_datasets as datasets
from sims.core.simulator import Array, InputError, Scenario, Simulator
from sims.core.toml_validation import check_known_names
from sims.recording.recording import Recording, Run, read_recording


class ObservedRuns(NamedTuple):
    """Runs of one data split with their observations.

    Attributes:
        scenarios: one scenario per run.
        observed: (T, C) samples of all runs, concatenated.
    """

    scenarios: tuple[Scenario, ...]
    observed: Array


class RecordedRuns(NamedTuple):
    """Fitted and held-out runs of a recording.

    Attributes:
        fitting: runs that tuners may fit.
        held_out: runs for validation.
        noise: standard deviation of the noise by channel, if specified.
    """

    fitting: ObservedRuns
    held_out: ObservedRuns
    noise: Mapping[str, float]


def load_recorded_runs(path: str, simulator: Simulator) -> RecordedRuns:
    """Read a recording with the channels of a simulator.

    Args:
        path: path of the recording, see `find_recording`.
        simulator: simulator whose channels are read.

    Returns:
        The runs to fit, the held-out runs, and the noise of the channels.

    Raises:
        InputError: the recording cannot be found or read, or lacks a channel of the simulator.
    """
    recording = read_recording(find_recording(path), type(simulator))
    channel_names = [channel.name for channel in simulator.channels]
    check_known_names(f"channel of {recording.path}", channel_names, recording.runs[0].channels)
    return RecordedRuns(
        _make_observed_runs(recording, recording.training(), simulator),
        _make_observed_runs(recording, recording.held_out(), simulator),
        recording.noise,
    )


def _make_observed_runs(
    recording: Recording, runs: tuple[Run, ...], simulator: Simulator
) -> ObservedRuns:
    """Convert the fitted or the held-out runs of a recording to scenarios and observations.

    Args:
        recording: the recording, with its constants.
        runs: the runs to convert.
        simulator: simulator whose channels are read.

    Returns:
        One scenario for each run, and the observations (T, C): T samples of all runs together, C
        channels in the order of the simulator.
    """
    names = [channel.name for channel in simulator.channels]
    observed = [np.stack([run.channels[name] for name in names], axis=1) for run in runs]
    # Without runs the array has no rows, but it still needs a column per channel.
    no_samples = np.empty((0, len(names)))
    scenarios = tuple(make_scenario(run, simulator, recording.constants) for run in runs)
    return ObservedRuns(scenarios, np.concatenate([no_samples, *observed]))


def make_scenario(run: Run, simulator: Simulator, constants: Mapping[str, float]) -> Scenario:
    """Convert a recorded run to a scenario.

    The run starts in the first measured state unless it specifies an initial state. The scenario
    also says which inputs are interpolated linearly, how much they are delayed (`offset`, in s),
    and when actuators are switched off (`off`).

    Args:
        run: recorded run.
        simulator: simulator whose states are initialised.
        constants: constants of the whole recording.
    """
    first = {name: float(values[0]) for name, values in run.channels.items()}
    # A channel that is not a state, such as an acceleration, gives no initial value.
    start = {
        name: value
        for name, value in first.items()
        if name in simulator.states and np.isfinite(value)
    }
    return Scenario(
        times=run.times,
        initial={**start, **run.initial},
        inputs=run.inputs,
        constants={**constants, **run.constants},
        linear=run.linear,
        offset=run.offset,
        off=run.off,
    )


def resolve_recording_path(path: str, experiment: Path) -> str:
    """Return a recording's path, made absolute if the file is next to the experiment file.

    Workers and result folders do not know the location of the experiment file.
    """
    file = experiment.parent / path
    # The folders of recordings have priority everywhere.
    return path if datasets.find("recording", path) or not file.is_file() else str(file.resolve())


def find_recording(path: str) -> Path:
    """Find a recording below $SIMGAP_DATA, in the user's folder of data sets, or as a path.

    Raises:
        InputError: it is in none of these places; the message says how to get it.
    """
    in_folder = datasets.find("recording", path)
    if in_folder is not None:
        return in_folder
    if Path(path).is_file():
        return Path(path)
    if data_set := datasets.find_providing_data_set("recording", path):
        raise InputError(f"recording {path}: this experiment {data_set.advice}")
    folder = os.environ.get("SIMGAP_DATA")
    places = f"in {folder} (SIMGAP_DATA)" if folder else "here (SIMGAP_DATA is not set)"
    remedy = "set SIMGAP_DATA to the folder of recordings"
    raise InputError(
        f"recording {path}: no such file {places} or next to the experiment's file; {remedy}"
    )
