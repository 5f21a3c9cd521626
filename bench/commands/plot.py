"""The command `simgap plot`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bench.commands.answer import Answer, Document, Say
from bench.commands.options import add_pdf, add_plugin, place

if TYPE_CHECKING:
    from bench.store.reference import Reference


def add_plot(plot: argparse.ArgumentParser) -> None:
    """Add the options of `simgap plot`."""
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
    plot.add_argument(
        "--behind",
        metavar="NAME",
        action="append",
        default=[],
        help="draw errors against simulations again, with this reference result in grey behind "
        "them: see `simgap list references`, or the folder of a comparison",
    )
    add_pdf(plot)
    add_plugin(plot, "simulators")
    plot.set_defaults(command=_plot)


def _plot(options: argparse.Namespace, say: Say) -> Answer:
    from bench.runs.survey import admit
    from bench.store.reference import find
    from bench.study import opened, parts_of
    from sims.base import InputError

    files = [str(path.resolve()) for path in map(Path, options.plugin)]
    for folder in options.runs:
        for part in parts_of(folder):
            admit(files, opened(part).configuration.experiment)
    references = [find(name) for name in options.behind]
    if len(options.runs) == 1 and not options.out:
        # Check the references before anything is drawn.
        for part in parts_of(options.runs[0]):
            for reference in references:
                reference.mismatches(opened(part).configuration.experiment)
        return _again(options.runs[0], references, say)
    if not options.out:
        raise InputError("several comparisons give one result: name a folder for it with --out DIR")
    from bench.across import across
    from bench.compare import Comparison

    for folder in options.runs:
        if not isinstance(study := opened(folder), Comparison):
            asked = study.configuration.experiment
            found = "a bounce shot" if asked.shot else "a study of two comparisons"
            found = "a comparison of diagnosers" if asked.diagnosis else found
            raise InputError(f"{folder}: expected the folder of a comparison, found {found}")
    document = across(options.runs, options.out, say).document()
    return Answer({**document, "behind": _each_before(options.runs, references, options.out, say)})


def _again(folder: Path, references: Sequence[Reference], say: Say) -> Answer:
    """Report again a study, or the studies of a sweep or of a file with several studies."""
    from bench.commands.outcome import outcome
    from bench.study import conclude, opened, parts_of

    comparisons = []
    for part in parts_of(folder):
        study = opened(part)
        failed = study.finish(say)
        behind = _before(part, references, part, say)
        comparisons.append({**outcome(study), "failed": failed, "behind": behind})
    conclude(folder, say)
    return Answer({"comparisons": comparisons})


def _each_before(
    folders: Sequence[Path], references: Sequence[Reference], out: Path, say: Say
) -> list[Document]:
    """Draw each of several comparisons over the references that belong to its problem."""
    from sims.base import InputError

    drawn = []
    for number, folder in enumerate(folders, 1):
        for reference in references:
            name = f"{number}-{folder.resolve().name}-{reference.name.replace('/', '-')}-"
            try:
                drawn += _before(folder, [reference], out, say, name)
            except InputError as error:
                say(f"not drawn: {error}")
    return drawn


def _before(
    folder: Path, references: Sequence[Reference], out: Path, say: Say, name: str = ""
) -> list[Document]:
    """Draw a comparison over references in grey; draw nothing without references."""
    if not references:
        return []
    from bench.behind import draw

    return draw(folder, references, out, say, name)
