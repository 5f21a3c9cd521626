"""The commands `simgap list` and `simgap schema`."""

from __future__ import annotations

import argparse

from bench.cli.output import CommandResult, PrintLine, format_json
from bench.cli.shared_options import add_plugin_option, parse_path

_LISTS = (
    "tuners", "simulators", "systems", "effects", "diagnosers", "experiments", "references",
    "schemas", "commands", "places",
)  # fmt: skip


def add_list_arguments(listing: argparse.ArgumentParser) -> None:
    """Add the options of `simgap list`."""
    listing.add_argument(
        "what",
        choices=_LISTS,
        nargs="?",
        help="which list (default, with --json: all but the last)",
    )
    listing.add_argument(
        "--model",
        type=parse_path,
        metavar="FILE",
        help="model file (MJCF or URDF) whose places are listed",
    )
    add_plugin_option(listing, "entries")
    listing.set_defaults(command=_run_list)


def add_schema_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap schema`."""
    parser.add_argument("name", metavar="NAME", help="a command, or see `simgap list schemas`")
    parser.set_defaults(command=_run_schema)


def _run_list(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap list`: print one section of the catalogue, or the places of a robot.

    Args:
        options: parsed arguments of the command; `what` is the section, None for all of them, which
            needs ``--json``. `model` is the robot's model file, for the section places only.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and its exit code (0).
    """
    from bench.cli import catalogue
    from bench.cli.main import build_parser
    from bench.core.plugin_registries import load_plugins
    from sims.core.simulator import InputError

    load_plugins(options.plugin)
    if (options.what == "places") != (options.model is not None):
        raise InputError("list places and --model FILE go together")
    if options.model is not None:
        places = catalogue.list_places(options.model)
        for line in catalogue.format_places(places):
            print_line(line)
        return CommandResult({"places": places})
    if options.what is None:
        if not options.json:
            raise InputError(f"expected one of {', '.join(_LISTS)}; with --json all are listed")
        return CommandResult(catalogue.build_catalogue(build_parser()))
    if options.what == "commands":
        documents = catalogue.list_commands(build_parser())
    else:
        documents = catalogue.CATALOGUE_SECTIONS[options.what]()
    for line in catalogue.format_documents(options.what, documents):
        print_line(line)
    return CommandResult({options.what: documents})


def _run_schema(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap schema`: print the JSON schema of a document that simgap writes."""
    from bench.schemas import load_schema

    schema = load_schema(options.name)
    print_line(format_json(schema))
    return CommandResult(schema)
