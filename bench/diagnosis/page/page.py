"""Assemble report.html, the HTML report of a comparison of diagnosers."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from bench.diagnosis.page import charts, grids
from bench.diagnosis.page.conclusion import conclusion, warnings
from bench.diagnosis.page.shown import Shown
from bench.diagnosis.tables import OWN
from bench.pages.elements import code, listed, paragraph, safe
from bench.pages.page import Page

_OUTCOMES = (
    "outcomes",
    "What became of each single effect",
    "Recordings with one hidden effect of at least one noise; numbers in bars count them.",
)
_CONFUSION = (
    "confusion",
    "What families are taken for",
    "Hidden causes by family (rows) and what was said (columns), in per cent of a row. On the "
    "diagonal stands what is right.",
)


def diagnosis_page(shown: Shown) -> str:
    """Render the HTML report of a comparison of diagnosers.

    The sections are, in this order: failures (of simgap first, if it takes part), strengths, power,
    confusion, calibration, costs, recording conditions, all answers, and how to repeat the
    comparison.
    """
    name = shown.experiment.title or shown.experiment.name
    made = f"Made by {code('simgap')} from the answers in {code(safe(shown.folder, 300))}."
    page = Page(f"{name}: comparison of diagnosers", made)
    page.add(*_opening(shown, name))
    said = f'<div class="conclusion">{listed(conclusion(shown))}</div>'
    page.add(said, *(paragraph(text, "warning") for text in warnings(shown)))
    head = "Where simgap fails" if OWN in shown.order else "Where they fail"
    page.section("failures", head, grids.failures_grid(shown, page))
    page.section(
        "who",
        "Who is good at what",
        charts.board_chart(shown, page),
        charts.shares_chart(shown, page),
        grids.table_grid(shown, page),
        grids.pairs_grid(shown, page),
    )
    page.section("power", "Power", charts.power_chart(shown, page))
    page.section(
        "confused",
        "Confusion",
        charts.pictures(shown, page, _OUTCOMES, _CONFUSION),
        grids.confusion_grid(shown, page),
    )
    page.section(
        "sure", "How sure", charts.calibration_chart(shown, page), charts.sets_chart(shown, page)
    )
    page.section("costs", "Cost", charts.cost_chart(shown, page), grids.costs_grid(shown, page))
    page.section("where", "In which circumstances", grids.groups_grid(shown, page))
    page.section("answers-given", "Every answer", grids.items_grid(shown, page))
    page.section("making", "How it was made", *_making(shown))
    return page.html()


def _opening(shown: Shown, name: str) -> Iterator[str]:
    yield f"<header>\n<h1>{safe(name, 200)}</h1>"
    counts = (
        f"{code(safe(shown.experiment.name, 100))}: {len(shown.order)} diagnosers, "
        f"{shown.asked} questions."
    )
    yield paragraph(f"{counts} {safe(shown.experiment.says)}", "soft") + "\n</header>"


def _making(shown: Shown) -> Iterator[str]:
    experiment = shown.experiment
    yield paragraph(
        f"Each answer was allowed {experiment.budget} simulations and {experiment.timeout:g} s. "
        "The same questions again:"
    )
    again = f"simgap compare {shlex.quote(f'{shown.folder}/experiment.toml')}"
    yield f"<pre>{safe(again, 1000)}</pre>"
    plot = f"simgap plot {shlex.quote(shown.folder)}"
    yield paragraph(f"The page, tables and figures alone: {code(safe(plot, 500))}.")
