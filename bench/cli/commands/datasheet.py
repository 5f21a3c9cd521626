"""The command `simgap datasheet`."""

from __future__ import annotations

import argparse

from bench.cli.interrupt_handler import InterruptHandler
from bench.cli.output import CommandResult, PrintLine
from bench.cli.shared_options import (
    add_force_option,
    add_model_option,
    add_pdf,
    add_plugin_option,
    parse_name_list,
    parse_path,
    parse_positive_int,
    parse_seconds,
)


def add_datasheet_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap datasheet`."""
    parser.add_argument(
        "recordings",
        metavar="RECORDING.csv",
        type=parse_path,
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
        type=parse_path,
        help="what `simgap explain` has written about these logs (default: they are explained now, "
        "into the folder explained in --out)",
    )
    parser.add_argument(
        "--out", metavar="DIR", type=parse_path, required=True, help="folder to write, a new one"
    )
    parser.add_argument(
        "--system", metavar="NAME", help="take it for this system, whatever the .toml says"
    )
    add_model_option(parser)
    parser.add_argument("--free", metavar="A,B,...", default="", help="as for `simgap explain`")
    parser.add_argument(
        "--budget", type=parse_seconds, metavar="S", help="seconds, as for `simgap explain`"
    )
    parser.add_argument(
        "--jobs", type=parse_positive_int, metavar="N", help="processes that work at once"
    )
    add_pdf(parser)
    add_plugin_option(parser, "systems")
    add_force_option(parser)
    parser.set_defaults(command=_run_datasheet)


def _run_datasheet(options: argparse.Namespace, say: PrintLine) -> CommandResult:
    """Make a data sheet; explain the logs first unless an explanation is given."""
    from bench.api.datasheet import check_joint_exists, datasheet
    from bench.api.explain import explain
    from bench.cli.search_progress import ProgressDisplay
    from bench.core.plugin_registries import load_plugins
    from sims.core.atomic_files import check_folder_empty

    load_plugins(options.plugin)
    # Check this before the work, which may take minutes.
    check_folder_empty(options.out)
    logs, free, source = options.recordings, parse_name_list(options.free), options.explained
    display = ProgressDisplay(options.budget, silent=options.json)
    with display, InterruptHandler(display.note) as interrupts:
        if source is None:
            check_joint_exists(logs, options.joint, options.system, options.model, free)
            source = explain(
                logs,
                system=options.system,
                model=options.model,
                free=free,
                force=options.force,
                budget=options.budget,
                jobs=options.jobs,
                say=display.note,
                stop=interrupts.is_stop_requested,
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
    return CommandResult({"sheet": made.document(), "files": paths})
