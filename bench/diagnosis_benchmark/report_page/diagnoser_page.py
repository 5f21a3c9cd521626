"""Report of a comparison of diagnosers: conclusions, warnings and values of `diagnosers.html`."""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from bench.diagnosis_benchmark.report_page import diagnoser_charts as charts
from bench.diagnosis_benchmark.report_page.diagnoser_charts import DiagnoserReportData
from bench.diagnosis_benchmark.result_tables import (
    PRIMARY_METRIC,
    REFERENCE_DIAGNOSER,
    TARGET_FALSE_ALARM_RATE,
    build_failure_table,
    index_by_diagnoser,
    is_correct,
    select_graded_answers,
)
from bench.figures.style import TRUSTED_TUNERS_NOTE
from bench.pages.html_page import HtmlPage
from bench.pages.text_format import format_p_value, format_percent, sanitise

_SIGNIFICANCE_LEVEL = 0.05
"""Maximum Holm-corrected p-value for a significant difference between two diagnosers."""
_SENTENCES_BY_KIND = {
    "clean": "false alarms in {of} clean recordings",
    "single": "of {of} single effects of at least one noise",
    "double": "of {of} pairs",
    "foreign": "of {of} causes outside the library",
}


class OwnFailures(NamedTuple):
    """Number of questions that simgap fails on, of all questions, and failures by kind."""

    wrong: int
    questions: int
    kinds: list[str]


def count_own_failures(data: DiagnoserReportData) -> OwnFailures | None:
    """Count the incorrect graded answers of simgap itself, in total and by kind of case.

    The report states these numbers, so that the failures of simgap itself are visible.

    Returns:
        The counts; None if simgap does not take part in the comparison.
    """
    graded_rows = select_graded_answers(data.rows[data.rows["diagnoser"] == REFERENCE_DIAGNOSER])
    if graded_rows.empty:
        return None
    wrong_rows = graded_rows[~is_correct(graded_rows)]
    counts = {kind: int((graded_rows["kind"] == kind).sum()) for kind in _SENTENCES_BY_KIND}
    kinds = [
        f"{int((wrong_rows['kind'] == kind).sum())} {_SENTENCES_BY_KIND[kind].format(of=count)}"
        for kind, count in counts.items()
        if count
    ]
    return OwnFailures(len(wrong_rows), len(graded_rows), kinds)


class Leader(NamedTuple):
    """Best diagnoser among those with few false alarms.

    Attributes:
        name: Name of the diagnoser; empty if all have too many false alarms.
        candidates: Names of the diagnosers with few false alarms.
        share: Causes that it names.
        significance: Whether its lead over the others is significant.
        clean: Number of clean recordings.
        alarms: Its false alarms in words; empty if they show that its rate is below the limit.
        alarm_limit: Upper limit of its rate of false alarms.
    """

    name: str
    candidates: tuple[str, ...] = ()
    share: str = ""
    significance: str = ""
    clean: int = 0
    alarms: str = ""
    alarm_limit: float = 0.0


def find_leader(data: DiagnoserReportData) -> Leader | None:
    """Find the best diagnoser among those with few false alarms.

    The best one has the highest primary metric. Diagnosers with more than `TARGET_FALSE_ALARM_RATE`
    false alarms cannot lead, because a diagnoser that always alarms finds every cause.

    Returns:
        The best diagnoser; None if there are no clean cases.
    """
    table = data.tables["table"]
    alarms = index_by_diagnoser(table, "false alarms")
    named_shares = index_by_diagnoser(table, PRIMARY_METRIC)
    if not any(row["of"] for row in alarms.values()):
        return None
    with_few_alarms = [
        name for name in data.order if alarms[name]["share"] <= TARGET_FALSE_ALARM_RATE
    ]
    candidates = [name for name in with_few_alarms if named_shares[name]["of"]]
    if not candidates:
        return Leader("")
    leader = max(candidates, key=lambda name: float(named_shares[name]["share"]))
    other_names = [name for name in candidates if name != leader]
    low, high = (format_percent(named_shares[leader][end]) for end in ("low", "high"))
    share_text = (
        f"{int(named_shares[leader]['count'])} of {int(named_shares[leader]['of'])}, "
        f"{format_percent(named_shares[leader]['share'])} (95 % interval {low} to {high})"
    )
    row, text = alarms[leader], ""
    if row["high"] > TARGET_FALSE_ALARM_RATE:
        text = f"{int(row['count'])} false alarm{'s' if row['count'] != 1 else ''}"
    significance = _format_significance(data, leader, other_names)
    return Leader(
        leader,
        tuple(candidates),
        share_text,
        significance,
        int(row["of"]),
        text,
        float(row["high"]),
    )


def _format_significance(data: DiagnoserReportData, best: str, other_names: list[str]) -> str:
    """Say whether simgap as the best diagnoser differs significantly from the others.

    Args:
        data: tables of the comparison.
        best: name of the best diagnoser.
        other_names: names of the others.

    Returns:
        One sentence, or an empty text if there are no others or if simgap is not the best: only
        pairs with simgap are tested.
    """
    if not other_names or best != REFERENCE_DIAGNOSER:
        return ""
    rows = index_by_diagnoser(data.tables["pairs"], "named")
    similar = [name for name in other_names if float(rows[name]["p_holm"]) >= _SIGNIFICANCE_LEVEL]
    if similar:
        return f"It does not differ significantly from {', '.join(similar)} (McNemar, Holm)."
    largest = max(float(rows[name]["p_holm"]) for name in other_names)
    return f"It differs significantly from all others ({format_p_value(largest)}; McNemar, Holm)."


def list_better_diagnosers(data: DiagnoserReportData) -> list[dict[Hashable, Any]]:
    """List the rows of pairs.csv in which another diagnoser is significantly better than simgap."""
    pairs = data.tables["pairs"]
    if pairs.empty:
        return []
    significant = pairs["p_holm"] < _SIGNIFICANCE_LEVEL
    return pairs[significant & (pairs["only_other"] > pairs["only_simgap"])].to_dict("records")


def write_warnings(data: DiagnoserReportData) -> Iterator[str]:
    """Yield sentences about limitations of the results.

    They concern diagnosers without isolation, missing cases, failed answers, unsupported cases, and
    skipped diagnosers.

    Args:
        data: the data of the report.
    """
    if data.experiment.trusted:
        yield f"{TRUSTED_TUNERS_NOTE.capitalize()}."
    if data.case_count < data.planned:
        yield (
            f"{data.case_count} of {data.planned} questions: those that every diagnoser has "
            "answered. Questions are asked in random order, so these are a fair sample."
        )
    failed = data.rows[data.rows["status"] != "done"]
    if len(failed):
        counts = failed.groupby("diagnoser").size()
        counts_text = ", ".join(f"{sanitise(name, 60)} {count}" for name, count in counts.items())
        yield f"Without an answer (crashed, too late or too costly): {counts_text}."
    for name, reason, count in summarise_unsupported(data.left_out):
        yield f"{sanitise(name, 60)} does not support {count} of the cases: {reason}."
    for name, reason in data.skipped.items():
        yield f"{sanitise(name, 60)} was not run: {reason}"


def summarise_unsupported(left_out: pd.DataFrame) -> list[tuple[str, str, int]]:
    """Count the cases that diagnosers do not support, by diagnoser and reason.

    Args:
        left_out: rows of unsupported cases, with columns diagnoser and reason.

    Returns:
        List of (diagnoser, reason, number of cases).
    """
    groups = left_out.groupby(["diagnoser", "reason"], sort=False).size().reset_index(name="of")
    return [
        (str(n), str(reason), int(count)) for n, reason, count in groups.itertuples(index=False)
    ]


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
    better_diagnosers = list_better_diagnosers(data)
    trained = costs[costs["training_simulations"] > 0]
    return page.render(
        _TEMPLATE,
        shown=data,
        REFERENCE=REFERENCE_DIAGNOSER,
        PRIMARY_METRIC=PRIMARY_METRIC,
        own=count_own_failures(data),
        leader=find_leader(data),
        limit=f"{100 * TARGET_FALSE_ALARM_RATE:g} %",
        better=better_diagnosers,
        has_pairs=len(data.tables["pairs"]) > 0,
        warnings=list(write_warnings(data)),
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
