"""The command `simgap bundle`."""

from __future__ import annotations

import argparse

from bench.commands.answer import Answer, Say
from bench.commands.options import place


def add_bundle(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap bundle`."""
    parser.add_argument(
        "run",
        metavar="RUN",
        type=place,
        help="the folder of a finished comparison, or what `simgap explain` has written",
    )
    parser.add_argument(
        "--with",
        dest="recordings",
        metavar="LOG.csv",
        type=place,
        action="append",
        default=[],
        help="of an explanation: a recording that goes with it, with its .toml, so that its "
        "held-out error can be checked",
    )
    parser.add_argument(
        "--out", metavar="FILE.zip", type=place, help="archive to write (default: RUN.zip here)"
    )
    parser.set_defaults(command=_bundle)


def _bundle(options: argparse.Namespace, say: Say) -> Answer:
    from bench.bundle import bundle

    made = bundle(options.run, options.out, options.recordings)
    document = made.document()
    size = f"{document['bytes'] / 1e6:.3g} MB"
    say(f"{made.archive}: {made.kind}, {made.files} files, {size}")
    say(f"SHA-256 {document['sha256']}")
    for line in made.left_out:
        say(f"left out: {line}")
    say(f"to make it again: {made.command}")
    say(f"to check it: simgap verify {made.archive}")
    return Answer(document)
