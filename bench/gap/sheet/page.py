"""The page of a data sheet: one file, readable without a network or scripts, in print too."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

from bench.gap.report.words import (
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
from bench.gap.sheet.words import TITLES, another, beside, called, evidence, reached
from bench.pages.elements import code, figure, heading, listed, paragraph, safe, table

_STYLE = Path(__file__).parents[1] / "report" / "page.css"
HEADS = ("", "quantity", "-value (95 %)", "-in another run", "-the file says", "evidence")
"""Of the table of what is shown."""
_REACH = (
    "How small a number these data would have shown: within the 95 % interval given it would not "
    "stand out beside the others, the noise being what the model leaves. What says 'not named' "
    "would be fitted to what is left, and does not explain it well enough to be a cause. A limit "
    "or gap shows from the size given on."
)


def page(sheet: Facts, diagram: Diagram, drawn: bytes, made: Made) -> str:
    """The page as HTML, with the diagram as it is drawn (PNG)."""
    parts = [*_head(sheet), *_found(sheet), *_diagram(diagram, drawn), *_absent(sheet)]
    return "\n".join([*parts, *_class(made), *_foot(sheet)])


def _head(sheet: Facts) -> Iterator[str]:
    yield '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">'
    yield '<meta name="viewport" content="width=device-width, initial-scale=1">'
    yield f"<title>Data sheet: {safe(sheet.name, 80)}</title>"
    yield f"<style>\n{_STYLE.read_text(encoding='utf-8')}</style>\n</head>\n<body>\n<main>"
    title = sheet.recording.title or sheet.recording.path.stem
    yield "<header>\n" + paragraph(safe(title), "recording")
    yield f"<h1>{safe(sheet.name, 80)}</h1>"
    yield paragraph(safe(sentence(sheet.verdict.says)), "lead") + "\n</header>"


def _found(sheet: Facts) -> Iterator[str]:
    yield heading("What these data show")
    rows, marks = [], []
    for row in sheet.rows:
        if row.number is None:
            continue
        rows.append(
            [
                TITLES[row.part],
                f"{safe(called(row), 80)}<br>{code(safe(row.name, 80))}",
                safe(estimated(row.number), 120),
                safe(another(row), 40),
                _stated(row),
                safe(evidence(row), 400),
            ]
        )
        marks.append("found" if row.state == "found" else "")
    yield table(HEADS, rows, marks)


def _diagram(diagram: Diagram, drawn: bytes) -> Iterator[str]:
    yield heading("Drive and back-drive")
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
    yield f'<div style="max-width:34rem">{figure(drawn, safe(said), caption)}</div>'


def _absent(sheet: Facts) -> Iterator[str]:
    rows = [
        [
            TITLES[row.part],
            f"{safe(called(row), 80)}<br>{code(safe(row.name, 80))}",
            safe(reached(row), 120),
            _stated(row),
            safe(beside(row), 400),
        ]
        for row in sheet.rows
        if row.number is None
    ]
    yield heading("Not shown by these data")
    yield paragraph(_REACH, "soft")
    yield table(["", "quantity", "-these data resolve", "-the file says", "mixed up with"], rows)


def _stated(row: Quantity) -> str:
    return "" if row.stated is None else safe(with_unit(number(row.stated), row.unit), 60)


def _class(made: Made) -> Iterator[str]:
    """The class, and what MJCF cannot say."""
    if CLASS in made.contents:
        yield heading("For MuJoCo")
        said = f"{code(CLASS)} holds it as a default class: include the file, and give the joint "
        yield paragraph(said + "and its actuator the class.")
        yield f"<pre>{escape(made.contents[CLASS])}</pre>"
    if made.said:
        yield listed(safe(line) for line in made.said)


def _foot(sheet: Facts) -> Iterator[str]:
    elsewhere = list(sheet.elsewhere())
    runs = [run.name for run in sheet.recording.training()]
    said = f"From {safe(_few(runs), 300)} of {code(safe(sheet.recording.path.name, 200))}."
    if elsewhere:
        said += f" The model has besides, elsewhere: {safe(joined(elsewhere), 400)}."
    yield f'<footer class="soft">\n{paragraph(said + " Made by simgap datasheet.")}\n</footer>'
    yield "</main>\n</body>\n</html>\n"


def _few(runs: Sequence[str], most: int = 8) -> str:
    named = f"runs {', '.join(runs[:most])}" if len(runs) > 1 else f"run {runs[0]}"
    return named + (f" and {len(runs) - most} more" if len(runs) > most else "")
