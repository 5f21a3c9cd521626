"""HTML page of a data sheet: one file that needs no network and no scripts, also for print."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from html import escape
from typing import TYPE_CHECKING

from bench.diagnosis.datasheet.drive_diagram import DriveDiagram
from bench.diagnosis.datasheet.mjcf_class import CLASS_FILE, MjcfFiles
from bench.diagnosis.datasheet.sheet_content import SheetContent
from bench.diagnosis.datasheet.sheet_rows import SheetRow
from bench.diagnosis.datasheet.wording import (
    format_confounding,
    format_detection_limit,
    format_evidence,
    format_name,
    format_prediction_interval,
    title,
)
from bench.diagnosis.report.wording import (
    append_unit,
    format_fitted_value,
    format_number,
    format_sentence,
    joined,
    sanitise,
)
from bench.pages.chart import PrintedFigure
from bench.pages.html_elements import make_code, make_list, make_paragraph, make_table, safe
from bench.pages.html_page import HtmlPage

if TYPE_CHECKING:
    import pandas as pd

DIAGRAM_NAME = "diagram"
"""Name of the figure, and of the table with its numbers."""
TABLE_HEADINGS = ("", "quantity", "-value (95 %)", "-in another run", "-the file says", "evidence")
"""Headings of the table of identified numbers."""
_REACH = (
    "How small a number these data would have shown: within the 95 % interval given it would not "
    "stand out beside the others, the noise being what the model leaves. What says 'not named' "
    "would be fitted to what is left, and does not explain it well enough to be a cause. A limit "
    "or gap shows from the size given on."
)


def render_page(
    sheet: SheetContent, drawn: tuple[bytes, bytes | None] | None, made: MjcfFiles
) -> str:
    """Render the page as HTML.

    Args:
        sheet: Content of the data sheet.
        drawn: Diagram as SVG, and as PDF if requested; None without a drive.
        made: MJCF files with their notes.
    """
    built = HtmlPage(f"Data sheet: {sanitise(sheet.name, 80)}", _foot(sheet))
    if sheet.diagram is not None:
        built.add_table(DIAGRAM_NAME, _numbers(sheet.diagram))
    built.append(*_head(sheet))
    built.add_section("shown", "What these data show", *_found(sheet))
    if sheet.diagram is None or drawn is None:
        built.add_section("drive", "No drive", make_paragraph(safe(sheet.without_drive(), 600)))
    else:
        picture = PrintedFigure(*drawn, "", DIAGRAM_NAME)
        built.add_section("drive", "Drive and back-drive", *_diagram(built, sheet.diagram, picture))
    built.add_section("absent", "Not shown by these data", *_absent(sheet))
    built.add_section("mujoco", "For MuJoCo", *_class(made))
    return built.to_html()


def _numbers(diagram: DriveDiagram) -> pd.DataFrame:
    """Build the table of the curves of the diagram."""
    import pandas as pd

    columns = {"load": diagram.load, "moves_forward": diagram.forward, "moves_back": diagram.back}
    return pd.DataFrame(columns)


def _head(sheet: SheetContent) -> Iterator[str]:
    title = sheet.recording.title or sheet.recording.path.stem
    yield "<header>\n" + make_paragraph(safe(title), "soft")
    yield f"<h1>{safe(sheet.name, 80)}</h1>"
    yield make_paragraph(safe(format_sentence(sheet.verdict.meaning)), "lead") + "\n</header>"


def _found(sheet: SheetContent) -> Iterator[str]:
    rows, marks = [], []
    for row in sheet.rows:
        if row.number is None:
            continue
        rows.append(
            [
                title(row, sheet.is_driven),
                f"{safe(format_name(row), 80)}<br>{make_code(safe(row.name, 80))}",
                safe(format_fitted_value(row.number), 120),
                safe(format_prediction_interval(row), 40),
                _stated(row),
                safe(format_evidence(row), 400),
            ]
        )
        marks.append("found" if row.state == "found" else "")
    yield make_table(TABLE_HEADINGS, rows, marks)


def _diagram(built: HtmlPage, diagram: DriveDiagram, drawn: PrintedFigure) -> Iterator[str]:
    starts = append_unit(format_number(diagram.breakaway), diagram.unit)
    said = f"At rest it starts without a load at {starts}; "
    if diagram.backdrive < float("inf"):
        backdrive = append_unit(format_number(diagram.backdrive), diagram.unit)
        said += f"without power {backdrive} turn it back."
    else:
        said += "without power no load turns it."
    laws = joined([make_code(safe(law, 60)) for law in diagram.laws]) or "no friction at rest"
    caption = (
        f"By the force of the motor and what it works against, where the joint moves, holds and "
        f"slips: {laws}, at position 0 and at the start of a run. The dotted line is balance."
    )
    if diagram.without:
        said += f" Not in it, with a state of its own: {', '.join(diagram.without)}."
    yield make_paragraph(safe(said))
    shown = built.render_figure(
        DIAGRAM_NAME, replace(drawn, alternative=said), caption, [DIAGRAM_NAME]
    )
    yield f'<div style="max-width:34rem">{shown}</div>'


def _absent(sheet: SheetContent) -> Iterator[str]:
    rows = [
        [
            title(row, sheet.is_driven),
            f"{safe(format_name(row), 80)}<br>{make_code(safe(row.name, 80))}",
            safe(format_detection_limit(row), 120),
            _stated(row),
            safe(format_confounding(row), 400),
        ]
        for row in sheet.rows
        if row.number is None
    ]
    yield make_paragraph(_REACH, "soft")
    yield make_table(
        ["", "quantity", "-these data resolve", "-the file says", "mixed up with"], rows
    )


def _stated(row: SheetRow) -> str:
    return "" if row.stated is None else safe(append_unit(format_number(row.stated), row.unit), 60)


def _class(made: MjcfFiles) -> Iterator[str]:
    """Yield the MJCF class and notes on what MJCF cannot express."""
    if CLASS_FILE in made.contents:
        said = f"{make_code(CLASS_FILE)} holds it as a default class: include the file, "
        yield make_paragraph(said + "and give the joint and its actuator the class.")
        yield f'<pre class="copied" tabindex="0">{escape(made.contents[CLASS_FILE])}</pre>'
    if made.notes:
        yield make_list(safe(line) for line in made.notes)


def _foot(sheet: SheetContent) -> str:
    elsewhere = list(sheet.elsewhere())
    runs = [run.name for run in sheet.recording.training()]
    said = f"From {safe(_few(runs), 300)} of {make_code(safe(sheet.recording.path.name, 200))}."
    if elsewhere:
        said += f" The model has besides, elsewhere: {safe(joined(elsewhere), 400)}."
    return said + " Made by simgap datasheet."


def _few(runs: Sequence[str], most: int = 8) -> str:
    named = f"runs {', '.join(runs[:most])}" if len(runs) > 1 else f"run {runs[0]}"
    return named + (f" and {len(runs) - most} more" if len(runs) > most else "")
