"""Calibration recording of a misspecified simulator, and labels of the two simulators of a study.

The recording contains nothing of the targets: its parameters, initial states, inputs and noise are
drawn from separate random streams.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.benchmark.problem import targets
from bench.benchmark.problem.experiment_config import CalibrationConfig, Experiment
from bench.benchmark.problem.robot_experiment import find_model
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.core.random_streams import TargetStreams
from sims.core.simulator import Array
from sims.recording.recording import Recording, Run
from sims.recording.recording_description import ModelFileReference
from sims.recording.recording_writer import write_recording

PLAIN, EXTENDED = "plain", "extended"
"""Names of the simulators in which tuners are compared: the original and the extended one."""
MODEL_LABELS = (PLAIN, EXTENDED)


def write_calibration_recording(experiment: Experiment, salt: str, path: Path) -> Array:
    """Write the calibration recording, from which explain extends the simulator.

    It contains runs of the true system. The true parameters are drawn uniformly from the training
    ranges. The first runs are for fitting, the last ones are held out.

    Args:
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
        salt: salt from which the recording is drawn.
        path: CSV file of the recording.

    Returns:
        True parameters, (p,).
    """
    problem = TuningProblem(experiment, salt)
    calibration = experiment.calibration or CalibrationConfig()
    streams = TargetStreams(salt, experiment.name, "calibration", 0)
    # Training ranges in the unit cube, in which every parameter's bounds are 0 and 1.
    low, high = problem.cube.training
    point = streams.get_stream("truth").uniform(low, high, size=problem.cube.dim)
    # The true system (`world`) has the first of the tuned parameters.
    theta = problem.cube.to_physical(point[None])[:, : len(problem.world.parameters)]
    initial = {**experiment.initial, **calibration.initial}
    inputs = {**experiment.inputs, **calibration.inputs}
    names = [channel.name for channel in problem.channels]
    runs = []
    for run_index in range(calibration.runs):
        scene = targets.draw_scenario(
            experiment, streams.get_held_out_stream(run_index), initial, inputs
        )
        noise_free = problem.world.simulate(theta, scene)[0]  # (T, C); theta has one row
        # Each run has its own stream of sensor noise.
        rng = TargetStreams(salt, experiment.name, "calibration", 1 + run_index).get_stream("noise")
        measured = noise_free + problem.noise * rng.standard_normal(noise_free.shape)
        channels = dict(zip(names, np.ascontiguousarray(measured.T), strict=True))
        runs.append(
            Run(
                name=str(run_index + 1),  # runs are named from 1
                times=scene.times,
                channels=channels,
                inputs=scene.inputs,
                constants=scene.constants,
                initial={},
                held_out=run_index >= calibration.runs - calibration.held_out,
            )
        )
    # The recording names the simulator to be extended, not the true system.
    kind = type(problem.simulator)
    noise = {c.name: float(s) for c, s in zip(problem.channels, problem.noise, strict=True) if s}
    constants = problem.simulator.constant_values
    title = f"{experiment.name}, calibration"
    model = _make_model_reference(experiment)
    recording = Recording(path, kind.name, title, constants, noise, tuple(runs), model=model)
    write_recording(path, recording, kind, digits=9)
    problem.close()
    parameters: Array = theta[0]
    return parameters


def _make_model_reference(experiment: Experiment) -> ModelFileReference | None:
    """Make the reference to the model file of an experiment's robot; None for other systems.

    Args:
        experiment: the experiment, with the model file, added actuators and free numbers.
    """
    if not experiment.model:
        return None
    return ModelFileReference(
        find_model(experiment.model, experiment.name),
        dict(experiment.actuators),
        {},
        experiment.free,
    )
