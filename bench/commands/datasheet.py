"""The command `simgap datasheet`."""

from __future__ import annotations

import argparse

from bench.commands.answer import Answer, Say
from bench.commands.interrupts import Interrupts
from bench.commands.options import (
    add_force,
    add_model,
    add_pdf,
    add_plugin,
    names,
    place,
    positive,
    seconds,
)


def add_datasheet(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap datasheet`."""
    parser.add_argument(
        "recordings",
        metavar="RECORDING.csv",
        type=place,
        nargs="+",
        help="the logs, as for `simgap explain`",
    )
    parser.add_argument(
        "--joint", metavar="NAME", help="of a robot of several joints: the one that the sheet is of"
    )
    parser.add_argument(
        "--name", metavar="TEXT", help="on the sheet (default: the joint's, or the system's)"
    )
    parser.add_argument(
        "--from",
        dest="explained",
        metavar="FOLDER",
        type=place,
        help="what `simgap explain` has written about these logs (default: they are explained now, "
        "into the folder explained in --out)",
    )
    parser.add_argument(
        "--out", metavar="DIR", type=place, required=True, help="folder to write, a new one"
    )
    parser.add_argument(
        "--system", metavar="NAME", help="take it for this system, whatever the .toml says"
    )
    add_model(parser)
    parser.add_argument("--free", metavar="A,B,...", default="", help="as for `simgap explain`")
    parser.add_argument(
        "--budget", type=seconds, metavar="S", help="seconds, as for `simgap explain`"
    )
    parser.add_argument("--jobs", type=positive, metavar="N", help="processes that work at once")
    add_pdf(parser)
    add_plugin(parser, "systems")
    add_force(parser)
    parser.set_defaults(command=_datasheet)


def _datasheet(options: argparse.Namespace, say: Say) -> Answer:
    """Make a data sheet; explain the logs first unless an explanation is given."""
    from bench.api.datasheet import datasheet, refuse_joint
    from bench.api.explain import explain
    from bench.commands.search_progress import ProgressDisplay
    from bench.registry import load_plugins
    from sims.files import refuse_full

    load_plugins(options.plugin)
    # Check this before the work, which may take minutes.
    refuse_full(options.out)
    logs, free, source = options.recordings, names(options.free), options.explained
    display = ProgressDisplay(options.budget, silent=options.json)
    with display, Interrupts(display.note) as interrupts:
        if source is None:
            refuse_joint(logs, options.joint, options.system, options.model, free)
            source = explain(
                logs,
                system=options.system,
                model=options.model,
                free=free,
                force=options.force,
                budget=options.budget,
                jobs=options.jobs,
                say=display.note,
                stop=interrupts.asked,
                listener=display,
            )
            # The explanation took minutes, so it is written even if the data sheet fails.
            source.write(options.out / "explained", pdf=options.pdf)
        display.finish("computing what these data would have shown")
        made = datasheet(
            logs,
            joint=options.joint,
            name=options.name,
            explained=source,
            system=options.system,
            model=options.model,
        )
    paths = made.write(options.out)
    for line in made.lines():
        say(line)
    say("")
    for path in paths:
        say(f"{path.suffix[1:]:7} {path}")
    return Answer({"sheet": made.document(), "files": paths})
