"""Report of a comparison of diagnosers: the values of the template `diagnosers.html`."""

from __future__ import annotations

from pathlib import Path

from bench.diagnosis_benchmark.report_page import diagnoser_charts as charts
from bench.diagnosis_benchmark.report_page import diagnoser_conclusion as conclusion
from bench.diagnosis_benchmark.report_page.diagnoser_page_data import DiagnoserReportData
from bench.diagnosis_benchmark.result_tables import (
    PRIMARY_METRIC,
    REFERENCE_DIAGNOSER,
    TARGET_FALSE_ALARM_RATE,
)
from bench.diagnosis_benchmark.wrong_answers import build_failure_table
from bench.pages.html_page import HtmlPage

_TEMPLATE = Path(__file__).with_name("diagnosers.html")
_DIGITS = 6
"""Number of significant digits of stored numbers."""


def render_page(data: DiagnoserReportData) -> str:
    """Render the HTML report of a comparison of diagnosers.

    The tables are embedded in the page for its charts; the numbers of the text are computed here.

    Args:
        data: the data of the report.
    """
    page = HtmlPage()
    failures = build_failure_table(data.rows, data.order)
    tables = {**data.tables, "failures": failures, "items": data.rows}
    tables |= charts.build_chart_tables(data)
    for name, table in tables.items():
        if len(table):
            page.add_table(name, table, _DIGITS)
    groups, confusion, costs = (data.tables[name] for name in ("groups", "confusion", "costs"))
    metrics = list(dict.fromkeys(groups["metric"]))
    confused = list(dict.fromkeys(confusion["diagnoser"]))
    better_diagnosers = conclusion.list_better_diagnosers(data)
    trained = costs[costs["training_simulations"] > 0]
    return page.render(
        _TEMPLATE,
        shown=data,
        REFERENCE=REFERENCE_DIAGNOSER,
        PRIMARY_METRIC=PRIMARY_METRIC,
        own=conclusion.count_own_failures(data),
        leader=conclusion.find_leader(data),
        limit=f"{100 * TARGET_FALSE_ALARM_RATE:g} %",
        better=better_diagnosers,
        has_pairs=len(data.tables["pairs"]) > 0,
        warnings=list(conclusion.write_warnings(data)),
        has_own_failures=bool((failures["diagnoser"] == REFERENCE_DIAGNOSER).any()),
        charts=charts.make_charts(data),
        **data.counts,
        trained=list(
            trained[["diagnoser", "training_simulations"]].itertuples(index=False, name=None)
        ),
        first_metric="named" if "named" in metrics or not metrics else str(metrics[0]),
        first_confused=(
            REFERENCE_DIAGNOSER
            if REFERENCE_DIAGNOSER in confused or not confused
            else str(confused[0])
        ),
    )
