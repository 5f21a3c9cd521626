"""The command `simgap train`."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.output import CommandResult, PrintLine
from bench.cli.shared_options import (
    add_force_option,
    add_pdf,
    add_plugin_option,
    parse_path,
    parse_positive_int,
)


def add_train_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap train`."""
    parser.add_argument(
        "tuner",
        metavar="TUNER",
        help="a learned tuner, by registered name or the experiment's label",
    )
    parser.add_argument(
        "simulator",
        metavar="SIMULATOR",
        help="see `simgap list simulators`; or the name of an experiment, to train in its settings",
    )
    parser.add_argument(
        "--experiment",
        metavar="NAME",
        help="train in the settings of this experiment, a name or TOML file (default: the "
        "simulator's own, which is printed)",
    )
    parser.add_argument(
        "--budget",
        type=parse_positive_int,
        metavar="N",
        help="number of training simulations (default: that of the tuner)",
    )
    parser.add_argument(
        "--seeds",
        type=parse_positive_int,
        metavar="N",
        help="trainings, each from its own seed (default: all)",
    )
    parser.add_argument(
        "--again", action="store_true", help="train even if weights exist, and replace them"
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=parse_path,
        help="folder of losses (default: below results/train)",
    )
    add_pdf(parser)
    add_plugin_option(parser, "tuners and simulators")
    parser.add_argument(
        "--trust",
        action="store_true",
        help="run the tuners without isolation: faster, but they could read the true parameters, "
        "and the results are marked",
    )
    add_force_option(parser)
    parser.set_defaults(command=_run_train)


def _run_train(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap train`: train a learned tuner for each seed, before a comparison needs it.

    The weights are stored in the cache, where `simgap compare` finds them. The losses of each epoch
    are drawn, unless all weights were in the cache already.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and its exit code (0).
    """
    from bench.api.train import LossRecorder, run_training, select_training
    from bench.benchmark.runner.comparison_resources import check_training_size
    from bench.benchmark.runner.experiment_runner import count_seeds
    from bench.cli.progress_display import ProgressBars
    from methods.learning.training_data import TrainingBudgetTooSmallError
    from sims.core.simulator import InputError

    experiment, entry = select_training(
        options.tuner,
        options.simulator,
        options.experiment,
        options.budget,
        options.plugin,
        options.trust,
    )
    seeds = options.seeds or count_seeds(experiment, entry)
    check_training_size(experiment, entry, seeds, options.force)
    if options.experiment is None:
        print_line(f"experiment: {experiment.name}")
    trained, files = [], []
    with ProgressBars("epoch") as bars:
        losses = LossRecorder(experiment, bars.start_bar)
        for seed in range(seeds):
            losses.start_training(f"{entry.label} seed {seed}", seed)
            try:
                training = run_training(experiment, entry, seed, losses, options.again)
            except TrainingBudgetTooSmallError as error:
                raise InputError(f"tuner {entry.label}: {error}; give a larger --budget") from None
            origin = "trained earlier with" if training.was_cached else "trained with"
            cost = f"{training.simulations} simulations in {training.seconds:.1f} s"
            print_line(f"{training.path}: {origin} {cost}")
            trained.append(
                {
                    "seed": seed,
                    "weights": training.path,
                    "found": training.was_cached,
                    "simulations": training.simulations,
                    "seconds": training.seconds,
                }
            )
    if losses.rows:
        folder = options.out or Path("results", "train", f"{entry.label}-{experiment.name}")
        title = f"{entry.label} on {experiment.name}, {training.simulations} simulations"
        files = losses.write(folder, title)
        for path in files:
            print_line(str(path))
    budget = f" --training-budget {options.budget}" if options.budget else ""
    trust = " --trust" if options.trust else ""
    command = f"simgap compare {options.experiment or experiment.name}{budget}{trust}"
    print_line(f"used by: {command}")
    document = {"tuner": entry.label, "experiment": experiment.name, "found_by": command}
    return CommandResult({**document, "trainings": trained, "files": files})
