"""The command `simgap bundle`."""

from __future__ import annotations

import argparse

from bench.cli.output import CommandResult, PrintLine
from bench.cli.shared_options import parse_path


def add_bundle_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap bundle`."""
    parser.add_argument(
        "run",
        metavar="RUN",
        type=parse_path,
        help="the folder of a finished comparison, or the output folder of `simgap explain`",
    )
    parser.add_argument(
        "--with",
        dest="recordings",
        metavar="LOG.csv",
        type=parse_path,
        action="append",
        default=[],
        help="for an explanation: a recording to include, with its .toml, so that the held-out "
        "error can be checked",
    )
    parser.add_argument(
        "--out",
        metavar="FILE.zip",
        type=parse_path,
        help="archive to write (default: RUN.zip here)",
    )
    parser.set_defaults(command=_run_bundle)


def _run_bundle(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap bundle`: pack a result folder into one archive.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and its exit code (0).
    """
    from bench.studies.archive_bundle import write_bundle

    archived = write_bundle(options.run, options.out, options.recordings)
    document = archived.to_document()
    size = f"{document['bytes'] / 1e6:.3g} MB"
    print_line(f"{archived.archive}: {archived.kind}, {archived.files} files, {size}")
    print_line(f"SHA-256 {document['sha256']}")
    for line in archived.left_out:
        print_line(f"left out: {line}")
    print_line(f"to reproduce it: {archived.command}")
    print_line(f"to check it: simgap verify {archived.archive}")
    return CommandResult(document)
