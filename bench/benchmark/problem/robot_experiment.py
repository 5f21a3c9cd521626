"""Build an experiment from a robot's model file and a recording, without an experiment file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bench.benchmark.problem.experiment import (
    Experiment,
    HeldOutConfig,
    RecordingSource,
    check_name,
)
from bench.benchmark.problem.model_file_simulator import complete_robot_experiment
from bench.benchmark.problem.tuner_entries import TunerEntry
from sims.core.files import require_file
from sims.core.simulator import InputError
from sims.recording.recording_description import read_model_reference

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

    They are tuned to a recording, or to simulated targets if there is no recording.

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
