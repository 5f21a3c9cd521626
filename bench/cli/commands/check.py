"""The command `simgap check`."""

from __future__ import annotations

import argparse

from bench.cli.output import EXIT_OK, EXIT_PROBLEMS_FOUND, CommandResult, PrintLine
from bench.cli.shared_options import parse_file_name


def add_check_arguments(check: argparse.ArgumentParser) -> None:
    """Add the options of `simgap check`."""
    check.add_argument(
        "name", metavar="NAME", help="registered name, e.g. cma_es, pendulum or drag.linear"
    )
    check.add_argument(
        "--plugin",
        type=parse_file_name,
        action="append",
        default=[],
        metavar="FILE",
        help="Python file that defines it",
    )
    check.set_defaults(command=_run_check)


def _run_check(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap check`: run the conformance checks of a part, such as a tuner of a plugin.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and its exit code; EXIT_PROBLEMS_FOUND if a check failed.
    """
    from bench.conformance.check_suites import run_suite
    from bench.core.plugin_registries import load_plugins

    load_plugins(options.plugin)
    checked = run_suite(options.name, options.plugin, print_line)
    return CommandResult(
        checked.to_document(), EXIT_OK if checked.has_passed else EXIT_PROBLEMS_FOUND
    )
