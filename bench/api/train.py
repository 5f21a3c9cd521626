"""Trains a learned tuner ahead, into the cache that comparisons use, and keeps the losses."""

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
"""Simulations that the held-out loss is measured with, apart from the training budget."""


def choose(
    tuner: str,
    simulator: str,
    experiment: str | None = None,
    budget: int | None = None,
    plugins: Sequence[str | Path] = (),
    trust: bool = False,
) -> tuple[Experiment, Entry]:
    """The experiment and the entry to train.

    Args:
        tuner: registered name, or the experiment's label.
        simulator: registered name; or the name of an experiment, whose simulator is then meant.
        experiment: name or TOML file; where None, the project's default experiment of the
            simulator (`default_experiment`).
        budget: simulations to learn from; the experiment's where None.
        plugins: plugin files that they need.
        trust: train it inside the harness, for comparisons that do likewise.

    Raises:
        InputError: they do not go together, or the tuner does not learn.
    """
    if experiment is None and simulator in set(names()) - set(simulators.names()):
        experiment = simulator
        simulator = load(experiment).simulator
    # A robot's simulator is registered nowhere: its experiment alone knows it.
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
    """Train, or find trained; see `bench.runs.training.train`.

    Raises:
        TooFewError: the training budget does not last.
    """
    lesson = Lesson(entry, seed)
    if not experiment.trusted:
        lesson = Lesson(entry, seed, tuned_of(entry), (str(folder().resolve()),))
    try:
        return train(experiment, lesson, watch, again)
    except EndedError as ended:
        # Of what went wrong in the tuner's process its name has come here, and its words.
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
"""By simulator the experiment in whose settings `simgap train` trains, where several of the project
tune it.
"""


def default_experiment(simulator: str) -> str:
    """Return the name of the experiment in whose settings a simulator's tuners are trained.

    It is the default of `DEFAULT_EXPERIMENTS`, else the only experiment of the project that tunes
    the simulator. Studies of a missing effect, which compare simulators too, do not count.

    Raises:
        InputError: no experiment trains this simulator, or several do and none is the default.
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
    """Looks on while a tuner trains, and keeps the losses; see `methods.base.Watch`.

    Attributes:
        experiment: in which it trains.
        start: begins to show the progress of a stage: title, steps; gives what advances it.
        rows: as `HEAD`.
    """

    experiment: Experiment
    start: Progress
    rows: list[tuple[int, str, int, float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.begin("", 0)

    def begin(self, title: str, seed: int) -> None:
        """What is trained from now on."""
        self._title, self._seed, self._stage = title, seed, ""

    @property
    def ground(self) -> Practice:
        """Simulations that only measure."""
        return Problem(self.experiment).practice(_HELD_OUT)

    def epoch(self, stage: str, epoch: int, epochs: int, loss: float, held_out: float) -> None:
        """Note one pass over the data."""
        if stage != self._stage:
            self._stage = stage
            self._step = self.start(f"{self._title}, {stage}", epochs)
        self.rows.append((self._seed, stage, epoch, loss, held_out))
        self._step()

    def write(self, folder: Path, title: str) -> list[Path]:
        """Write the losses as a table and a figure; returns what was written.

        Raises:
            InputError: the folder cannot be made.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be made ({error.strerror})") from None
        text = io.StringIO(newline="")
        csv.writer(text).writerows([HEAD, *self.rows])
        files.write(folder / "loss.csv", text.getvalue())
        return [folder / "loss.csv", draw(folder, title, self.rows)]
