"""Train a learned tuner ahead into the cache that comparisons use, and record its losses."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bench.benchmark.isolation.process_errors import RunEndedError
from bench.benchmark.problem.experiment_config import (
    Experiment,
    TunerEntry,
    list_experiment_names,
    load_experiment,
)
from bench.benchmark.problem.robot_experiment import complete_robot_experiment
from bench.benchmark.problem.training_simulator import CountedTrainingSimulator
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.runner.experiment_runner import ProgressFactory
from bench.benchmark.runner.plugin_inspection import (
    load_plugins_for_experiment,
    must_build_isolated,
)
from bench.benchmark.runner.trained_weights import TrainingResult, get_weights_folder
from bench.benchmark.runner.tuner_process_start import make_tuner_spec
from bench.benchmark.runner.tuner_training import TrainingRequest, train_or_load
from bench.core.plugin_registries import simulators, tuners
from bench.figures.loss_figure import LossRow, write_loss_figure
from methods.learning.training_data import TrainingBudgetTooSmallError
from methods.tuner import TrainingCallback, TrainingSimulator
from sims.core import files
from sims.core.simulator import InputError

LOSS_COLUMNS = ("seed", "stage", "epoch", "training_loss", "held_out_loss")
"""Columns of loss.csv."""
_HELD_OUT_SIMULATIONS = 160
"""Number of simulations for the held-out loss, in addition to the training budget."""


def select_training(
    tuner: str,
    simulator: str,
    experiment: str | None = None,
    budget: int | None = None,
    plugins: Sequence[str | Path] = (),
    trust: bool = False,
) -> tuple[Experiment, TunerEntry]:
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

    Returns:
        The experiment, and the entry of the tuner in it.

    Raises:
        InputError: The arguments do not fit together, or the tuner does not learn.
    """
    if experiment is None and simulator in set(list_experiment_names()) - set(simulators.names()):
        experiment = simulator
        simulator = load_experiment(experiment).simulator
    # A robot's simulator is not registered; its experiment names the model file that defines it.
    has_model = experiment is not None and load_experiment(experiment).model
    # A simulator of a plugin is only known when the plugin is loaded, below.
    if not plugins and not has_model:
        simulators.get(simulator)  # raises an error for an unknown name
    chosen_experiment = load_experiment(experiment or default_experiment(simulator)).chosen(
        training_budget=budget
    )
    chosen_experiment = chosen_experiment.chosen(trusted=trust or chosen_experiment.trusted)
    load_plugins_for_experiment(
        [str(Path(plugin).resolve()) for plugin in plugins], chosen_experiment
    )
    chosen_experiment = complete_robot_experiment(chosen_experiment)
    if not chosen_experiment.model:
        simulators.get(simulator)  # a plugin may not define it either
    if chosen_experiment.simulator != simulator:
        raise InputError(
            f"experiment {chosen_experiment.name}: its simulator is {chosen_experiment.simulator}, "
            f"not {simulator}"
        )
    # A tuner that the experiment does not list is trained with its default options.
    entries = {entry.label: entry for entry in chosen_experiment.tuners}
    entry = entries.get(tuner, TunerEntry(tuner, tuner))
    if not tuners.get(entry.tuner).learned:
        raise InputError(f"tuner {entry.label} does not learn: there is nothing to train")
    if not chosen_experiment.trusted:
        must_build_isolated(entry)  # raises an error for wrong options, before the training
    return chosen_experiment, entry


def run_training(
    experiment: Experiment,
    entry: TunerEntry,
    seed: int,
    watch: TrainingCallback | None,
    again: bool,
) -> TrainingResult:
    """Train a tuner into the cache that comparisons use, or load its earlier training from there.

    It runs in an isolated process unless the experiment trusts its tuners.

    Args:
        experiment: Experiment in whose settings it is trained.
        entry: Tuner to train.
        seed: Seed of the training.
        watch: Callback that observes the training.
        again: Whether to train even if there is an earlier training.

    Returns:
        File of the trained weights, and simulations and seconds of the training.

    Raises:
        TrainingBudgetTooSmallError: The training budget is too small.
        RunEndedError: The tuner failed in its isolated process.
    """
    # Without a specification the tuner trains in this process. An isolated process must not see the
    # folder of weights, which has earlier trainings.
    request = TrainingRequest(entry, seed)
    if not experiment.trusted:
        request = TrainingRequest(
            entry, seed, make_tuner_spec(entry), (str(get_weights_folder().resolve()),)
        )
    try:
        return train_or_load(experiment, request, watch, again)
    except RunEndedError as ended:
        # The error from the isolated process arrives as text: its name and its message.
        name, _, message = "".join(ended.reason.strip().splitlines()[-1:]).partition(": ")
        if name.endswith(TrainingBudgetTooSmallError.__name__):
            raise TrainingBudgetTooSmallError(message) from None
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
    shipped = [load_experiment(name) for name in list_experiment_names()]
    fitting = [
        experiment.name
        for experiment in shipped
        if experiment.simulator == simulator and experiment.calibration is None
    ]
    if len(fitting) == 1:
        return fitting[0]
    hint = f"choose one with --experiment: {', '.join(fitting)}"
    if not fitting:
        hint = "no built-in experiment tunes it; give a TOML file with --experiment FILE"
    raise InputError(f"simulator {simulator}: expected an experiment that tunes it; {hint}")


@dataclass
class LossRecorder:
    """Training callback that records the losses; see `methods.tuner.TrainingCallback`.

    Attributes:
        experiment: Experiment in whose settings the tuner is trained.
        start: Starts a progress bar with a title and a number of steps; returns the function that
            advances it.
        rows: Rows of loss.csv, see `LOSS_COLUMNS`.
    """

    experiment: Experiment
    start: ProgressFactory
    rows: list[LossRow] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.start_training("", 0)

    def start_training(self, title: str, seed: int) -> None:
        """Set the title and seed of the next training."""
        self._title, self._seed, self._stage = title, seed, ""

    @property
    def ground(self) -> TrainingSimulator:
        """Counted simulator for evaluating the held-out loss."""
        return CountedTrainingSimulator(TuningProblem(self.experiment), _HELD_OUT_SIMULATIONS)

    def epoch(self, stage: str, epoch: int, epochs: int, loss: float, held_out: float) -> None:
        """Record one pass over the training data.

        Args:
            stage: Name of the training stage.
            epoch: Number of the pass.
            epochs: Number of passes in the stage.
            loss: Training loss.
            held_out: Held-out loss.
        """
        # A new stage gets a progress bar of its own.
        if stage != self._stage:
            self._stage = stage
            self._step = self.start(f"{self._title}, {stage}", epochs)
        self.rows.append(LossRow(self._seed, stage, epoch, loss, held_out))
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
        csv.writer(text).writerows([LOSS_COLUMNS, *self.rows])
        files.write_atomically(folder / "loss.csv", text.getvalue())
        return [folder / "loss.csv", write_loss_figure(folder, title, self.rows)]
