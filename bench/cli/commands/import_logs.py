"""The command `simgap import`."""

from __future__ import annotations

import argparse

from bench.cli.output import CommandResult, PrintLine
from bench.cli.shared_options import add_options, add_out_option, collect_options, parse_path


def add_import_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap import`."""
    from bench.logs.importing.import_result import ImportOptions

    parser.add_argument(
        "logs",
        metavar="LOG",
        nargs="+",
        type=parse_path,
        help="files of one run (.csv, .tsv, .npz, .parquet, .pt, .hdf5), or folders or bags (ROS "
        "1, ROS 2, MCAP) of one run each, or datasets of LeRobot",
    )
    parser.add_argument(
        "--model",
        metavar="FILE",
        type=parse_path,
        required=True,
        help="model file of the robot, MJCF or URDF",
    )
    add_out_option(parser, "new file for the description", "NAME.toml", required=True)
    add_options(parser, ImportOptions)
    parser.set_defaults(command=_run_import)


def _run_import(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap import`: write a description of log files, from which simgap reads them.

    Everything that was guessed is printed, because the user should confirm it. The log files
    themselves are not copied.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and its exit code (0).
    """
    from bench.logs.importing.log_import import ImportRequest, import_logs

    imported = import_logs(**collect_options(options, ImportRequest))
    print_line(
        f"{options.out}: {len(imported.guessed)} guesses, each marked in the file; "
        "nothing was copied"
    )
    for text in imported.checks:
        print_line(f"check: {text}")
    for text in imported.guessed:
        print_line(f"guess: {text}")
    for text in imported.untold:
        print_line(f"not known: {text}")
    print_line(f"next: simgap inspect {options.out}")
    return CommandResult(
        {
            "description": options.out,
            "checks": imported.checks,
            "guesses": imported.guessed,
            "untold": imported.untold,
        }
    )
