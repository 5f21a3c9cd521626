"""Build an experiment from a robot's model file and a recording, without an experiment file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bench.problem.entries import Entry
from bench.problem.experiment import Experiment, HeldOut, Source, plain_name
from bench.problem.robots import completed
from sims.base import InputError
from sims.files import require_file
from sims.recording.description import model_of

TUNERS = (
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
NOISE = 1e-3
"""Default encoder noise of simulated targets, standard deviation in rad or m."""
HELD_OUT = 2
"""Default number of held-out runs of each simulated target."""


def asked(
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
        stated = model_of(recording, file)
        file = stated.path if stated is not None else None
    if file is None:
        said = f"{recording}: its description" if recording is not None else "compare"
        raise InputError(f'{said}: expected model = "robot.xml" or --model FILE, found none')
    require_file(file)
    parts = [file.stem] if recording is None else [file.stem, Path(recording).stem]
    to = f"tuned to {Path(recording).name}" if recording is not None else "tuned to simulations"
    whole = Experiment(
        name=plain_name("-".join(parts)),
        title=f"{file.name}: {', '.join(free)}, {to}",
        simulator=plain_name(file.stem),
        model=str(file.resolve()),
        free=tuple(free),
        ranges=("in", "wide") if recording is None else ("real",),
        recording=None if recording is None else Source(str(Path(recording).resolve())),
        targets=TARGETS,
        budget=BUDGET,
        training_budget=TRAINING,
        held_out=HeldOut(HELD_OUT) if recording is None else None,
        tuners=tuple(Entry(name, name) for name in TUNERS),
    )
    whole = completed(whole)
    if recording is not None:
        return whole
    return whole.chosen(noise=dict.fromkeys(whole.observe, NOISE))
