"""The command `simgap check`."""

from __future__ import annotations

import argparse

from bench.commands.answer import DONE, WRONG, Answer, Say
from bench.commands.options import file


def add_check(check: argparse.ArgumentParser) -> None:
    """Add the options of `simgap check`."""
    check.add_argument(
        "name", metavar="NAME", help="registered name, e.g. cma_es, pendulum or drag.linear"
    )
    check.add_argument(
        "--plugin",
        type=file,
        action="append",
        default=[],
        metavar="FILE",
        help="Python file that defines it",
    )
    check.set_defaults(command=_check)


def _check(options: argparse.Namespace, say: Say) -> Answer:
    from bench.checks.command import run
    from bench.registry import load_plugins

    load_plugins(options.plugin)
    checked = run(options.name, options.plugin, say)
    return Answer(checked.document(), DONE if checked.passed else WRONG)
