"""Sortable and filterable tables of the report of a comparison of diagnosers."""

from __future__ import annotations

from bench.diagnosis_benchmark.report_page.diagnoser_page_data import DiagnoserReportData
from bench.diagnosis_benchmark.result_tables import PRIMARY_METRIC, REFERENCE_DIAGNOSER
from bench.diagnosis_benchmark.wrong_answers import build_failure_table
from bench.pages.data_grid import DataGrid, GridColumn
from bench.pages.html_page import HtmlPage

_COUNTED = (
    GridColumn("count", digits=6),
    GridColumn("of", digits=6),
    GridColumn("share", digits=3),
    GridColumn("low", "95 % low", 3),
    GridColumn("high", "95 % high", 3),
)


def render_failures_table(shown: DiagnoserReportData, page: HtmlPage) -> str:
    """Render the table of incorrect answers, filtered to those of simgap at first."""
    frame = build_failure_table(shown.rows, shown.order)
    if frame.empty:
        return ""
    page.add_table("failures", frame, 6)
    columns = (
        GridColumn("diagnoser"),
        GridColumn("question", says="the last number tells questions of one sort apart"),
        GridColumn("verdict", "says"),
        GridColumn("named", says="alternatives behind a bar"),
        GridColumn("outcome"),
        GridColumn("noise"),
        GridColumn("right_by", "right by"),
    )
    filters = ("diagnoser", "kind", "system", "noise", "outcome")
    first = REFERENCE_DIAGNOSER if (frame["diagnoser"] == REFERENCE_DIAGNOSER).any() else ""
    only = {"diagnoser": first} if first else {}
    title = "Answers that are not right"
    return page.render_grid(
        DataGrid("wrong", title, "failures", columns, filters, only, "", "diagnoser")
    )


def render_results_table(shown: DiagnoserReportData, page: HtmlPage) -> str:
    """Render table.csv, filtered at first to the metric that counts as a diagnosed cause."""
    page.add_table("table", shown.tables["table"], 6)
    columns = (GridColumn("diagnoser"), GridColumn("metric", "what is counted"), *_COUNTED)
    only = {"metric": PRIMARY_METRIC}
    title = "Every share: table.csv"
    grid = DataGrid(
        "numbers",
        title,
        "table",
        columns,
        ("diagnoser", "metric"),
        only,
        "share,down",
        "diagnoser",
    )
    return page.render_grid(grid)


def render_groups_table(shown: DiagnoserReportData, page: HtmlPage) -> str:
    """Render groups.csv: false alarms and diagnosed causes by recording condition and effect."""
    frame = shown.tables["groups"]
    if frame.empty:
        return ""
    page.add_table("groups", frame, 6)
    columns = (
        GridColumn("diagnoser"),
        GridColumn("metric", "what is counted"),
        GridColumn("by"),
        GridColumn("value"),
        *_COUNTED,
    )
    filters = ("diagnoser", "metric", "by", "value")
    metrics = list(dict.fromkeys(frame["metric"]))
    only = {"metric": "named" if "named" in metrics else str(metrics[0]), "by": "noise"}
    title = "By system, noise, rate, runs and effect: groups.csv"
    return page.render_grid(
        DataGrid("by", title, "groups", columns, filters, only, "", "diagnoser")
    )


def render_pairs_table(shown: DiagnoserReportData, page: HtmlPage) -> str:
    """Render pairs.csv: each diagnoser compared with simgap."""
    frame = shown.tables["pairs"]
    if frame.empty:
        return ""
    page.add_table("pairs", frame, 6)
    columns = (
        GridColumn("diagnoser", "against"),
        GridColumn("metric", "what is counted"),
        GridColumn("questions", digits=6),
        GridColumn("only_simgap", "simgap alone right", 6),
        GridColumn("only_other", "the other alone right", 6),
        GridColumn("p_value", "p (McNemar)", 2),
        GridColumn("p_holm", "p, Holm-corrected", 2),
    )
    title = "Question by question against simgap: pairs.csv"
    filters = ("diagnoser", "metric")
    return page.render_grid(
        DataGrid("against", title, "pairs", columns, filters, {}, "p_holm", "diagnoser")
    )


def render_confusion_table(shown: DiagnoserReportData, page: HtmlPage) -> str:
    """Render confusion.csv: number of each answer for each hidden effect."""
    frame = shown.tables["confusion"]
    if frame.empty:
        return ""
    page.add_table("confusion", frame)
    columns = (
        GridColumn("diagnoser"),
        GridColumn("hidden"),
        GridColumn("said", says="the leading name; verdicts in brackets"),
        GridColumn("count", digits=6),
    )
    first = (
        REFERENCE_DIAGNOSER
        if (frame["diagnoser"] == REFERENCE_DIAGNOSER).any()
        else str(frame["diagnoser"].iloc[0])
    )
    title = "Effect by effect: confusion.csv"
    filters = ("diagnoser", "hidden", "said")
    only = {"diagnoser": first}
    grid = DataGrid("taken", title, "confusion", columns, filters, only, "count,down", "diagnoser")
    return page.render_grid(grid)


def render_costs_table(shown: DiagnoserReportData, page: HtmlPage) -> str:
    """Render costs.csv: simulations and time per answer."""
    page.add_table("costs", shown.tables["costs"], 6)
    columns = (
        GridColumn("diagnoser"),
        GridColumn("answers", digits=6),
        GridColumn("simulations_median", "simulations, median", 4),
        GridColumn("simulations_p95", "95 % quantile", 4),
        GridColumn("processor_seconds_median", "processor time [s], median", 3),
        GridColumn("processor_seconds_p95", "95 % quantile", 3),
        GridColumn("seconds_median", "by the clock [s], median", 3),
        GridColumn("training_simulations", "training simulations", 6),
        GridColumn("training_seconds", "training [s]", 3),
    )
    title = "What answers cost: costs.csv"
    return page.render_grid(DataGrid("prices", title, "costs", columns, (), {}, "", "diagnoser"))


def render_answers_table(shown: DiagnoserReportData, page: HtmlPage) -> str:
    """Render items.csv: one row per answer."""
    page.add_table("items", shown.rows, 6)
    columns = (
        GridColumn("question"),
        GridColumn("diagnoser"),
        GridColumn("size", "size [noises]", 3),
        GridColumn("noise"),
        GridColumn("rate", "rate [Hz]", 6),
        GridColumn("runs", digits=6),
        GridColumn("verdict", "says"),
        GridColumn("named"),
        GridColumn("outcome"),
        GridColumn("p_value", "p", 2),
        GridColumn("simulations", digits=6),
        GridColumn("processor_seconds", "processor time [s]", 3),
        GridColumn("reason"),
    )
    filters = ("diagnoser", "kind", "system", "hidden", "noise", "outcome", "status")
    title = "Every answer: items.csv"
    return page.render_grid(
        DataGrid("answers", title, "items", columns, filters, {}, "", "diagnoser")
    )
