"""Train a learned tuner ahead into the cache that comparisons use, and record its losses."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bench.figures.training import draw
from bench.problem.experiment import Entry, Experiment, load, names
from bench.problem.problem import Problem
from bench.problem.robots import completed
from bench.registry import simulators, tuners
from bench.runs.housing import tuned_of
from bench.runs.runner import Progress
from bench.runs.survey import admit, unbuildable
from bench.runs.training import Lesson, Training, folder, train
from bench.sealing.ended import EndedError
from methods.base import Practice, Watch
from methods.learning.rehearsal import TooFewError
from sims import files
from sims.base import InputError

HEAD = ("seed", "stage", "epoch", "training_loss", "held_out_loss")
"""Columns of loss.csv."""
_HELD_OUT = 160
"""Number of simulations for the held-out loss, in addition to the training budget."""


def choose(
    tuner: str,
    simulator: str,
    experiment: str | None = None,
    budget: int | None = None,
    plugins: Sequence[str | Path] = (),
    trust: bool = False,
) -> tuple[Experiment, Entry]:
    """Select the experiment and the tuner to train.

    Args:
        tuner: Registered name of a tuner, or its label in the experiment.
        simulator: Registered name of a simulator; or the name of an experiment, to use its
            simulator.
        experiment: Name or TOML file of an experiment; None for the project's default experiment of
            the simulator (`default_experiment`).
        budget: Number of training simulations; None for the experiment's.
        plugins: Plugin files that they need.
        trust: Train the tuner inside the harness, for comparisons that do likewise.

    Raises:
        InputError: The arguments do not fit together, or the tuner does not learn.
    """
    if experiment is None and simulator in set(names()) - set(simulators.names()):
        experiment = simulator
        simulator = load(experiment).simulator
    # A robot's simulator is not registered; it is defined by its experiment.
    robotic = experiment is not None and load(experiment).model
    if not plugins and not robotic:
        simulators.get(simulator)
    chosen = load(experiment or default_experiment(simulator)).chosen(training_budget=budget)
    chosen = chosen.chosen(trusted=trust or chosen.trusted)
    admit([str(Path(plugin).resolve()) for plugin in plugins], chosen)
    chosen = completed(chosen)
    if not chosen.model:
        simulators.get(simulator)
    if chosen.simulator != simulator:
        raise InputError(
            f"experiment {chosen.name}: its simulator is {chosen.simulator}, not {simulator}"
        )
    entries = {entry.label: entry for entry in chosen.tuners}
    entry = entries.get(tuner, Entry(tuner, tuner))
    if not tuners.get(entry.tuner).learned:
        raise InputError(f"tuner {entry.label} does not learn: there is nothing to train")
    if not chosen.trusted:
        unbuildable(entry)
    return chosen, entry


def taught(
    experiment: Experiment, entry: Entry, seed: int, watch: Watch | None, again: bool
) -> Training:
    """Train a tuner, or load its earlier training; see `bench.runs.training.train`.

    Args:
        experiment: Experiment in whose settings it is trained.
        entry: Tuner to train.
        seed: Seed of the training.
        watch: Callback that observes the training.
        again: Whether to train even if there is an earlier training.

    Raises:
        TooFewError: The training budget is too small.
    """
    lesson = Lesson(entry, seed)
    if not experiment.trusted:
        lesson = Lesson(entry, seed, tuned_of(entry), (str(folder().resolve()),))
    try:
        return train(experiment, lesson, watch, again)
    except EndedError as ended:
        # The error from the isolated process arrives as text: its name and its message.
        name, _, said = "".join(ended.reason.strip().splitlines()[-1:]).partition(": ")
        if name.endswith(TooFewError.__name__):
            raise TooFewError(said) from None
        raise


DEFAULT_EXPERIMENTS: Mapping[str, str] = {
    "arm": "arm-swing",
    "ball": "ball-drop",
    "pendulum": "pendulum-swing",
    "servo": "servo-step",
}
"""Experiment in whose settings `simgap train` trains, by simulator with several experiments."""


def default_experiment(simulator: str) -> str:
    """Return the name of the experiment in whose settings a simulator's tuners are trained.

    It is the entry of `DEFAULT_EXPERIMENTS`, else the only experiment of the project that tunes the
    simulator. Studies of a missing effect, which compare simulators, too, do not count.

    Raises:
        InputError: No experiment tunes this simulator, or several do and none is the default.
    """
    if simulator in DEFAULT_EXPERIMENTS:
        return DEFAULT_EXPERIMENTS[simulator]
    shipped = [load(name) for name in names()]
    fitting = [e.name for e in shipped if e.simulator == simulator and e.calibration is None]
    if len(fitting) == 1:
        return fitting[0]
    there = f"choose one with --experiment: {', '.join(fitting)}"
    if not fitting:
        there = "none of the project tunes it; give a TOML file with --experiment FILE"
    raise InputError(f"simulator {simulator}: expected an experiment that tunes it; {there}")


@dataclass
class Losses:
    """Training callback that records the losses; see `methods.base.Watch`.

    Attributes:
        experiment: Experiment in whose settings the tuner is trained.
        start: Starts a progress bar with a title and a number of steps; returns the function that
            advances it.
        rows: Rows of loss.csv, see `HEAD`.
    """

    experiment: Experiment
    start: Progress
    rows: list[tuple[int, str, int, float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.begin("", 0)

    def begin(self, title: str, seed: int) -> None:
        """Set the title and seed of the next training."""
        self._title, self._seed, self._stage = title, seed, ""

    @property
    def ground(self) -> Practice:
        """Counted simulator for evaluating the held-out loss."""
        return Problem(self.experiment).practice(_HELD_OUT)

    def epoch(self, stage: str, epoch: int, epochs: int, loss: float, held_out: float) -> None:
        """Record one pass over the training data.

        Args:
            stage: Name of the training stage.
            epoch: Number of the pass.
            epochs: Number of passes in the stage.
            loss: Training loss.
            held_out: Held-out loss.
        """
        if stage != self._stage:
            self._stage = stage
            self._step = self.start(f"{self._title}, {stage}", epochs)
        self.rows.append((self._seed, stage, epoch, loss, held_out))
        self._step()

    def write(self, folder: Path, title: str) -> list[Path]:
        """Write the losses as a table and a figure.

        Args:
            folder: Folder to write; made if missing.
            title: Title of the figure.

        Returns:
            Paths of the written files.

        Raises:
            InputError: The folder cannot be made.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be made ({error.strerror})") from None
        text = io.StringIO(newline="")
        csv.writer(text).writerows([HEAD, *self.rows])
        files.write(folder / "loss.csv", text.getvalue())
        return [folder / "loss.csv", draw(folder, title, self.rows)]
