"""HTML report of a comparison of diagnosers: its tables, conclusions and warnings."""

from __future__ import annotations

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import pandas as pd

from bench.diagnosis_benchmark.diagnoser_figures import (
    DiagnoserReportData,
    build_chart_tables,
    make_charts,
)
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

_SIGNIFICANCE_LEVEL = 0.05
"""Maximum Holm-corrected p-value for a significant difference between two diagnosers."""


def count_own_failures(data: DiagnoserReportData) -> dict[str, tuple[int, int]]:
    """Count the incorrect graded answers of simgap itself, and all of them, by kind of case.

    The report states these numbers, so that the failures of simgap itself are visible. Answers on
    effects smaller than the noise are not graded.

    Args:
        data: graded answers of all diagnosers.

    Returns:
        By kind of case, the number of incorrect graded answers and of all graded answers.
    """
    rows = select_graded_answers(data.rows[data.rows["diagnoser"] == REFERENCE_DIAGNOSER])
    wrong = rows[~is_correct(rows)]["kind"].value_counts()
    counts = rows["kind"].value_counts()
    return {kind: (int(wrong.get(kind, 0)), int(counts[kind])) for kind in counts.index}


def find_leader(data: DiagnoserReportData) -> dict[str, Any] | None:
    """Find the best diagnoser among those with few false alarms.

    The best one has the highest primary metric. Diagnosers with more than `TARGET_FALSE_ALARM_RATE`
    false alarms cannot lead, because a diagnoser that always alarms finds every cause.

    Args:
        data: graded answers and result tables of all diagnosers.

    Returns:
        * Without clean cases, in which false alarms could be counted: None.
        * If no diagnoser has few false alarms: a dictionary whose ``candidates`` are empty.
        * Otherwise ``name`` of the best one; ``candidates``, the diagnosers with few false alarms;
          ``alarms`` and ``named``, the rows of the best one in table.csv for false alarms and named
          causes. If the best one is simgap, ``similar`` are the candidates that do not differ
          significantly from it, and ``p_value`` is the largest p-value of these comparisons.
    """
    alarms = index_by_diagnoser(data.tables["table"], "false alarms")
    named = index_by_diagnoser(data.tables["table"], PRIMARY_METRIC)
    if not any(row["of"] for row in alarms.values()):
        return None
    candidates = [
        name
        for name in data.order
        if alarms[name]["share"] <= TARGET_FALSE_ALARM_RATE and named[name]["of"]
    ]
    if not candidates:
        return {"candidates": []}
    best = max(candidates, key=lambda name: float(named[name]["share"]))
    rows = {"alarms": alarms[best], "named": named[best]}
    leader = {"name": best, "candidates": candidates, **rows, "similar": [], "p_value": None}
    if best != REFERENCE_DIAGNOSER or len(candidates) == 1:
        return leader
    # McNemar's test, corrected by Holm's method for several comparisons.
    pairs = index_by_diagnoser(data.tables["pairs"], "named")
    p_values = {name: float(pairs[name]["p_holm"]) for name in candidates if name != best}
    similar = [name for name, p_value in p_values.items() if p_value >= _SIGNIFICANCE_LEVEL]
    return {**leader, "similar": similar, "p_value": max(p_values.values())}


def list_better_diagnosers(data: DiagnoserReportData) -> list[dict[Hashable, Any]]:
    """List the rows of pairs.csv in which another diagnoser is significantly better than simgap."""
    pairs = data.tables["pairs"]
    if pairs.empty:
        return []
    significant = pairs["p_holm"] < _SIGNIFICANCE_LEVEL
    return pairs[significant & (pairs["only_other"] > pairs["only_simgap"])].to_dict("records")


def summarise_unsupported(left_out: pd.DataFrame) -> list[tuple[str, str, int]]:
    """Count the cases that diagnosers do not support, by diagnoser and reason.

    Args:
        left_out: rows of unsupported cases, with columns diagnoser and reason.

    Returns:
        List of (diagnoser, reason, number of cases).
    """
    groups = left_out.groupby(["diagnoser", "reason"], sort=False).size().reset_index(name="of")
    return [
        (str(diagnoser), str(reason), int(count))
        for diagnoser, reason, count in groups.itertuples(index=False)
    ]


_TEMPLATE = Path(__file__).with_name("diagnosers.html")
_DIGITS = 6
"""Number of significant digits of stored numbers."""


def render_page(data: DiagnoserReportData) -> str:
    """Render the HTML report of a comparison of diagnosers.

    The tables are embedded in the page for its charts; the numbers of the text are computed here.

    Args:
        data: graded answers and result tables of all diagnosers.
    """
    page = HtmlPage(data.pictures)
    failures = build_failure_table(data.rows, data.order)
    tables = {**data.tables, "failures": failures, "items": data.rows}
    tables |= build_chart_tables(data)
    page.add_tables(tables, _DIGITS)
    groups, confusion, costs = (data.tables[name] for name in ("groups", "confusion", "costs"))
    # Entries of the page's menus; the first choices are set below.
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
        alarm_limit=TARGET_FALSE_ALARM_RATE,
        better=better_diagnosers,
        has_pairs=len(data.tables["pairs"]) > 0,
        trust_note=TRUSTED_TUNERS_NOTE if data.experiment.trusted else "",
        unanswered=data.rows[data.rows["status"] != "done"].groupby("diagnoser").size(),
        unsupported=summarise_unsupported(data.left_out),
        has_own_failures=bool((failures["diagnoser"] == REFERENCE_DIAGNOSER).any()),
        charts=make_charts(data),
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
