"""Command `simgap score`: the error of an extended simulator on another recording."""

from __future__ import annotations

import argparse

from bench.cli.output import CommandResult, PrintLine
from bench.cli.shared_options import add_force_option, add_plugin_option, parse_path


def add_score_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap score`."""
    parser.add_argument(
        "model",
        metavar="MODEL",
        type=parse_path,
        help="extended.toml as `simgap explain` writes it, or a robot's extended.xml",
    )
    parser.add_argument(
        "recording",
        metavar="OTHER.csv",
        type=parse_path,
        help="the recording; its .toml is in the same folder",
    )
    parser.add_argument(
        "--held-out", action="store_true", help="use only the runs that are marked held_out"
    )
    add_plugin_option(parser, "systems")
    add_force_option(parser)
    parser.set_defaults(command=_run_score)


def _run_score(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap score`: print the error of an extended simulator on a recording.

    Errors are root mean squares of each channel in its unit, and over all channels in units of the
    noise.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.
    """
    from bench.api.score import score
    from bench.core.plugin_registries import load_plugins

    load_plugins(options.plugin)
    result = score(options.model, options.recording, held_out=options.held_out, force=options.force)
    units = result.pop("units")
    for channel, error in result["rmse"].items():
        print_line(f"{channel}: RMSE {error:.4g} {units[channel]}")
    runs = "1 run" if result["runs"] == 1 else f"{result['runs']} runs"
    counts = f"{runs}, {result['samples']} samples"
    print_line(f"{result['normalised_rmse']:.4g} times the noise; {counts}")
    return CommandResult(result)
