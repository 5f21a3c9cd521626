"""The command `simgap plot`."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.commands.answer import Answer, Say
from bench.commands.options import add_plugin, place


def add_plot(plot: argparse.ArgumentParser) -> None:
    """The options of `simgap plot`."""
    plot.add_argument(
        "runs",
        metavar="RUN",
        type=place,
        nargs="+",
        help="the folder of a comparison or bounce shot; several comparisons: ranks",
    )
    plot.add_argument(
        "--out", metavar="DIR", type=place, help="folder for what several comparisons give together"
    )
    add_plugin(plot, "simulators")
    plot.set_defaults(command=_plot)


def _plot(options: argparse.Namespace, say: Say) -> Answer:
    from bench.runs.survey import admit
    from bench.study import opened, parts_of
    from sims.base import InputError

    files = [str(path.resolve()) for path in map(Path, options.plugin)]
    for folder in options.runs:
        for part in parts_of(folder):
            admit(files, opened(part).configuration.experiment)
    if len(options.runs) == 1 and not options.out:
        return _again(options.runs[0], say)
    if not options.out:
        raise InputError("several comparisons give one result: name a folder for it with --out DIR")
    from bench.across import across
    from bench.compare import Comparison

    for folder in options.runs:
        if not isinstance(opened(folder), Comparison):
            raise InputError(f"{folder}: expected the folder of a comparison, found a bounce shot")
    return Answer(across(options.runs, options.out, say).document())


def _again(folder: Path, say: Say) -> Answer:
    """Report a study, or those of a sweep, again."""
    from bench.commands.outcome import outcome
    from bench.study import opened, parts_of

    comparisons = []
    for part in parts_of(folder):
        study = opened(part)
        failed = study.finish(say)
        comparisons.append({**outcome(study), "failed": failed, "behind": []})
    return Answer({"comparisons": comparisons})
