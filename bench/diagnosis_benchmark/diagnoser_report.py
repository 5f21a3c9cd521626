"""Report a comparison of diagnosers: tables, figures, HTML report and printed summary.

The conclusions and warnings of the HTML report are computed here, the tables in `result_tables`,
and the charts in `diagnoser_figures`.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from bench.benchmark.comparison_report import REPORT_FILE
from bench.benchmark.problem.experiment_config import Experiment
from bench.diagnosis_benchmark.answer_store import read_answers
from bench.diagnosis_benchmark.case_set import build_case_set, read_config
from bench.diagnosis_benchmark.diagnoser_figures import (
    DiagnoserReportData,
    build_chart_tables,
    draw_figures,
    make_charts,
)
from bench.diagnosis_benchmark.diagnoser_training import read_training_costs
from bench.diagnosis_benchmark.result_tables import (
    PRIMARY_METRIC,
    REFERENCE_DIAGNOSER,
    SKIPPED_STATUS,
    TARGET_FALSE_ALARM_RATE,
    build_all_tables,
    build_answer_rows,
    build_failure_table,
    index_by_diagnoser,
    is_correct,
    select_fully_answered_cases,
    select_graded_answers,
)
from bench.figures.figure_layout import TRUSTED_TUNERS_NOTE
from bench.figures.figure_output import write_figures
from bench.pages.html_page import HtmlPage
from bench.pages.template import render_text
from sims.core.files import write_atomically

ANSWERS_TABLE_FILE = "items.csv"
"""File with one row per answer."""
_PAGE_TEMPLATE = Path(__file__).with_name("diagnosers.html")
_PAGE_DIGITS = 6
"""Number of significant digits of the tables that are embedded in the page."""
_SUMMARY_TEMPLATE = Path(__file__).with_name("diagnosers.txt")
_SUMMARY_METRICS = {
    "false alarms": "false alarms",
    "named, alone": "named alone",
    PRIMARY_METRIC: "in a set of 2",
    "pairs: both named": "both of two",
    "foreign causes: unknown or partial": "foreign",
}
"""Metrics of the printed leaderboard, with the headings of their columns."""
_MAX_LISTED_FAILURES = 5
"""Maximum number of failed answers that are printed."""
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
    page.add_tables(tables, _PAGE_DIGITS)
    groups, confusion, costs = (data.tables[name] for name in ("groups", "confusion", "costs"))
    # Entries of the page's menus; the first choices are set below.
    metrics = list(dict.fromkeys(groups["metric"]))
    confused = list(dict.fromkeys(confusion["diagnoser"]))
    better_diagnosers = list_better_diagnosers(data)
    trained = costs[costs["training_simulations"] > 0]
    return page.render(
        _PAGE_TEMPLATE,
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


def write_report(
    folder: Path,
    experiment: Experiment,
    skipped_diagnosers: Mapping[str, str],
    print_line: Callable[[str], None],
) -> int:
    """Write tables, figures and HTML report from the answers that exist.

    Only cases that every diagnoser has answered are reported.

    Args:
        folder: result folder.
        experiment: configuration of the comparison.
        skipped_diagnosers: diagnosers that cannot be used here, by name, with the reason.
        print_line: prints one line.

    Returns:
        Number of failed answers.
    """
    for name, reason in skipped_diagnosers.items():
        print_line(f"skipped: {name}: {reason}")
    config, answers = read_config(experiment), read_answers(folder)
    order = [name for name in config.diagnosers if name not in skipped_diagnosers]
    all_rows = build_answer_rows(answers, order)
    if all_rows.empty:
        print_line("no answers yet")
        return 0
    rows = select_fully_answered_cases(all_rows, order)
    if rows.empty:
        print_line("no case has been given to every diagnoser yet")
        return 0
    training = read_training_costs(folder)
    write_atomically(folder / ANSWERS_TABLE_FILE, format_csv(rows))
    # Cases that a diagnoser does not support are listed, but count in no table.
    left_out = rows[rows["status"] == SKIPPED_STATUS]
    rows = rows[rows["status"] != SKIPPED_STATUS]
    tables = build_all_tables(rows, order, training)
    for name, frame in {**tables, "failures": build_failure_table(rows, order)}.items():
        write_atomically(folder / f"{name}.csv", format_csv(frame))
    report_data = DiagnoserReportData(
        experiment=experiment,
        folder=str(folder),
        order=order,
        rows=rows,
        tables=tables,
        training=training,
        pictures={},
        skipped=skipped_diagnosers,
        planned=len(build_case_set(config)),
        left_out=left_out,
    )
    # The figures are drawn from the data of the report, which then include them.
    report_data = replace(report_data, pictures=draw_figures(report_data))
    write_figures(folder, report_data.pictures)
    write_atomically(folder / REPORT_FILE, render_page(report_data))
    failed = rows[rows["status"] != "done"]
    # The document of a case is empty if the sensors cannot show its hidden cause.
    undetectable_count = sum(not answer["item"] for answer in answers.values())
    for line in _render_summary(report_data, failed, undetectable_count, folder / REPORT_FILE):
        print_line(line)
    return len(failed)


def _render_summary(
    data: DiagnoserReportData, failed: pd.DataFrame, undetectable_count: int, report_path: Path
) -> list[str]:
    """Render the lines of the summary that the command prints: a leaderboard with costs.

    Args:
        data: graded answers and result tables of all diagnosers.
        failed: rows of the failed answers.
        undetectable_count: number of cases whose hidden cause the sensors cannot show.
        report_path: path of the HTML report.
    """
    table = data.tables["table"]
    return render_text(
        _SUMMARY_TEMPLATE,
        shown=data,
        shares={metric: index_by_diagnoser(table, metric) for metric in _SUMMARY_METRICS},
        columns=list(_SUMMARY_METRICS.values()),
        costs=index_by_diagnoser(data.tables["costs"]),
        unsupported=summarise_unsupported(data.left_out),
        undetectable_count=undetectable_count,
        answers_file=ANSWERS_TABLE_FILE,
        report_path=report_path,
        failed=failed.to_dict("records"),
        max_failures=_MAX_LISTED_FAILURES,
    )


def format_csv(frame: pd.DataFrame) -> str:
    """Format a table as CSV text."""
    text: str = frame.to_csv(index=False, float_format="%.6g", lineterminator="\n")
    return text
