"""The command `simgap train`: trains a learned tuner ahead, into the cache that comparisons use."""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from bench.commands.options import add_plugin

if TYPE_CHECKING:
    from bench.problem.experiment import Entry, Experiment
    from methods.base import Practice

HEAD = ("seed", "stage", "epoch", "training_loss", "held_out_loss")
_HELD_OUT = 160
"""Simulations that the held-out loss is measured with, apart from the training budget."""


def add_train(parser: argparse.ArgumentParser) -> None:
    """The options of `simgap train`."""
    parser.add_argument(
        "tuner",
        metavar="TUNER",
        help="a learned tuner, by registered name or the experiment's label",
    )
    parser.add_argument("simulator", metavar="SIMULATOR", help="see `simgap list simulators`")
    parser.add_argument(
        "--experiment",
        metavar="NAME",
        help="whose settings to train in: a name or TOML file (default: the only one)",
    )
    parser.add_argument(
        "--budget", type=int, metavar="N", help="simulations to learn from (default: its own)"
    )
    parser.add_argument(
        "--seeds", type=int, metavar="N", help="trainings, each from its own seed (default: all)"
    )
    parser.add_argument(
        "--again", action="store_true", help="train although there are weights, and replace them"
    )
    parser.add_argument(
        "--out", metavar="DIR", type=Path, help="folder of losses (default: below results/train)"
    )
    add_plugin(parser, "of them")
    parser.set_defaults(command=_train)


def _train(options: argparse.Namespace) -> int:
    from bench.registry import load_plugins
    from bench.runs.runner import seeds_of
    from bench.runs.training import train

    load_plugins(options.plugin)
    experiment, entry = chosen(options)
    told = _Told(experiment)
    for seed in range(options.seeds or seeds_of(experiment, entry)):
        with told.bars(f"{entry.label} seed {seed}", seed):
            made = train(experiment, entry, seed, told, options.again)
        how = "trained earlier with" if made.found else "trained with"
        print(f"{made.path}: {how} {made.simulations} simulations in {made.seconds:.1f} s")
    if told.rows:
        folder = options.out or Path("results", "train", f"{entry.label}-{experiment.name}")
        for path in told.write(
            folder, f"{entry.label} on {experiment.name}, {made.simulations} simulations"
        ):
            print(path)
    print(f"found by: simgap compare {options.experiment or experiment.name}{_budget(options)}")
    return 0


def _budget(options: argparse.Namespace) -> str:
    return f" --training-budget {options.budget}" if options.budget else ""


def chosen(options: argparse.Namespace) -> tuple[Experiment, Entry]:
    """The experiment and the entry to train.

    Raises:
        InputError: they do not go together, the tuner does not learn, or a number is not positive.
    """
    from bench.problem.experiment import Entry, load, names
    from bench.registry import simulators, tuners
    from sims.base import InputError

    for name in ("budget", "seeds"):
        if (value := getattr(options, name)) is not None and value < 1:
            raise InputError(f"--{name}: expected at least 1, found {value}")
    simulators.get(options.simulator)
    if options.experiment is None:
        fitting = [name for name in names() if load(name).simulator == options.simulator]
        if len(fitting) != 1:
            there = (
                f"there are: {', '.join(fitting)}"
                if fitting
                else "none of the project's fits; give a TOML file"
            )
            raise InputError(f"expected --experiment with simulator {options.simulator}; {there}")
        options.experiment = fitting[0]
    experiment = load(options.experiment).chosen(training_budget=options.budget)
    if experiment.simulator != options.simulator:
        raise InputError(
            f"experiment {experiment.name}: its simulator is {experiment.simulator}, not {options.simulator}"
        )
    entries = {entry.label: entry for entry in experiment.tuners}
    entry = entries.get(options.tuner, Entry(options.tuner, options.tuner))
    if not tuners.get(entry.tuner).learned:
        raise InputError(f"tuner {entry.label} does not learn: there is nothing to train")
    return experiment, entry


@dataclass
class _Told:
    """Looks on while a tuner trains: a progress bar on stderr, and the losses."""

    experiment: Experiment
    rows: list[tuple[int, str, int, float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._title, self._seed, self._stage = "", 0, ""
        self._step: Callable[[], object] = lambda: None
        self._close: Callable[[], None] = lambda: None

    @property
    def ground(self) -> Practice:
        """Simulations that only measure."""
        from bench.problem.problem import Problem

        return Problem(self.experiment).practice(_HELD_OUT)

    @contextmanager
    def bars(self, title: str, seed: int) -> Iterator[None]:
        """Shows progress bars of one training, one for each stage."""
        self._title, self._seed, self._stage = title, seed, ""
        try:
            yield
        finally:
            self._close()

    def epoch(self, stage: str, epoch: int, epochs: int, loss: float, held_out: float) -> None:
        """Note one pass over the data."""
        from tqdm import tqdm

        if stage != self._stage:
            self._close()
            self._stage = stage
            pause = 0.2 if sys.stderr.isatty() else 30.0  # a log wants few lines
            title = f"{self._title}, {stage}"
            bar = tqdm(
                total=epochs,
                desc=title,
                unit="epoch",
                file=sys.stderr,
                dynamic_ncols=True,
                mininterval=pause,
            )
            self._step, self._close = bar.update, bar.close
        self.rows.append((self._seed, stage, epoch, loss, held_out))
        self._step()

    def write(self, folder: Path, title: str) -> list[Path]:
        """Write the losses as a table and a figure; returns what was written.

        Raises:
            InputError: the folder cannot be made.
        """
        from bench.figures.training import draw
        from sims.base import InputError

        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--out {folder}: cannot be made ({error.strerror})") from None
        table = folder / "loss.csv"
        with table.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([HEAD, *self.rows])
        return [table, draw(folder, title, self.rows)]
