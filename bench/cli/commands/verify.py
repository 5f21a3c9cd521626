"""The command `simgap verify`."""

from __future__ import annotations

import argparse

from bench.cli.output import EXIT_OK, EXIT_PROBLEMS_FOUND, CommandResult, PrintLine
from bench.cli.shared_options import add_plugin_option, parse_path


def add_verify_arguments(verify: argparse.ArgumentParser) -> None:
    """Add the options of `simgap verify`."""
    verify.add_argument(
        "run",
        metavar="RUN",
        type=parse_path,
        help="the folder of a finished comparison or an explanation, or an archive of "
        "`simgap bundle`",
    )
    verify.add_argument(
        "--all", action="store_true", help="repeat every simulation instead of a sample of them"
    )
    add_plugin_option(verify, "simulators")
    verify.set_defaults(command=_run_verify)


def _run_verify(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap verify`: check that an archive, explanation or comparison is consistent.

    Args:
        options: parsed arguments of the command; `run` is the file of an archive, or a folder.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and its exit code; EXIT_PROBLEMS_FOUND if a number does
        not follow from the others.
    """
    from bench.studies.result_verification import verify_results

    verification = verify_results(options.run, print_line, options.plugin, options.all)
    return CommandResult(
        verification.to_document(), EXIT_OK if verification.is_consistent else EXIT_PROBLEMS_FOUND
    )
