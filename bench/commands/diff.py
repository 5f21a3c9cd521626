"""The command `simgap diff`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from bench.commands.answer import DONE, WRONG, Answer, Say
from bench.commands.options import place

if TYPE_CHECKING:
    from bench.differ.comparisons import Compared
    from bench.differ.explanations import Explained


def add_diff(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap diff`."""
    for name in ("a", "b"):
        parser.add_argument(
            name,
            metavar=name.upper(),
            type=place,
            help="the folder of a comparison, or what `simgap explain` has written",
        )
    parser.add_argument(
        "--out", metavar="FILE.csv", type=place, help="write the numbers as a table, a new file"
    )
    parser.add_argument(
        "--fail-on",
        choices=("change", "worse"),
        help="end with exit code 1 where something differs significantly, or where B is "
        "significantly worse or fails more often; else the exit code says only that it ran",
    )
    parser.set_defaults(command=_diff)


def _diff(options: argparse.Namespace, say: Say) -> Answer:
    from sims.recording.write import publish, refuse_existing

    if options.out is not None:
        refuse_existing([options.out])
    found = _found(options.a, options.b)
    fails = options.fail_on == "worse" and found.worse
    fails = fails or (options.fail_on == "change" and found.changed)
    for line in found.lines():
        say(line)
    if options.out is not None:
        publish({options.out: found.table().to_csv(index=False)})
        say(f"table   {options.out}")
    return Answer(found.document(), WRONG if fails else DONE)


def _found(a: Path, b: Path) -> Compared | Explained:
    """Compare two folders of one kind.

    Raises:
        InputError: They are of two kinds, or one is neither.
    """
    from bench.differ import comparisons, explanations
    from sims.base import InputError

    told = [(folder / explanations.VERDICT).is_file() for folder in (a, b)]
    if all(told):
        return explanations.Explained(explanations.opened(a), explanations.opened(b))
    if any(told):
        one, other = (a, b) if told[0] else (b, a)
        raise InputError(f"expected two of one kind: {one} is an explanation, {other} is none")
    return comparisons.compare(a, b)
