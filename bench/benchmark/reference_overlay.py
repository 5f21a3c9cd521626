"""Redraw a comparison's error curves with reference results in grey behind them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bench.benchmark import comparison_figures
from bench.benchmark.comparison_charts import make_axis_labels
from bench.benchmark.comparison_figures import (
    FIGURE_FILES,
    OVERLAYABLE_FIGURES,
    check_references_allowed,
)
from bench.benchmark.comparison_report import REQUIRED_RUN_COLUMNS
from bench.benchmark.storage.reference_results import ReferenceResult
from bench.benchmark.storage.result_folder import read_comparison
from bench.figures.figure_output import write_figure
from sims.core.simulator import InputError


def draw_with_references(
    folder: Path,
    references: Sequence[ReferenceResult],
    out: Path,
    print_line: Callable[[str], None],
    before: str = "",
) -> list[dict[str, Any]]:
    """Draw a comparison's figures again with references behind them, as separate files.

    Args:
        folder: folder of the comparison.
        references: reference results to draw.
        out: folder in whose subfolder ``figures`` the files are written.
        print_line: callback that prints one line; it gets differences of the references, and files.
        before: prefix of the file names.

    Returns:
        JSON document of each reference, with its differences and the files.

    Raises:
        InputError: a reference belongs to another problem, or there are too many.
    """
    stored = read_comparison(folder, REQUIRED_RUN_COLUMNS)
    if stored.runs.empty:
        raise InputError(f"{folder}: contains no runs")
    check_references_allowed(stored, OVERLAYABLE_FIGURES[0], references)
    labels = make_axis_labels(stored.experiment)
    for reference in references:
        print_line(f"behind  {reference.provenance_text}")
        for line in reference.find_mismatches(stored.experiment):
            print_line(f"differs {line}")
    files = []
    for name in comparison_figures.list_figure_names(stored):
        if name in OVERLAYABLE_FIGURES:
            figure = comparison_figures.draw_figure(stored, labels, name, references=references)
            files += write_figure(figure, out / "figures" / f"{before}{FIGURE_FILES[name]}-behind")
            print_line(f"figure  {files[-2]}")
    return [reference.to_document(stored.experiment, files) for reference in references]
