"""The command `simgap datasheet`."""

from __future__ import annotations

import argparse
from dataclasses import fields

from bench.cli.output import CommandResult, PrintLine
from bench.cli.shared_options import (
    add_options,
    add_out_option,
    add_pdf,
    add_plugin_option,
    add_recordings_argument,
    collect_options,
    parse_path,
)


def add_datasheet_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap datasheet`."""
    from bench.api.datasheet import DatasheetOptions

    add_recordings_argument(parser, "the logs, as for `simgap explain`")
    add_out_option(parser, "new folder for the data sheet", required=True)
    add_options(parser, DatasheetOptions)
    parser.add_argument(
        "--from",
        dest="explained",
        metavar="FOLDER",
        type=parse_path,
        help="output folder of `simgap explain` for these logs (default: explain them now, into "
        "the folder explained in --out)",
    )
    add_pdf(parser)
    add_plugin_option(parser, "systems")
    parser.set_defaults(command=_run_datasheet)


def _run_datasheet(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap datasheet`: make a data sheet; first explain the logs unless that is done.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.
    """
    from bench.api.datasheet import DatasheetOptions, check_joint_exists, datasheet
    from bench.api.explain import explain
    from bench.cli.progress_display import ProgressDisplay
    from bench.core.plugin_registries import load_plugins
    from bench.diagnosis.explain_options import ExplainOptions
    from sims.core.argument_checks import check_options
    from sims.core.files import check_folder_empty

    load_plugins(options.plugin)
    # Check this before the work, which may take minutes.
    check_folder_empty(options.out)
    display = ProgressDisplay(options.budget, silent=options.json)
    # The arguments let the search print notes, show its progress and be stopped by Ctrl-C.
    with display, display.handle_interrupts() as arguments:
        settings = collect_options(options, DatasheetOptions) | arguments
        sheet = check_options(DatasheetOptions, settings)
        if sheet.explained is None:
            check_joint_exists(options.recordings, sheet)
            search = {field.name: getattr(sheet, field.name) for field in fields(ExplainOptions)}
            explained = explain(options.recordings, **search)
            # The explanation took minutes, so it is written even if the data sheet fails.
            explained.write(options.out / "explained", pdf=options.pdf)
            settings["explained"] = explained
        display.finish("computing detection limits")
        data_sheet = datasheet(options.recordings, **settings)
    paths = data_sheet.write(options.out)
    for line in data_sheet.lines():
        print_line(line)
    print_line("")
    for path in paths:
        print_line(f"{path.suffix[1:]:7} {path}")
    return CommandResult({"sheet": data_sheet.document(), "files": paths})
