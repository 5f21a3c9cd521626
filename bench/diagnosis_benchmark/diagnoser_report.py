"""Write the tables, figures and HTML report of a comparison of diagnosers and print a summary."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import pandas as pd

from bench.benchmark.comparison_report import REPORT_FILE
from bench.benchmark.storage.result_folder import FolderConfiguration
from bench.diagnosis_benchmark import diagnoser_figures
from bench.diagnosis_benchmark.answer_store import SKIPPED_STATUS, AnswersByCase, build_answer_rows
from bench.diagnosis_benchmark.case_set import CaseSpec
from bench.diagnosis_benchmark.diagnoser_figures import draw_confusion_matrices
from bench.diagnosis_benchmark.diagnoser_page import (
    DiagnoserReportData,
    render_page,
    summarise_unsupported,
)
from bench.diagnosis_benchmark.diagnoser_training import read_training_costs
from bench.diagnosis_benchmark.result_tables import (
    PRIMARY_METRIC,
    build_all_tables,
    build_failure_table,
    index_by_diagnoser,
    select_fully_answered_cases,
    select_single_effects,
)
from bench.figures.figure_output import FigureFiles, render_all_formats, write_figure_files
from bench.figures.style import add_trust_note
from sims.core.files import write_atomically
from sims.core.plain_values import align_columns

ANSWERS_TABLE_FILE = "items.csv"
"""File with one row per answer."""


class ReportableDiagnosisStudy(Protocol):
    """Protocol of the studies that can be reported; see `diagnoser_study.DiagnosisStudy`."""

    folder: Path
    configuration: FolderConfiguration

    @property
    def answers(self) -> AnswersByCase:
        """All stored answers."""

    @property
    def cases(self) -> list[CaseSpec]:
        """All cases of the experiment."""

    @property
    def usable_diagnosers(self) -> list[str]:
        """Names of the diagnosers that can be used here."""

    @property
    def skipped_diagnosers(self) -> dict[str, str]:
        """Diagnosers that cannot be used here, with the reason."""


def write_report(study: ReportableDiagnosisStudy, print_line: Callable[[str], None]) -> int:
    """Write tables, figures and HTML report from the answers that exist.

    Only cases that every diagnoser has answered are reported.

    Args:
        study: the study to report.
        print_line: prints one line.

    Returns:
        Number of failed answers.
    """
    for name, reason in study.skipped_diagnosers.items():
        print_line(f"skipped: {name}: {reason}")
    order = study.usable_diagnosers
    all_rows = build_answer_rows(study.answers, order)
    if all_rows.empty:
        print_line("no answers yet")
        return 0
    rows = select_fully_answered_cases(all_rows, order)
    if rows.empty:
        print_line("no case has been given to every diagnoser yet")
        return 0
    training = read_training_costs(study.folder)
    write_atomically(study.folder / ANSWERS_TABLE_FILE, format_csv(rows))
    left_out = rows[rows["status"] == SKIPPED_STATUS]
    rows = rows[rows["status"] != SKIPPED_STATUS]
    tables = build_all_tables(rows, order, training)
    for name, frame in {**tables, "failures": build_failure_table(rows, order)}.items():
        write_atomically(study.folder / f"{name}.csv", format_csv(frame))
    report_data = DiagnoserReportData(
        study.configuration.experiment,
        str(study.folder),
        order,
        rows,
        tables,
        training,
        {},
        study.skipped_diagnosers,
        len(study.cases),
        left_out,
    )
    report_data = replace(report_data, pictures=draw_figures(report_data))
    for name, picture in report_data.pictures.items():
        write_figure_files(study.folder / "figures" / name, picture.png, picture.pdf)
    write_atomically(study.folder / REPORT_FILE, render_page(report_data))
    for line in format_summary(tables, order):
        print_line(line)
    for name, reason, count in summarise_unsupported(left_out):
        print_line(f"{name} does not support {count} of the cases: {reason}")
    answered_count, planned_count = rows["question"].nunique(), len(study.cases)
    undetectable_count = sum(not answer["item"] for answer in study.answers.values())
    print_line(
        f"{answered_count} questions of {planned_count}; of {undetectable_count} the sensors "
        "cannot show what is hidden"
    )
    print_line(
        f"written: {study.folder}/ with {ANSWERS_TABLE_FILE}, "
        f"{', '.join(f'{n}.csv' for n in tables)}"
    )
    print_line(f"figures: {', '.join(f'{name}.png' for name in sorted(report_data.pictures))}")
    print_line(f"report: {study.folder / REPORT_FILE}")
    failed = rows[rows["status"] != "done"]
    for _, row in failed.head(_MAX_LISTED_FAILURES).iterrows():
        print_line(f"{row['status']}: {row['diagnoser']} on {row['question']}: {row['reason']}")
    if len(failed) > _MAX_LISTED_FAILURES:
        print_line(f"({len(failed)} answers failed; see {ANSWERS_TABLE_FILE})")
    return len(failed)


_MAX_LISTED_FAILURES = 5
"""Maximum number of failed answers that are printed."""


def format_csv(frame: pd.DataFrame) -> str:
    """Format a table as CSV text."""
    text: str = frame.to_csv(index=False, float_format="%.6g", lineterminator="\n")
    return text


def draw_figures(data: DiagnoserReportData) -> dict[str, FigureFiles]:
    """Draw every figure for which there is data.

    Outcomes and confusion need clean cases and cases with one effect.

    Args:
        data: the data of the report; its printed figures are not used.

    Returns:
        Figures by name.
    """
    figures = diagnoser_figures.draw_chart_figures(data)
    if data.counts["clean_count"] and data.counts["single_count"]:
        singles = select_single_effects(data.rows)
        figures["outcomes"] = diagnoser_figures.draw_outcomes(singles, data.order, data.title)
        figures["confusion"] = draw_confusion_matrices(data.rows, data.order, data.title)
    return {
        name: render_all_formats(add_trust_note(figure, data.experiment.trusted))
        for name, figure in figures.items()
    }


def format_summary(tables: Mapping[str, pd.DataFrame], order: Sequence[str]) -> list[str]:
    """Format the leaderboard as aligned text lines.

    Args:
        tables: tables by name.
        order: names of the diagnosers.

    Returns:
        A header line and one line per diagnoser with its false alarms, diagnosed single causes,
        pairs, unmodelled causes and median cost.
    """
    columns = (
        ("false alarms", "false alarms"),
        ("named, alone", "named alone"),
        (PRIMARY_METRIC, "in a set of 2"),
        ("pairs: both named", "both of two"),
        ("foreign causes: unknown or partial", "foreign"),
    )
    rows_by_metric = {metric: index_by_diagnoser(tables["table"], metric) for metric, _ in columns}
    costs = index_by_diagnoser(tables["costs"])
    head = ["diagnoser", *(title for _, title in columns), "simulations", "seconds"]
    lines = [head]
    for name in order:
        cells = [name]
        for metric, _ in columns:
            line = rows_by_metric[metric][name]
            interval = f"{100 * line['low']:.0f}-{100 * line['high']:.0f}"
            cells.append(f"{100 * line['share']:.0f} % ({interval})" if line["of"] else "-")
        cost = costs[name]
        cells += [f"{cost['simulations_median']:.0f}", f"{cost['processor_seconds_median']:.2f}"]
        lines.append(cells)
    return align_columns(lines, len(head))
