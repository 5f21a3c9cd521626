"""The command `simgap design`."""

from __future__ import annotations

import argparse

from bench.cli.output import EXIT_PROBLEMS_FOUND, CommandResult, PrintLine
from bench.cli.shared_options import (
    add_model_option,
    add_plugin_option,
    parse_name_list,
    parse_path,
    parse_positive_int,
    parse_seconds,
)


def add_design_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap design`."""
    parser.add_argument(
        "recordings",
        metavar="RECORDING.csv",
        type=parse_path,
        nargs="+",
        help="what there is so far, as for `simgap explain`",
    )
    parser.add_argument(
        "--system", metavar="NAME", help="take it for this system, whatever the .toml says"
    )
    add_model_option(parser)
    parser.add_argument(
        "--out",
        metavar="NAME.csv",
        type=parse_path,
        required=True,
        help="commands to write, a new file: t in s and a column for each input",
    )
    parser.add_argument(
        "--seconds",
        type=parse_seconds,
        metavar="S",
        default=4.0,
        help="how long the next run is to last (default: 4)",
    )
    parser.add_argument(
        "--longest",
        type=parse_seconds,
        metavar="S",
        help="how long it may last where that does not settle what is open (default: five times)",
    )
    parser.add_argument("--free", metavar="A,B,...", default="", help="as for `simgap explain`")
    parser.add_argument(
        "--jobs", type=parse_positive_int, metavar="N", help="processes that work at once"
    )
    add_plugin_option(parser, "systems")
    parser.set_defaults(command=_run_design)


def _run_design(options: argparse.Namespace, say: PrintLine) -> CommandResult:
    from bench.api.design import design
    from bench.cli.interrupt_handler import InterruptHandler
    from bench.cli.search_progress import ProgressDisplay
    from bench.core.plugin_registries import load_plugins
    from sims.recording.recording_writer import check_absent

    load_plugins(options.plugin)
    check_absent([options.out])
    display = ProgressDisplay(silent=options.json, hint=False)
    with display, InterruptHandler(display.note) as interrupts:
        proposed = design(
            options.recordings,
            seconds=options.seconds,
            longest=options.longest,
            system=options.system,
            model=options.model,
            free=parse_name_list(options.free),
            jobs=options.jobs,
            say=display.note,
            stop=interrupts.is_stop_requested,
            listener=display,
        )
    say(str(proposed.explanation))
    for line in proposed.lines():
        say(line)
    document = {
        "verdict": proposed.explanation.answer.to_document(),
        "design": None if proposed.design is None else proposed.design.to_document(),
        "says": proposed.lines(),
        "commands": None if proposed.design is None else options.out,
    }
    if proposed.design is None:
        return CommandResult(document, EXIT_PROBLEMS_FOUND)
    proposed.write(options.out)
    say(f"commands {options.out}")
    return CommandResult(document)
