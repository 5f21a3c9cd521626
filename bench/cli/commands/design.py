"""The command `simgap design`."""

from __future__ import annotations

import argparse

from bench.cli.output import EXIT_PROBLEMS_FOUND, CommandResult, PrintLine
from bench.cli.shared_options import (
    add_options,
    add_out_option,
    add_plugin_option,
    add_recordings_argument,
    collect_options,
)


def add_design_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap design`."""
    from bench.api.design import DesignOptions

    add_recordings_argument(parser, "the existing recordings, as for `simgap explain`")
    add_out_option(
        parser,
        "new file for the commands: t in s and a column for each input",
        "NAME.csv",
        required=True,
    )
    add_options(parser, DesignOptions)
    add_plugin_option(parser, "systems")
    parser.set_defaults(command=_run_design)


def _run_design(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap design`: explain recordings, then propose the next recording.

    The proposal is written to a file of commands (`options.out`), which must not exist yet. The
    search shows its progress on stderr, and Ctrl-C ends it with what it has.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and its exit code; EXIT_PROBLEMS_FOUND if there is no
        proposal.
    """
    from bench.api.design import DesignOptions, design
    from bench.cli.progress_display import ProgressDisplay
    from bench.core.plugin_registries import load_plugins
    from sims.core.files import check_absent

    load_plugins(options.plugin)
    check_absent([options.out])
    display = ProgressDisplay(silent=options.json, hint=False)
    with display, display.handle_interrupts() as arguments:
        proposed = design(
            options.recordings,
            **collect_options(options, DesignOptions),
            **arguments,
        )
    print_line(str(proposed.explanation))
    for line in proposed.lines():
        print_line(line)
    document = {
        "verdict": proposed.explanation.answer.to_document(),
        "design": None if proposed.design is None else proposed.design.to_document(),
        "says": proposed.lines(),
        "commands": None if proposed.design is None else options.out,
    }
    if proposed.design is None:
        return CommandResult(document, EXIT_PROBLEMS_FOUND)
    proposed.write(options.out)
    print_line(f"commands {options.out}")
    return CommandResult(document)
