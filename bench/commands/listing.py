"""The command `simgap list`."""

from __future__ import annotations

import argparse

from bench.commands.options import add_plugin


def add_list(listing: argparse.ArgumentParser) -> None:
    """The options of `simgap list`."""
    listing.add_argument(
        "what", choices=("tuners", "simulators", "systems", "effects", "experiments")
    )
    add_plugin(listing, "of them")
    listing.set_defaults(command=_list)


def _list(options: argparse.Namespace) -> int:
    from bench.commands.catalogue import lines
    from bench.registry import load_plugins

    load_plugins(options.plugin)
    for line in lines(options.what):
        print(line)
    return 0
