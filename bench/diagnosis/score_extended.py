"""Score an extended simulator, or a robot's model file, on another recording.

Only the initial states are estimated on that recording.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from bench.benchmark.storage.provenance import read_environment
from bench.core.plugin_registries import make_robot_simulator, simulators
from bench.core.resource_estimates import check_recording_size
from bench.diagnosis.evaluation.noise_floor import compute_noise_floor
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.validation.held_out_runs import HeldOutRuns
from bench.logs.filter_settling import leave_out_settling
from bench.logs.lost_samples import fill_lost_commands
from bench.logs.quality.log_quality import check_recording_plausible
from bench.logs.quality.range_checks import check_value_sizes
from sims.core.simulator import Array, InputError, make_unknown_name_error
from sims.extended_simulator import ExtendedSimulator, open_extended, read_extended
from sims.recording.recording import Recording, read_recording, read_system_name
from sims.recording.recording_description import ModelFileReference, read_model_reference
from sims.system_simulator import SystemSimulator

MODEL_FILES = (".xml", ".mjcf", ".urdf")
"""File name extensions of robot model files."""


def score_model(
    model: Path, recording: str | Path | Recording, held_out: bool = False, force: bool = False
) -> dict[str, Any]:
    """Compute the RMS error of a model on a recording, by channel and over all channels.

    Only the initial states are fitted to the recording; parameters and coefficients are those of
    the model.

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
    path = recording.path if isinstance(recording, Recording) else Path(recording)
    # Checked before the description is read, which may name the system of the same plugin.
    if model.suffix not in MODEL_FILES:
        _check_plugin(model)
    # The description names the system of the recording before the table is read.
    model_reference = (
        recording.model if isinstance(recording, Recording) else read_model_reference(path)
    )
    if model.suffix in MODEL_FILES:
        extended, kind = _load_robot(model, model_reference)
    else:
        extended, kind, _ = open_extended(model, simulators.get)
        # A recording of another robot is recognised by its channels.
        if model_reference is None or extended.robot is None:
            source = recording if isinstance(recording, Recording) else path
            _check_system(path, _get_system_name(source, model_reference), extended, model)
    # All runs count by default, because only initial states are fitted here.
    scored = (
        recording if isinstance(recording, Recording) else read_recording(path, kind, whole=True)
    )
    # Constants of the recording take precedence over those that the model was fitted with.
    scored = replace(scored, constants={**extended.constants, **scored.constants})
    scored, _ = leave_out_settling(scored, kind)
    runs = scored.held_out() if held_out else scored.runs
    if not runs:
        raise InputError(f"{path}: no run is marked held_out, and only such runs were to count")
    _check_channels(path, extended, list(runs[0].channels))
    engine = None if kind.own_engine else extended.engine
    check_value_sizes(scored)
    check_recording_plausible(scored, kind, force)
    check_recording_size(scored, kind(engine=engine), force)
    # Versions of the recording, of which the one with the smallest error counts.
    versions = [scored]
    if kind.has_model:
        filled, note = fill_lost_commands(scored)
        # Commands of lost rows were held or sent; the smaller error tells which.
        versions += [filled] if note else []
    errors = min(
        (_compute_errors(version, kind, engine, extended, held_out) for version in versions),
        key=_ScoredRuns.compute_cost,
    )
    if not np.isfinite(errors.squares).all():
        raise InputError(f"{path}: the simulation failed with the parameters of {model}")
    return _summarise_errors(errors)


class _ScoredRuns(NamedTuple):
    """Errors of a model on the runs that count.

    Attributes:
        evaluator: Closed run evaluator of the runs.
        squares: (R, T, C) squared errors; zero where no sample was observed.
        sigma: (C,) standard deviation of the noise of each channel.
    """

    evaluator: RunEvaluator
    squares: Array
    sigma: Array

    def compute_cost(self) -> float:
        """Return the sum of squared errors in units of the noise of each channel."""
        return float((self.squares / np.square(self.sigma)).sum())


def _compute_errors(
    recording: Recording,
    kind: type[SystemSimulator],
    engine: str | None,
    extended: ExtendedSimulator,
    held_out: bool,
) -> _ScoredRuns:
    """Simulate the runs with the numbers of a model, from fitted initial states.

    Args:
        recording: the recording.
        kind: simulator class of the model.
        engine: engine of the simulation; None for a simulator that steps itself.
        extended: extended simulator, with its parameters and coefficients.
        held_out: whether only held-out runs count.

    Returns:
        The runs with the squared errors (R, T, C) and the noise of each channel.
    """
    runs = recording.held_out() if held_out else recording.runs
    # Only the effects in the file are needed; the others are not part of the model.
    evaluator = RunEvaluator(kind, recording, runs, engine, candidates=list(extended.effects))
    sigma = compute_noise_floor(evaluator, recording).sigma
    fitted_runs = HeldOutRuns(evaluator, NoiseModel.make_white(sigma))
    (prediction,) = fitted_runs.fit_initial_states([build_theta(evaluator, extended)])
    errors = evaluator.observed - prediction.simulated
    squares = np.where(np.isfinite(evaluator.observed), np.square(errors), 0.0)
    evaluator.close()
    return _ScoredRuns(evaluator, squares, sigma)


def _check_plugin(model: Path) -> None:
    """Refuse an extended.toml of a user-defined simulator whose plugin is not loaded.

    Args:
        model: path of the extended.toml; a robot, or a simulator of simgap, is accepted.

    Raises:
        InputError: The plugin is missing; the message names the option, with the plugin given to
            explain if it is stored in the folder.
    """
    extended = read_extended(model)
    if extended.robot is not None or extended.system in simulators.names():
        return
    # The plugin is only named, not loaded: a data file must not decide which code is run.
    settings = read_environment(model.parent).get("settings")
    plugins = settings.get("plugin") if isinstance(settings, dict) else None
    files = [str(plugin) for plugin in plugins] if isinstance(plugins, list) else ["FILE.py"]
    options = " ".join(f"--plugin {file}" for file in files)
    raise InputError(
        f"{model}: extends simulator '{extended.system}', which is not one of "
        f"{', '.join(simulators.names())}; add the file that defines it: {options}"
    )


def _load_robot(
    model: Path, reference: ModelFileReference | None
) -> tuple[ExtendedSimulator, type[SystemSimulator]]:
    """Load a robot from its model file as a simulator, without fitted parameters and added effects.

    The description of the recording may add actuators that the file does not have, and integrator
    settings for a URDF file.

    Args:
        model: the model file.
        reference: actuators and engine that the description of the recording specifies; None
            without a description.
    """
    from sims.robot.parsing.read_model_file import read_robot

    described_actuators = reference.actuators if reference else {}
    # A file written by explain contains the actuators of the recording already.
    present_actuators = {actuator.name for actuator in read_robot(model).actuators}
    missing_actuators = {
        name: table for name, table in described_actuators.items() if name not in present_actuators
    }
    # An MJCF contains its own step and integrator, which may be a result of the diagnosis. Only
    # the names of the floating joints with a recorded pose are taken from the description.
    engine = reference.engine if reference else {}
    if model.suffix != ".urdf":
        engine = {key: engine[key] for key in ("recorded_bases",) if key in engine}
    kind = cast(type[SystemSimulator], make_robot_simulator(model, missing_actuators, engine))
    extended = ExtendedSimulator(
        name=kind.name,
        system=kind.name,
        engine=None,
        title="",
        parameters={},
        effects={},
        constants={},
        observe=(),
        kind=kind,
    )
    return extended, kind


def _get_system_name(
    recording: Path | Recording, model_reference: ModelFileReference | None
) -> str:
    """Return the system of a recording: the name of a robot's model file, or of a system.

    Args:
        recording: the recording, or the path of its description.
        model_reference: model file of a robot; None for a system.
    """
    if model_reference is not None:
        return model_reference.path.name
    return recording.system if isinstance(recording, Recording) else read_system_name(recording)


def _check_system(recording: Path, system: str, extended: ExtendedSimulator, model: Path) -> None:
    """Refuse a recording of another system.

    Args:
        recording: path of the recording, for messages.
        system: name of its system.
        extended: extended simulator of a diagnosis: fitted parameters, constants and effects.
        model: path of its file, for messages.

    Raises:
        InputError: the recording is of another system.
    """
    if system not in (extended.system, extended.name):
        raise InputError(
            f"{recording}: expected a recording of {extended.system}, as {model} is; "
            f"found one of {system}"
        )


def _check_channels(
    recording: Path, extended: ExtendedSimulator, recorded_channels: list[str]
) -> None:
    """Refuse a recording that lacks a channel of the model."""
    for channel in extended.observe:
        # Otherwise the error would cover fewer channels than the model was fitted to.
        if channel not in recorded_channels:
            raise make_unknown_name_error(f"channel of {recording}", channel, recorded_channels)


def build_theta(evaluator: RunEvaluator, extended: ExtendedSimulator) -> Array:
    """Build the parameter vector (P,) of an extended simulator.

    Missing parameters are nominal, and missing coefficients are zero, so that their effects are
    off.

    Shapes: P parameters.

    Args:
        evaluator: Run evaluator with the effects of the extended simulator.
        extended: Extended simulator.
    """
    theta = evaluator.get_nominal_theta()
    base_parameters = evaluator.parameters[: evaluator.system_parameter_count]
    for index, parameter in enumerate(base_parameters):
        if parameter.name in extended.parameters:
            number = extended.parameters[parameter.name]
            theta[index] = number.value
    for name, numbers in extended.effects.items():
        coefficients = evaluator.available_effects[name].on(evaluator.simulator.system)
        indices = evaluator.get_coefficient_indices(name)
        for index, coefficient in zip(indices, coefficients, strict=True):
            if coefficient.name in numbers:
                theta[index] = numbers[coefficient.name].value
    return theta


def _summarise_errors(errors: _ScoredRuns) -> dict[str, Any]:
    """Summarise the RMS error of each channel, and that of all in units of the noise.

    Args:
        errors: squared errors of the runs, and the noise of each channel.

    Returns:
        The document of `score_model`: errors, numbers of runs and samples, and units.
    """
    # Squared errors (R, T, C) of R runs, T samples and C channels; zero where nothing is recorded.
    evaluator, squares, sigma = errors
    observed_mask = np.isfinite(evaluator.observed)
    counts = observed_mask.sum(axis=(0, 1))
    rmse = {}
    for channel_index, name in enumerate(evaluator.channels):
        # A channel without samples has no error.
        if counts[channel_index]:
            total = squares[:, :, channel_index].sum()
            rmse[name] = float(np.sqrt(total / counts[channel_index]))
    # Errors of channels with different units can be added in units of their noise.
    normalised_squares = squares / np.square(sigma)
    normalised = np.sqrt(normalised_squares.sum() / counts.sum())
    channels = evaluator.simulator.channels
    return {
        "rmse": rmse,
        "normalised_rmse": float(normalised),
        "runs": len(evaluator.runs),
        "samples": int(observed_mask.any(axis=2).sum()),
        "units": {channel.name: channel.unit for channel in channels},
    }
