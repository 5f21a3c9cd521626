"""Assemble the page of one comparison, report.html."""

from __future__ import annotations

from collections.abc import Iterator

from bench.benchmark.report_page import comparison_charts, headline, tables_and_failures
from bench.benchmark.report_page.comparison_conclusion import (
    best_table,
    reaching,
    standing_tables,
    write_conclusion,
    write_provenance_notes,
    write_warnings,
)
from bench.benchmark.report_page.comparison_page_data import ComparisonReportData
from bench.pages.html_elements import make_code, make_list, make_paragraph, safe
from bench.pages.html_page import HtmlPage


def render_page(results: ComparisonReportData) -> str:
    """Build the page as HTML: results first, then the evidence, then how it was made."""
    name = results.experiment.title or results.experiment.name
    made = f"Made by {make_code('simgap')} from the runs in {make_code(safe(results.folder, 300))}."
    page = HtmlPage(f"{name}: comparison of tuners", made)
    page.append(*_opening(results))
    page.append(_concluded(results), comparison_charts.render_error_chart(results, page))
    page.add_section("ranking", "Best, worse and not decided", standing_tables(results))
    page.add_section(
        "all-numbers", "Numbers", tables_and_failures.render_error_table(results, page)
    )
    page.add_section("pairs", "Pairs", tables_and_failures.render_pairs_table(results, page))
    page.add_section(
        "further",
        "More errors",
        comparison_charts.render_distance_chart(results, page),
        comparison_charts.render_misfit_chart(results, page),
        comparison_charts.render_directions_chart(results, page),
        tables_and_failures.render_identifiability_table(results, page),
    )
    times = tables_and_failures.render_ert_table(results, page)
    page.add_section(
        "reaching",
        "Reaching an error",
        make_list(reaching(results)),
        comparison_charts.render_runtime_chart(results, page),
        comparison_charts.render_ert_chart(results, page),
        times,
    )
    page.add_section(
        "costs",
        "Seconds",
        comparison_charts.render_cost_chart(results, page),
        tables_and_failures.render_winners_table(results, page),
        tables_and_failures.render_time_table(results),
    )
    page.add_section(
        "training",
        "Training",
        comparison_charts.render_amortisation_chart(results, page),
        tables_and_failures.render_break_even_table(results, page),
    )
    page.add_section("failures", "Failures", *tables_and_failures.render_failures(results))
    page.add_section("making", "How it was made", *tables_and_failures.render_reproduction(results))
    return page.to_html()


def _opening(results: ComparisonReportData) -> Iterator[str]:
    experiment = results.experiment
    yield f"<header>\n<h1>{safe(experiment.title or experiment.name, 200)}</h1>"
    tuners = results.stored.runs["tuner"].nunique()
    runs = results.stored.runs["run"].nunique()
    counts = (
        f"{make_code(safe(experiment.name, 100))}: {tuners} tuner{'s' * (tuners != 1)}, "
        f"{runs} runs of up to {experiment.budget} simulations."
    )
    equal = headline.floor_text(results.statistics)
    yield make_paragraph(f"{counts} {safe(experiment.says)} {safe(equal.capitalize())}.", "soft")
    yield "</header>"


def _concluded(results: ComparisonReportData) -> str:
    said = (
        f'<div class="conclusion">{best_table(results)}{make_list(write_conclusion(results))}</div>'
    )
    warned = (
        make_paragraph(" ".join(write_warnings(results)), "warning")
        if any(write_warnings(results))
        else ""
    )
    return said + warned + make_paragraph(" ".join(write_provenance_notes(results)), "soft")
