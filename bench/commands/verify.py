"""The command `simgap verify`."""

from __future__ import annotations

import argparse

from bench.commands.answer import DONE, WRONG, Answer, Document, Say
from bench.commands.options import add_plugin, place


def add_verify(verify: argparse.ArgumentParser) -> None:
    """Add the options of `simgap verify`."""
    verify.add_argument(
        "run",
        metavar="RUN",
        type=place,
        help="the folder of a finished comparison or an explanation, or an archive of "
        "`simgap bundle`",
    )
    verify.add_argument(
        "--all", action="store_true", help="make every simulation again, and not a share of them"
    )
    add_plugin(verify, "simulators")
    verify.set_defaults(command=_verify)


def _verify(options: argparse.Namespace, say: Say) -> Answer:
    from bench.bundle import VERDICT, verify_archive, verify_explanation
    from bench.study import parts_of
    from bench.verify import verify

    if options.run.is_file():
        archived = verify_archive(options.run, say, options.plugin, options.all)
        return Answer(archived.document(), DONE if archived.follows else WRONG)
    document: Document = {"archive": None, "comparisons": [], "explanation": None}
    if (options.run / VERDICT).is_file():
        document["explanation"] = verify_explanation(options.run, say).document()
        follows = document["explanation"]["follows"]
    else:
        parts = [verify(part, say, options.plugin, options.all) for part in parts_of(options.run)]
        document["comparisons"] = [part.document() for part in parts]
        follows = all(part.follows for part in parts)
    return Answer({"follows": follows, **document}, DONE if follows else WRONG)
