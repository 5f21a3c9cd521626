"""The command `simgap list`."""

from __future__ import annotations

import argparse

from bench.commands.options import add_model, add_plugin


def add_list(listing: argparse.ArgumentParser) -> None:
    """The options of `simgap list`."""
    listing.add_argument(
        "what", choices=("tuners", "simulators", "systems", "effects", "experiments", "places")
    )
    add_model(listing, "whose places are listed: an MJCF or URDF")
    add_plugin(listing, "of them")
    listing.set_defaults(command=_list)


def _list(options: argparse.Namespace) -> int:
    from bench.commands.catalogue import lines
    from bench.registry import load_plugins
    from sims.base import InputError

    load_plugins(options.plugin)
    if (options.what == "places") != (options.model is not None):
        raise InputError("list places and --model FILE go together")
    if options.model is not None:
        from bench.commands import places

        for line in places.lines(options.model):
            print(line)
        return 0
    for line in lines(options.what):
        print(line)
    return 0
