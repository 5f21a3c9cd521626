"""The command `simgap import`."""

from __future__ import annotations

import argparse

from bench.cli.output import CommandResult, PrintLine
from bench.cli.shared_options import parse_name_list, parse_path


def add_import_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap import`."""
    parser.add_argument(
        "logs",
        metavar="LOG",
        nargs="+",
        type=parse_path,
        help="files of one run (.csv, .tsv, .npz, .parquet, .pt, .hdf5), or folders or bags (ROS "
        "1, ROS 2, MCAP) that each hold one, or datasets of LeRobot",
    )
    parser.add_argument(
        "--model",
        metavar="FILE",
        type=parse_path,
        required=True,
        help="what they are of: MJCF or URDF",
    )
    parser.add_argument(
        "--out",
        metavar="NAME.toml",
        type=parse_path,
        required=True,
        help="file to write, a new one",
    )
    parser.add_argument(
        "--held-out",
        metavar="A,B,...",
        default="",
        help="runs that no fit is to see (default: every third one)",
    )
    parser.add_argument(
        "--rate", metavar="HZ", type=float, help="rows a second, where the logs have no stamps"
    )
    parser.add_argument(
        "--position-unit",
        metavar="UNIT",
        default="",
        help="of positions that state none: rad, deg, or normalised (-100 to 100 of LeRobot); "
        "default: told from the joints' ranges",
    )
    parser.add_argument(
        "--calibration",
        metavar="FILE",
        type=parse_path,
        help="calibration file of LeRobot, by which normalised positions become angles",
    )
    parser.set_defaults(command=_import)


def _import(options: argparse.Namespace, say: PrintLine) -> CommandResult:
    from bench.api.recordings import import_logs

    made = import_logs(
        options.logs,
        options.model,
        options.out,
        held_out=parse_name_list(options.held_out),
        rate=options.rate,
        position_unit=options.position_unit,
        calibration=options.calibration,
    )
    say(f"{options.out}: {len(made.guessed)} guesses, each marked there; nothing was copied")
    for line in made.checks:
        say(f"check: {line}")
    for line in made.guessed:
        say(f"guess: {line}")
    for line in made.untold:
        say(f"not told: {line}")
    say(f"next: simgap inspect {options.out}")
    return CommandResult(
        {
            "description": options.out,
            "checks": made.checks,
            "guesses": made.guessed,
            "untold": made.untold,
        }
    )
