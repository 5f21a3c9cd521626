"""The command `simgap diff`."""

from __future__ import annotations

import argparse

from bench.cli.output import EXIT_OK, EXIT_PROBLEMS_FOUND, CommandResult, PrintLine
from bench.cli.shared_options import parse_path


def add_diff_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap diff`."""
    for name in ("a", "b"):
        parser.add_argument(
            name,
            metavar=name.upper(),
            type=parse_path,
            help="the folder of a comparison, or the output folder of `simgap explain`",
        )
    parser.add_argument(
        "--out",
        metavar="FILE.csv",
        type=parse_path,
        help="new file for the numbers as a table",
    )
    parser.add_argument(
        "--fail-on",
        choices=("change", "worse"),
        help="exit with code 1 if anything differs significantly (change), or if B is "
        "significantly worse or fails more often (worse); without it, differences give code 0",
    )
    parser.set_defaults(command=_run_diff)


def _run_diff(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap diff`: print the differences between two result folders of the same kind.

    Args:
        options: parsed arguments of the command; `fail_on` says which differences are a failure.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and its exit code; EXIT_PROBLEMS_FOUND for a failure.
    """
    from bench.studies.result_diff import compare_folders
    from sims.core.files import check_absent, write_files

    if options.out is not None:
        check_absent([options.out])
    difference = compare_folders(options.a, options.b)
    fails = options.fail_on == "worse" and difference.is_worse
    fails = fails or (options.fail_on == "change" and difference.has_changed)
    for line in difference.format_lines():
        print_line(line)
    if options.out is not None:
        write_files({options.out: difference.to_table().to_csv(index=False)})
        print_line(f"table   {options.out}")
    return CommandResult(difference.to_document(), EXIT_PROBLEMS_FOUND if fails else EXIT_OK)
