"""The experiment that a robot's model file and a recording stand for, without a file of their own
that says so.
"""

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
"""That are compared where nobody says which."""
TARGETS, BUDGET, TRAINING = 5, 50, 480
"""Starts or targets, simulations on each, and those that a learned tuner may learn from."""
NOISE = 1e-3
"""rad or m, of the encoders of simulated targets."""
HELD_OUT = 2
"""Unseen runs of each simulated target."""


def asked(
    model: str | Path | None, recording: str | Path | None, free: Sequence[str]
) -> Experiment:
    """The experiment that tunes numbers of a model file to a recording, or to targets that it
    simulates itself where there is none.

    Args:
        model: MJCF or URDF; the recording's own where None.
        recording: its table.
        free: numbers of the model file, as ``damping@*``.

    Raises:
        InputError: neither names a model file, or there is no such number in it.
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
