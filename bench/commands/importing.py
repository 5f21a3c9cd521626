"""The command `simgap import`."""

from __future__ import annotations

import argparse

from bench.commands.answer import Answer, Say
from bench.commands.options import names, place


def add_import(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap import`."""
    parser.add_argument(
        "logs",
        metavar="LOG",
        nargs="+",
        type=place,
        help="files of one run (.csv, .tsv, .npz, .parquet, .pt, .hdf5), or folders or bags (ROS "
        "1, ROS 2, MCAP) that each hold one, or datasets of LeRobot",
    )
    parser.add_argument(
        "--model", metavar="FILE", type=place, required=True, help="what they are of: MJCF or URDF"
    )
    parser.add_argument(
        "--out", metavar="NAME.toml", type=place, required=True, help="file to write, a new one"
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
        type=place,
        help="calibration file of LeRobot, by which normalised positions become angles",
    )
    parser.set_defaults(command=_import)


def _import(options: argparse.Namespace, say: Say) -> Answer:
    from bench.api.recordings import import_logs

    made = import_logs(
        options.logs,
        options.model,
        options.out,
        held_out=names(options.held_out),
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
    return Answer(
        {
            "description": options.out,
            "checks": made.checks,
            "guesses": made.guessed,
            "untold": made.untold,
        }
    )
