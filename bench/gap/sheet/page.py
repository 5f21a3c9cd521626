"""The page of a data sheet: one file, readable without a network or scripts, in print too."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.gap.report.elements import code, heading, paragraph, safe, table
from bench.gap.report.words import (
    estimated,
    joined,
    number,
    percent,
    probability,
    sentence,
    with_unit,
)
from bench.gap.sheet.facts import Facts
from bench.gap.sheet.quantity import Quantity
from bench.gap.sheet.subject import PARTS

_STYLE = Path(__file__).parents[1] / "report" / "page.css"
_TITLES = {"system": "Motor", **PARTS}
"""Of the parts of the table."""
_REACH = (
    "How small a number these data would have shown: within the 95 % interval given it would not "
    "stand out beside the others, the noise being what the model leaves. What says 'not named' "
    "would be fitted to what is left, and does not explain it well enough to be a cause. A limit "
    "or gap shows from the size given on."
)


def page(sheet: Facts) -> str:
    """The page as HTML."""
    return "\n".join([*_head(sheet), *_found(sheet), *_absent(sheet), *_foot(sheet)])


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
                _TITLES[row.part],
                f"{safe(row.says, 80)}<br>{code(safe(row.name, 80))}",
                safe(estimated(row.number), 120),
                _stated(row),
                safe(evidence(row), 400),
            ]
        )
        marks.append("found" if row.state == "found" else "")
    yield table(["", "quantity", "-value (95 %)", "-the file says", "evidence"], rows, marks)


def _absent(sheet: Facts) -> Iterator[str]:
    rows = [
        [
            _TITLES[row.part],
            f"{safe(row.says, 80)}<br>{code(safe(row.name, 80))}",
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


def evidence(row: Quantity) -> str:
    """Why a number stands on the sheet."""
    if row.state == "derived":
        return "follows from those below"
    if row.state == "fitted":
        return "fitted" if row.number and row.number.low is not None else "not fixed by these data"
    said = [probability(row.p_value)]
    if row.share is not None:
        said.append(f"alone it closes {percent(row.share)} of the held-out gap")
    if row.instead:
        said.append(f"{joined(row.instead, 'or')} would do as well")
    return "; ".join(said)


def reached(row: Quantity) -> str:
    """How small a number these data would have shown."""
    reach = row.reach
    if reach is None or reach.size == float("inf"):
        return "nothing" if reach is not None and reach.mixed else "nothing: not touched"
    size = with_unit(number(reach.size, 2), row.unit)
    if reach.limit:
        return f"none {reach.limit} {size}"
    if reach.leans:
        return f"{with_unit(number(reach.leaning, 2), row.unit)} ± {size}, not named"
    return f"0 ± {size}"


def beside(row: Quantity) -> str:
    """What it is mixed up with, and what it might stand in place of."""
    said = list(row.reach.mixed) if row.reach else []
    if row.instead:
        said.append(f"may be there instead of {joined(row.instead, 'or')}")
    return ", ".join(said)


def _stated(row: Quantity) -> str:
    return "" if row.stated is None else safe(with_unit(number(row.stated), row.unit), 60)


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
