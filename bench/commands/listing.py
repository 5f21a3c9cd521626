"""The commands `simgap list` and `simgap schema`."""

from __future__ import annotations

import argparse

from bench.commands.answer import Answer, Say, text
from bench.commands.options import add_model, add_plugin

_LISTS = (
    "tuners", "simulators", "systems", "effects", "diagnosers", "experiments", "references",
    "schemas", "commands", "places",
)  # fmt: skip


def add_list(listing: argparse.ArgumentParser) -> None:
    """Add the options of `simgap list`."""
    listing.add_argument(
        "what",
        choices=_LISTS,
        nargs="?",
        help="which list (default, with --json: all but the last)",
    )
    add_model(listing, "whose places are listed: an MJCF or URDF")
    add_plugin(listing, "of them")
    listing.set_defaults(command=_list)


def add_schema(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap schema`."""
    parser.add_argument("name", metavar="NAME", help="a command, or see `simgap list schemas`")
    parser.set_defaults(command=_schema)


def _list(options: argparse.Namespace, say: Say) -> Answer:
    from bench.commands import index
    from bench.commands.catalogue import told
    from bench.registry import load_plugins
    from sims.base import InputError

    load_plugins(options.plugin)
    if (options.what == "places") != (options.model is not None):
        raise InputError("list places and --model FILE go together")
    if options.model is not None:
        from bench.commands import places

        for line in places.lines(options.model):
            say(line)
        return Answer({"places": places.document(options.model)})
    if options.what is None:
        if not options.json:
            raise InputError(f"expected one of {', '.join(_LISTS)}; with --json all are listed")
        return Answer(index.everything(options.parser))
    if options.what == "commands":
        found = index.commands(options.parser)
    else:
        found = index.PARTS[options.what]()
    for line in told(options.what, found):
        say(line)
    return Answer({options.what: found})


def _schema(options: argparse.Namespace, say: Say) -> Answer:
    from bench.schemas import schema

    found = schema(options.name)
    say(text(found))
    return Answer(found)
