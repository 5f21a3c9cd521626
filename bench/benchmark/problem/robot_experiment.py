"""Get the simulator of an experiment, and build experiments from a robot's model file."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.benchmark.problem.experiment_config import (
    Experiment,
    HeldOutConfig,
    RecordingSource,
    TunerEntry,
    check_name,
)
from bench.benchmark.problem.experiment_recording import find_recording
from bench.core.plugin_registries import make_robot_simulator, simulators
from bench.datasets import public_datasets as datasets
from sims.core.files import is_existing_file, require_file
from sims.core.registry import PartUnavailableError
from sims.core.simulator import InputError, Simulator
from sims.core.user_messages import truncate_text
from sims.recording.recording import read_recording
from sims.recording.recording_description import read_model_reference
from sims.system_simulator import SystemSimulator

PACKAGE_SCHEME = "package://"
"""Prefix of a model file's path in an installed Python package, as in URDF files."""


def get_simulator_class(experiment: Experiment) -> type[Simulator]:
    """Return the class of the simulator that an experiment tunes, registered or of a model file.

    For a robot, the recording may state actuators, an engine and the numbers to tune. The
    experiment's own actuators and numbers have priority over those of the recording.

    Raises:
        InputError: there is no simulator of that name, or its model file cannot be used.
        PartUnavailableError: something that it needs is missing on this machine.
    """
    if not experiment.model:
        return simulators.get(experiment.simulator)
    subject = f"experiment {experiment.name}"
    path = find_model(experiment.model, experiment.name)
    free_names, actuators, engine = experiment.free, dict(experiment.actuators), {}
    if experiment.recording:
        # The description of the recording refers to a model, with what the model file lacks.
        reference = read_model_reference(find_recording(experiment.recording.path), path)
        assert reference is not None  # a model was given
        actuators, engine = {**reference.actuators, **actuators}, dict(reference.engine)
        free_names = free_names or reference.free
    if not free_names:
        expected = 'free = ["damping@*", ...] or --free, numbers of the model file to tune'
        raise InputError(f"{subject}: expected {expected}; found none")
    return make_robot_simulator(path, actuators, engine, free_names)


def complete_robot_experiment(experiment: Experiment) -> Experiment:
    """Complete a robot experiment that does not specify channels, inputs and initial pose.

    The channels are those of its recording if it has one. Otherwise channels, initial pose and
    inputs are those of the default recording that the robot's system declares.
    """
    if not experiment.model:
        return experiment
    simulator_class = get_simulator_class(experiment)
    changes: dict[str, Any] = {}
    if experiment.recording:
        path = find_recording(experiment.recording.path)
        # The runs are in one table, so they have the same channels.
        changes["observe"] = tuple(read_recording(path, simulator_class).runs[0].channels)
    elif issubclass(simulator_class, SystemSimulator):
        default_recording = simulator_class.system.usual_recording
        changes["observe"] = default_recording.observe
        changes["initial"] = dict(default_recording.initial)
        changes["inputs"] = dict(default_recording.inputs)
    unspecified = {key: value for key, value in changes.items() if not getattr(experiment, key)}
    return experiment.chosen(**unspecified)


def find_model(path: str, name: str) -> Path:
    """Find the model file of an experiment.

    It can be in an installed package (``package://NAME/FILE``), below $SIMGAP_ROBOTS, in the user's
    folder of data sets, or a path.

    Args:
        path: path of the file as the experiment states it.
        name: name of the experiment, for messages.

    Raises:
        PartUnavailableError: the file is in none of these places.
    """
    if path.startswith(PACKAGE_SCHEME):
        return _find_packaged_model(path, name)
    if robot_path := datasets.find("robot", path):
        return robot_path
    if is_existing_file(Path(path)):
        return Path(path)
    if data_set := datasets.find_providing_data_set("robot", path):
        raise PartUnavailableError("experiment", name, f"it {data_set.advice}")
    robots_folder = os.environ.get("SIMGAP_ROBOTS")
    places = (
        f"in {robots_folder} (SIMGAP_ROBOTS)"
        if robots_folder
        else "here (SIMGAP_ROBOTS is not set)"
    )
    raise PartUnavailableError(
        "experiment", name, f"model {truncate_text(path)}: no such file {places}"
    )


def _find_packaged_model(path: str, name: str) -> Path:
    """Find a model file inside an installed Python package, given as ``package://NAME/FILE``.

    Args:
        path: this address.
        name: name of the experiment that needs the file, for messages.

    Raises:
        InputError: the address is not of this form.
        PartUnavailableError: the package is not installed, or has no such file.
    """
    package, _, inner_path = path.removeprefix(PACKAGE_SCHEME).partition("/")
    if not (package.isidentifier() and inner_path):
        expected = f"{PACKAGE_SCHEME}NAME/FILE of an installed package"
        raise InputError(
            f"experiment {name}: model: expected {expected}, found '{truncate_text(path)}'"
        )
    # The package is located without importing it, so that its code does not run.
    package_spec = importlib.util.find_spec(package)
    if package_spec is None:
        reason = f"needs {package}, not installed (pip install {package.split('_')[0]})"
        raise PartUnavailableError("experiment", name, reason)
    for folder in package_spec.submodule_search_locations or ():
        if (file := Path(folder, inner_path)).is_file():
            return file
    raise PartUnavailableError(
        "experiment", name, f"model {truncate_text(path)}: package {package} has no such file"
    )


DEFAULT_TUNERS = (
    "random",
    "nelder_mead",
    "cma_es",
    "bayes",
    "entropy_search",
    "least_squares",
    "regressor",
    "tunenet",
    "hybrid",
)
"""Tuners that are compared by default."""
TARGETS, BUDGET, TRAINING = 5, 50, 480
"""Defaults: number of starts or targets, simulations on each, and training simulations."""
DEFAULT_ENCODER_NOISE = 1e-3
"""Default encoder noise of simulated targets, standard deviation in rad or m."""
HELD_OUT_RUNS = 2
"""Default number of held-out runs of each simulated target."""


def make_robot_experiment(
    model: str | Path | None, recording: str | Path | None, free: Sequence[str]
) -> Experiment:
    """Build an experiment that tunes numbers of a robot's model file.

    They are tuned to a recording, or to simulated targets if there is no recording. The user names
    no experiment file, so everything else has a default.

    Args:
        model: MJCF or URDF file; None for the one that the recording's description names.
        recording: table of the recording; None for simulated targets.
        free: numbers of the model file, such as ``damping@*``.

    Raises:
        InputError: no model file is given, or it does not contain such a number.
    """
    file = Path(model) if model is not None else None
    if recording is not None:
        reference = read_model_reference(recording, file)
        file = reference.path if reference is not None else None
    if file is None:
        source = f"{recording}: its description" if recording is not None else "compare"
        raise InputError(f'{source}: expected model = "robot.xml" or --model FILE, found none')
    require_file(file)
    parts = [file.stem] if recording is None else [file.stem, Path(recording).stem]
    data_note = (
        f"tuned to {Path(recording).name}" if recording is not None else "tuned to simulations"
    )
    experiment = Experiment(
        name=check_name("-".join(parts)),
        title=f"{file.name}: {', '.join(free)}, {data_note}",
        simulator=check_name(file.stem),
        model=str(file.resolve()),
        free=tuple(free),
        ranges=("in", "wide") if recording is None else ("real",),
        recording=None if recording is None else RecordingSource(str(Path(recording).resolve())),
        targets=TARGETS,
        budget=BUDGET,
        training_budget=TRAINING,
        held_out=HeldOutConfig(HELD_OUT_RUNS) if recording is None else None,
        tuners=tuple(TunerEntry(name, name) for name in DEFAULT_TUNERS),
    )
    experiment = complete_robot_experiment(experiment)
    if recording is not None:
        return experiment
    return experiment.chosen(noise=dict.fromkeys(experiment.observe, DEFAULT_ENCODER_NOISE))
