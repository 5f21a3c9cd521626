"""Assemble report.html, the HTML report of a comparison of diagnosers."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from bench.diagnosis_benchmark.report_page import diagnoser_charts, diagnoser_tables
from bench.diagnosis_benchmark.report_page.diagnoser_conclusion import (
    write_conclusion,
    write_warnings,
)
from bench.diagnosis_benchmark.report_page.diagnoser_page_data import DiagnoserReportData
from bench.diagnosis_benchmark.result_tables import REFERENCE_DIAGNOSER
from bench.pages.html_elements import make_code, make_list, make_paragraph, safe
from bench.pages.html_page import HtmlPage

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


def render_page(shown: DiagnoserReportData) -> str:
    """Render the HTML report of a comparison of diagnosers.

    The sections are, in this order: failures (of simgap first, if it takes part), strengths, power,
    confusion, calibration, costs, recording conditions, all answers, and how to repeat the
    comparison.
    """
    name = shown.experiment.title or shown.experiment.name
    made = (
        f"Made by {make_code('simgap')} from the answers in {make_code(safe(shown.folder, 300))}."
    )
    page = HtmlPage(f"{name}: comparison of diagnosers", made)
    page.append(*_opening(shown, name))
    said = f'<div class="conclusion">{make_list(write_conclusion(shown))}</div>'
    page.append(said, *(make_paragraph(text, "warning") for text in write_warnings(shown)))
    head = "Where simgap fails" if REFERENCE_DIAGNOSER in shown.order else "Where they fail"
    page.add_section("failures", head, diagnoser_tables.render_failures_table(shown, page))
    page.add_section(
        "who",
        "Who is good at what",
        diagnoser_charts.render_leaderboard_chart(shown, page),
        diagnoser_charts.render_shares_chart(shown, page),
        diagnoser_tables.render_results_table(shown, page),
        diagnoser_tables.render_pairs_table(shown, page),
    )
    page.add_section("power", "Power", diagnoser_charts.render_power_chart(shown, page))
    page.add_section(
        "confused",
        "Confusion",
        diagnoser_charts.render_static_figures(shown, page, _OUTCOMES, _CONFUSION),
        diagnoser_tables.render_confusion_table(shown, page),
    )
    page.add_section(
        "sure",
        "How sure",
        diagnoser_charts.render_calibration_chart(shown, page),
        diagnoser_charts.render_set_size_chart(shown, page),
    )
    page.add_section(
        "costs",
        "Cost",
        diagnoser_charts.render_cost_chart(shown, page),
        diagnoser_tables.render_costs_table(shown, page),
    )
    page.add_section(
        "where", "In which circumstances", diagnoser_tables.render_groups_table(shown, page)
    )
    page.add_section(
        "answers-given", "Every answer", diagnoser_tables.render_answers_table(shown, page)
    )
    page.add_section("making", "How it was made", *_making(shown))
    return page.to_html()


def _opening(shown: DiagnoserReportData, name: str) -> Iterator[str]:
    yield f"<header>\n<h1>{safe(name, 200)}</h1>"
    counts = (
        f"{make_code(safe(shown.experiment.name, 100))}: {len(shown.order)} diagnosers, "
        f"{shown.case_count} questions."
    )
    yield make_paragraph(f"{counts} {safe(shown.experiment.says)}", "soft") + "\n</header>"


def _making(shown: DiagnoserReportData) -> Iterator[str]:
    experiment = shown.experiment
    yield make_paragraph(
        f"Each answer was allowed {experiment.budget} simulations and {experiment.timeout:g} s. "
        "The same questions again:"
    )
    again = f"simgap compare {shlex.quote(f'{shown.folder}/experiment.toml')}"
    yield f"<pre>{safe(again, 1000)}</pre>"
    plot = f"simgap plot {shlex.quote(shown.folder)}"
    yield make_paragraph(f"The page, tables and figures alone: {make_code(safe(plot, 500))}.")
