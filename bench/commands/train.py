"""The command `simgap train`."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.commands.answer import Answer, Say
from bench.commands.options import add_force, add_pdf, add_plugin, add_trust, place, positive


def add_train(parser: argparse.ArgumentParser) -> None:
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
        "--budget", type=positive, metavar="N", help="simulations to learn from (default: its own)"
    )
    parser.add_argument(
        "--seeds",
        type=positive,
        metavar="N",
        help="trainings, each from its own seed (default: all)",
    )
    parser.add_argument(
        "--again", action="store_true", help="train although there are weights, and replace them"
    )
    parser.add_argument(
        "--out", metavar="DIR", type=place, help="folder of losses (default: below results/train)"
    )
    add_pdf(parser)
    add_plugin(parser, "of them")
    add_trust(parser)
    add_force(parser)
    parser.set_defaults(command=_train)


def _train(options: argparse.Namespace, say: Say) -> Answer:
    from bench.api.train import Losses, choose, taught
    from bench.commands.progress import Bars
    from bench.runs.runner import seeds_of
    from bench.runs.size import check_training
    from methods.learning.rehearsal import TooFewError
    from sims.base import InputError

    experiment, entry = choose(
        options.tuner,
        options.simulator,
        options.experiment,
        options.budget,
        options.plugin,
        options.trust,
    )
    seeds = options.seeds or seeds_of(experiment, entry)
    check_training(experiment, entry, seeds, options.force)
    if options.experiment is None:
        say(f"experiment: {experiment.name}")
    trained, files = [], []
    with Bars("epoch") as bars:
        losses = Losses(experiment, bars.start)
        for seed in range(seeds):
            losses.begin(f"{entry.label} seed {seed}", seed)
            try:
                training = taught(experiment, entry, seed, losses, options.again)
            except TooFewError as error:
                raise InputError(f"tuner {entry.label}: {error}; give a larger --budget") from None
            how = "trained earlier with" if training.found else "trained with"
            cost = f"{training.simulations} simulations in {training.seconds:.1f} s"
            say(f"{training.path}: {how} {cost}")
            trained.append(
                {
                    "seed": seed,
                    "weights": training.path,
                    "found": training.found,
                    "simulations": training.simulations,
                    "seconds": training.seconds,
                }
            )
    if losses.rows:
        folder = options.out or Path("results", "train", f"{entry.label}-{experiment.name}")
        title = f"{entry.label} on {experiment.name}, {training.simulations} simulations"
        files = losses.write(folder, title)
        for path in files:
            say(str(path))
    budget = f" --training-budget {options.budget}" if options.budget else ""
    trust = " --trust" if options.trust else ""
    command = f"simgap compare {options.experiment or experiment.name}{budget}{trust}"
    say(f"found by: {command}")
    told = {"tuner": entry.label, "experiment": experiment.name, "found_by": command}
    return Answer({**told, "trainings": trained, "files": files})
