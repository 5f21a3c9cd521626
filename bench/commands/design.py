"""The command `simgap design`."""

from __future__ import annotations

import argparse

from bench.commands.answer import WRONG, Answer, Say
from bench.commands.options import add_model, add_plugin, names, place, positive, seconds


def add_design(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap design`."""
    parser.add_argument(
        "recordings",
        metavar="RECORDING.csv",
        type=place,
        nargs="+",
        help="what there is so far, as for `simgap explain`",
    )
    parser.add_argument(
        "--system", metavar="NAME", help="take it for this system, whatever the .toml says"
    )
    add_model(parser)
    parser.add_argument(
        "--out",
        metavar="NAME.csv",
        type=place,
        required=True,
        help="commands to write, a new file: t in s and a column for each input",
    )
    parser.add_argument(
        "--seconds",
        type=seconds,
        metavar="S",
        default=4.0,
        help="how long the next run is to last (default: 4)",
    )
    parser.add_argument(
        "--longest",
        type=seconds,
        metavar="S",
        help="how long it may last where that does not settle what is open (default: five times)",
    )
    parser.add_argument("--free", metavar="A,B,...", default="", help="as for `simgap explain`")
    parser.add_argument("--jobs", type=positive, metavar="N", help="processes that work at once")
    add_plugin(parser, "systems")
    parser.set_defaults(command=_design)


def _design(options: argparse.Namespace, say: Say) -> Answer:
    from bench.api.design import design
    from bench.commands.interrupts import Interrupts
    from bench.commands.search_progress import ProgressDisplay
    from bench.registry import load_plugins
    from sims.recording.write import refuse_existing

    load_plugins(options.plugin)
    refuse_existing([options.out])
    display = ProgressDisplay(silent=options.json, hint=False)
    with display, Interrupts(display.note) as interrupts:
        proposed = design(
            options.recordings,
            seconds=options.seconds,
            longest=options.longest,
            system=options.system,
            model=options.model,
            free=names(options.free),
            jobs=options.jobs,
            say=display.note,
            stop=interrupts.asked,
            listener=display,
        )
    say(str(proposed.explanation))
    for line in proposed.lines():
        say(line)
    document = {
        "verdict": proposed.explanation.answer.document(),
        "design": None if proposed.design is None else proposed.design.document(),
        "says": proposed.lines(),
        "commands": None if proposed.design is None else options.out,
    }
    if proposed.design is None:
        return Answer(document, WRONG)
    proposed.write(options.out)
    say(f"commands {options.out}")
    return Answer(document)
