"""Redraw a comparison's error curves with reference results in grey behind them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bench.figures import comparison
from bench.figures.comparison import FILES, FRONT, labels_of, refuse_behind
from bench.figures.style import save
from bench.problem.problem import Problem
from bench.report import NEEDED
from bench.store.folder import read
from bench.store.reference import Reference
from sims.base import InputError


def draw(
    folder: Path,
    references: Sequence[Reference],
    out: Path,
    say: Callable[[str], None],
    before: str = "",
) -> list[dict[str, Any]]:
    """Draw a comparison's figures again with references behind them, as separate files.

    Args:
        folder: folder of the comparison.
        references: reference results to draw.
        out: folder in whose subfolder ``figures`` the files are written.
        say: callback that prints one line; it gets differences of the references, and files.
        before: prefix of the file names.

    Returns:
        JSON document of each reference, with its differences and the files.

    Raises:
        InputError: a reference belongs to another problem, or there are too many.
    """
    stored = read(folder, NEEDED)
    if stored.runs.empty:
        raise InputError(f"{folder}: holds no runs")
    refuse_behind(stored, FRONT[0], references)
    problem = Problem(stored.experiment)
    try:
        labels = labels_of(problem)
    finally:
        problem.close()
    for reference in references:
        say(f"behind  {reference.provenance}")
        for line in reference.mismatches(stored.experiment):
            say(f"differs {line}")
    files = []
    for name in comparison.names(stored):
        if name in FRONT:
            figure = comparison.figure(stored, labels, name, behind=references)
            files += save(figure, out / "figures" / f"{before}{FILES[name]}-behind")
            say(f"figure  {files[-2]}")
    return [reference.document_of(stored.experiment, files) for reference in references]
