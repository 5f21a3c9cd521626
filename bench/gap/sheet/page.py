"""HTML page of a data sheet: one file that needs no network and no scripts, also for print."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from html import escape
from typing import TYPE_CHECKING

from bench.gap.report.words import (
    clean,
    estimated,
    joined,
    number,
    sentence,
    with_unit,
)
from bench.gap.sheet.diagram import Diagram
from bench.gap.sheet.facts import Facts
from bench.gap.sheet.mjcf import CLASS, Made
from bench.gap.sheet.quantity import Quantity
from bench.gap.sheet.words import another, beside, called, evidence, reached, title
from bench.pages.chart import Static
from bench.pages.elements import code, listed, paragraph, safe, table
from bench.pages.page import Page

if TYPE_CHECKING:
    import pandas as pd

DIAGRAM = "diagram"
"""Name of the figure, and of the table with its numbers."""
HEADS = ("", "quantity", "-value (95 %)", "-in another run", "-the file says", "evidence")
"""Headings of the table of identified numbers."""
_REACH = (
    "How small a number these data would have shown: within the 95 % interval given it would not "
    "stand out beside the others, the noise being what the model leaves. What says 'not named' "
    "would be fitted to what is left, and does not explain it well enough to be a cause. A limit "
    "or gap shows from the size given on."
)


def page(sheet: Facts, drawn: tuple[bytes, bytes | None] | None, made: Made) -> str:
    """Render the page as HTML.

    Args:
        sheet: Content of the data sheet.
        drawn: Diagram as SVG, and as PDF if requested; None without a drive.
        made: MJCF files with their notes.
    """
    built = Page(f"Data sheet: {clean(sheet.name, 80)}", _foot(sheet))
    if sheet.diagram is not None:
        built.table(DIAGRAM, _numbers(sheet.diagram))
    built.add(*_head(sheet))
    built.section("shown", "What these data show", *_found(sheet))
    if sheet.diagram is None or drawn is None:
        built.section("drive", "No drive", paragraph(safe(sheet.without_drive(), 600)))
    else:
        picture = Static(*drawn, "", DIAGRAM)
        built.section("drive", "Drive and back-drive", *_diagram(built, sheet.diagram, picture))
    built.section("absent", "Not shown by these data", *_absent(sheet))
    built.section("mujoco", "For MuJoCo", *_class(made))
    return built.html()


def _numbers(diagram: Diagram) -> pd.DataFrame:
    """Build the table of the curves of the diagram."""
    import pandas as pd

    columns = {"load": diagram.load, "moves_forward": diagram.forward, "moves_back": diagram.back}
    return pd.DataFrame(columns)


def _head(sheet: Facts) -> Iterator[str]:
    title = sheet.recording.title or sheet.recording.path.stem
    yield "<header>\n" + paragraph(safe(title), "soft")
    yield f"<h1>{safe(sheet.name, 80)}</h1>"
    yield paragraph(safe(sentence(sheet.verdict.says)), "lead") + "\n</header>"


def _found(sheet: Facts) -> Iterator[str]:
    rows, marks = [], []
    for row in sheet.rows:
        if row.number is None:
            continue
        rows.append(
            [
                title(row, sheet.is_driven),
                f"{safe(called(row), 80)}<br>{code(safe(row.name, 80))}",
                safe(estimated(row.number), 120),
                safe(another(row), 40),
                _stated(row),
                safe(evidence(row), 400),
            ]
        )
        marks.append("found" if row.state == "found" else "")
    yield table(HEADS, rows, marks)


def _diagram(built: Page, diagram: Diagram, drawn: Static) -> Iterator[str]:
    starts = with_unit(number(diagram.breakaway), diagram.unit)
    said = f"At rest it starts without a load at {starts}; "
    if diagram.backdrive < float("inf"):
        said += f"without power {with_unit(number(diagram.backdrive), diagram.unit)} turn it back."
    else:
        said += "without power no load turns it."
    laws = joined([code(safe(law, 60)) for law in diagram.laws]) or "no friction at rest"
    caption = (
        f"By the force of the motor and what it works against, where the joint moves, holds and "
        f"slips: {laws}, at position 0 and at the start of a run. The dotted line is balance."
    )
    if diagram.without:
        said += f" Not in it, with a state of its own: {', '.join(diagram.without)}."
    yield paragraph(safe(said))
    shown = built.picture(DIAGRAM, replace(drawn, alternative=said), caption, [DIAGRAM])
    yield f'<div style="max-width:34rem">{shown}</div>'


def _absent(sheet: Facts) -> Iterator[str]:
    rows = [
        [
            title(row, sheet.is_driven),
            f"{safe(called(row), 80)}<br>{code(safe(row.name, 80))}",
            safe(reached(row), 120),
            _stated(row),
            safe(beside(row), 400),
        ]
        for row in sheet.rows
        if row.number is None
    ]
    yield paragraph(_REACH, "soft")
    yield table(["", "quantity", "-these data resolve", "-the file says", "mixed up with"], rows)


def _stated(row: Quantity) -> str:
    return "" if row.stated is None else safe(with_unit(number(row.stated), row.unit), 60)


def _class(made: Made) -> Iterator[str]:
    """Yield the MJCF class and notes on what MJCF cannot express."""
    if CLASS in made.contents:
        said = f"{code(CLASS)} holds it as a default class: include the file, and give the joint "
        yield paragraph(said + "and its actuator the class.")
        yield f'<pre class="copied" tabindex="0">{escape(made.contents[CLASS])}</pre>'
    if made.said:
        yield listed(safe(line) for line in made.said)


def _foot(sheet: Facts) -> str:
    elsewhere = list(sheet.elsewhere())
    runs = [run.name for run in sheet.recording.training()]
    said = f"From {safe(_few(runs), 300)} of {code(safe(sheet.recording.path.name, 200))}."
    if elsewhere:
        said += f" The model has besides, elsewhere: {safe(joined(elsewhere), 400)}."
    return said + " Made by simgap datasheet."


def _few(runs: Sequence[str], most: int = 8) -> str:
    named = f"runs {', '.join(runs[:most])}" if len(runs) > 1 else f"run {runs[0]}"
    return named + (f" and {len(runs) - most} more" if len(runs) > most else "")
