"""Write the tables, figures and HTML report of a comparison of diagnosers and print a summary."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import pandas as pd

from bench.benchmark.comparison_report import REPORT_FILE
from bench.benchmark.problem.experiment import Experiment
from bench.diagnosis_benchmark.answer_store import read_answers
from bench.diagnosis_benchmark.case_set import build_case_set, read_config
from bench.diagnosis_benchmark.diagnoser_figures import DiagnoserReportData, draw_figures
from bench.diagnosis_benchmark.diagnoser_page import render_page, summarise_unsupported
from bench.diagnosis_benchmark.diagnoser_training import read_training_costs
from bench.diagnosis_benchmark.result_tables import (
    PRIMARY_METRIC,
    SKIPPED_STATUS,
    build_all_tables,
    build_answer_rows,
    build_failure_table,
    index_by_diagnoser,
    select_fully_answered_cases,
)
from bench.figures.figure_output import write_figures
from bench.pages.template import render_text
from sims.core.files import write_atomically

ANSWERS_TABLE_FILE = "items.csv"
"""File with one row per answer."""


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


_TEMPLATE = Path(__file__).with_name("diagnosers.txt")
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
        _TEMPLATE,
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
