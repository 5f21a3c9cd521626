"""HTML page of a data sheet: the values of the template `sheet.html`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bench.diagnosis.datasheet import wording
from bench.diagnosis.datasheet.drive_diagram import DriveDiagram
from bench.diagnosis.datasheet.mjcf_class import CLASS_FILE, MjcfFiles
from bench.diagnosis.datasheet.sheet_content import SheetContent
from bench.diagnosis.report.wording import (
    append_unit,
    format_fitted_value,
    format_number,
    format_sentence,
    joined,
)
from bench.pages.chart import PrintedFigure
from bench.pages.html_page import HtmlPage
from bench.pages.page_table import Table

_TEMPLATE = Path(__file__).with_name("sheet.html")
DIAGRAM_NAME = "diagram"
"""Name of the figure, and of the table with its numbers."""
_NAMED_RUNS = 8
"""Maximum number of runs that the footer names."""


def render_page(
    sheet: SheetContent, diagram_files: tuple[bytes, bytes | None] | None, mjcf: MjcfFiles
) -> str:
    """Render the page as HTML.

    Args:
        sheet: Content of the data sheet.
        diagram_files: Diagram as SVG, and as PDF if requested; None without a drive.
        mjcf: MJCF files with their notes.
    """
    page, printed_figure = HtmlPage(), None
    if sheet.diagram is not None and diagram_files is not None:
        printed_figure = PrintedFigure(
            *diagram_files, _describe_rest_forces(sheet.diagram), DIAGRAM_NAME
        )
        columns = {
            "load": sheet.diagram.load.tolist(),
            "moves_forward": sheet.diagram.forward.tolist(),
            "moves_back": sheet.diagram.back.tolist(),
        }
        page.add_table(DIAGRAM_NAME, Table(columns))
    return page.render(
        _TEMPLATE,
        sheet=sheet,
        still=printed_figure,
        runs=_format_runs([run.name for run in sheet.recording.training()]),
        elsewhere=joined(list(sheet.elsewhere())),
        class_file=CLASS_FILE,
        class_text=mjcf.contents.get(CLASS_FILE, ""),
        notes=mjcf.notes,
        format_confounding=wording.format_confounding,
        format_detection_limit=wording.format_detection_limit,
        format_evidence=wording.format_evidence,
        format_fitted_value=format_fitted_value,
        format_name=wording.format_name,
        format_prediction_interval=wording.format_prediction_interval,
        part=wording.title,
        sentence=format_sentence,
        with_unit=append_unit,
    )


def _describe_rest_forces(diagram: DriveDiagram) -> str:
    """Describe the forces at rest in a sentence."""
    starts = append_unit(format_number(diagram.breakaway), diagram.unit)
    text = f"At rest and without a load, the joint starts to move at {starts}. "
    if diagram.backdrive < float("inf"):
        load = append_unit(format_number(diagram.backdrive), diagram.unit)
        text += f"Without power, a load of {load} moves it back."
    else:
        text += "Without power, no load moves it: it is self-locking."
    if diagram.without:
        text += f" Not included, because they have an internal state: {', '.join(diagram.without)}."
    return text


def _format_runs(runs: Sequence[str]) -> str:
    named_runs = f"runs {', '.join(runs[:_NAMED_RUNS])}" if len(runs) > 1 else f"run {runs[0]}"
    unnamed_count = len(runs) - _NAMED_RUNS
    return f"{named_runs} and {unnamed_count} more" if unnamed_count > 0 else named_runs
