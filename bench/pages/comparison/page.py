"""Assemble the page of one comparison, report.html."""

from __future__ import annotations

from collections.abc import Iterator

from bench.pages.comparison import charts, headline, parts
from bench.pages.comparison.conclusion import (
    best_table,
    conclusion,
    marks,
    reaching,
    standing_tables,
    warnings,
)
from bench.pages.comparison.results import Results
from bench.pages.elements import code, listed, paragraph, safe
from bench.pages.page import Page


def comparison_page(results: Results) -> str:
    """Build the page as HTML: results first, then the evidence, then how it was made."""
    name = results.experiment.title or results.experiment.name
    made = f"Made by {code('simgap')} from the runs in {code(safe(results.folder, 300))}."
    page = Page(f"{name}: comparison of tuners", made)
    page.add(*_opening(results))
    page.add(_concluded(results), charts.error_chart(results, page))
    page.section("ranking", "Best, worse and not decided", standing_tables(results))
    page.section("all-numbers", "Numbers", parts.table_grid(results, page))
    page.section("pairs", "Pairs", parts.pairs_grid(results, page))
    page.section(
        "further",
        "More errors",
        charts.distance_chart(results, page),
        charts.misfit_chart(results, page),
        charts.directions_chart(results, page),
        parts.spectra(results, page),
    )
    times = parts.ert_grid(results, page)
    page.section(
        "reaching",
        "Reaching an error",
        listed(reaching(results)),
        charts.runtime_chart(results, page),
        charts.ert_chart(results, page),
        times,
    )
    page.section(
        "costs",
        "Seconds",
        charts.cost_chart(results, page),
        parts.wins_grid(results, page),
        parts.seconds(results),
    )
    page.section(
        "training",
        "Training",
        charts.amortisation_chart(results, page),
        parts.even_grid(results, page),
    )
    page.section("failures", "Failures", *parts.failures(results))
    page.section("making", "How it was made", *parts.making(results))
    return page.html()


def _opening(results: Results) -> Iterator[str]:
    experiment = results.experiment
    yield f"<header>\n<h1>{safe(experiment.title or experiment.name, 200)}</h1>"
    tuners = results.stored.runs["tuner"].nunique()
    runs = results.stored.runs["run"].nunique()
    counts = (
        f"{code(safe(experiment.name, 100))}: {tuners} tuner{'s' * (tuners != 1)}, "
        f"{runs} runs of up to {experiment.budget} simulations."
    )
    equal = headline.floor_text(results.statistics)
    yield paragraph(f"{counts} {safe(experiment.says)} {safe(equal.capitalize())}.", "soft")
    yield "</header>"


def _concluded(results: Results) -> str:
    said = f'<div class="conclusion">{best_table(results)}{listed(conclusion(results))}</div>'
    warned = paragraph(" ".join(warnings(results)), "warning") if any(warnings(results)) else ""
    return said + warned + paragraph(" ".join(marks(results)), "soft")
