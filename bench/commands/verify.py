"""The command `simgap verify`."""

from __future__ import annotations

import argparse

from bench.commands.answer import DONE, WRONG, Answer, Say
from bench.commands.options import add_plugin, place


def add_verify(verify: argparse.ArgumentParser) -> None:
    """The options of `simgap verify`."""
    verify.add_argument(
        "run", metavar="RUN", type=place, help="the folder of a finished comparison"
    )
    verify.add_argument(
        "--all", action="store_true", help="make every simulation again, and not a share of them"
    )
    add_plugin(verify, "simulators")
    verify.set_defaults(command=_verify)


def _verify(options: argparse.Namespace, say: Say) -> Answer:
    from bench.study import parts_of
    from bench.verify import verify

    parts = [verify(part, say, options.plugin, options.all) for part in parts_of(options.run)]
    follows = all(part.follows for part in parts)
    document = {
        "follows": follows,
        "archive": None,
        "comparisons": [part.document() for part in parts],
        "explanation": None,
    }
    return Answer(document, DONE if follows else WRONG)
