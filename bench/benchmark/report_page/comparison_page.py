"""Page of one comparison, report.html: the values of the template `comparison.html`."""

from __future__ import annotations

from pathlib import Path

from markupsafe import Markup

from bench.benchmark.figures.comparison_charts import CHARTS
from bench.benchmark.figures.comparison_figures import format_threshold_caption
from bench.benchmark.problem.fisher_information import STIFF_SIGMA_THRESHOLD
from bench.benchmark.report_page import comparison_conclusion as conclusion
from bench.benchmark.report_page import headline
from bench.benchmark.report_page.comparison_page_data import ComparisonReportData
from bench.benchmark.statistics.training_amortisation import TARGETS_PER_TRAINING
from bench.pages.html_page import HtmlPage
from bench.pages.text_format import joined

_TEMPLATE = Path(__file__).with_name("comparison.html")
_DIGITS = 7
"""Number of significant digits of values that are in no file next to the page."""


def render_page(results: ComparisonReportData) -> str:
    """Render the page as HTML."""
    view, page = results.view, HtmlPage()
    for name, table in results.tables.items():
        if len(table):
            page.add_table(name, table)
    charts = {
        name: make_chart(view) if name in results.pictures or name == "ert" else None
        for name, make_chart in CHARTS.items()
    }
    for chart in charts.values():
        for name, table in chart.tables.items() if chart else ():
            page.add_table(name, table, _DIGITS)
    range_results = conclusion.list_range_results(view)
    rankings = [result.rankings for result in range_results]
    equal_errors = headline.format_error_floor(view.statistics)
    return page.render(
        _TEMPLATE,
        results=results,
        view=view,
        charts=charts,
        tuner_count=view.stored.runs["tuner"].nunique(),
        run_count=view.stored.runs["run"].nunique(),
        equal_errors=equal_errors.capitalize(),
        floor_text=equal_errors,
        range_results=range_results,
        together=list(zip(*rankings, strict=True)) if all(rankings) else [],
        best_headings=[f"best (median error), {result.where}" for result in range_results],
        conclusion=conclusion.write_conclusion(view),
        small_samples=conclusion.list_small_samples(view),
        failure_counts=conclusion.count_failures(view),
        failures=conclusion.list_failures(view),
        provenance_notes=list(conclusion.write_provenance_notes(results)),
        running_times=conclusion.write_running_times(results),
        mean_seconds=conclusion.list_mean_seconds(results),
        shown_label=view.format_metric_label(view.shown_metric),
        last_simulations=str(int(results.tables["table"]["simulations"].max())),
        threshold_caption=format_threshold_caption(view.statistics.runtime_thresholds),
        stiff_threshold=f"{STIFF_SIGMA_THRESHOLD:g}",
        targets_per_training=TARGETS_PER_TRAINING,
        joined=joined,
        separator=_make_list_separator,
    )


def _make_list_separator(loop: object) -> Markup:
    """Return what follows an item of a list: a comma, ``and``, or nothing after the last one."""
    remaining = int(getattr(loop, "revindex0", 0))
    return Markup({0: "", 1: " and "}.get(remaining, ", "))
