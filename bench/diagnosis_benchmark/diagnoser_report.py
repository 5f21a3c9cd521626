"""Write the tables, figures and HTML report of a comparison of diagnosers and print a summary.

The printed figures are readable in greyscale.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bench.benchmark.comparison_report import REPORT_FILE
from bench.benchmark.problem.experiment import Experiment
from bench.diagnosis_benchmark.answer_store import read_answers
from bench.diagnosis_benchmark.case_set import build_case_set, read_config
from bench.diagnosis_benchmark.diagnoser_page import (
    DiagnoserReportData,
    build_chart_tables,
    make_charts,
    render_page,
    summarise_unsupported,
)
from bench.diagnosis_benchmark.diagnoser_training import read_training_costs
from bench.diagnosis_benchmark.result_tables import (
    PRIMARY_METRIC,
    SKIPPED_STATUS,
    build_all_tables,
    build_answer_rows,
    build_failure_table,
    index_by_diagnoser,
    is_correct,
    select_fully_answered_cases,
    select_graded_answers,
    select_single_effects,
)
from bench.figures import style
from bench.figures.figure_output import FigureFiles, render_all_formats, write_figures
from bench.figures.style import add_trust_note
from bench.pages.chart_figure import draw_chart, finish_chart
from bench.pages.template import render_text
from sims.core.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

OUTCOME_STYLES = (
    ("right", style.BLACK, "named, alone"),
    ("set", style.BLUE, "in a set"),
    ("class", style.SKY_BLUE, "an equivalent one"),
    ("extra", style.ORANGE, "named, with another one"),
    ("wrong", style.VERMILION, "something else named"),
    ("unnamed", style.NOISE_BAND_GREY, "detected, not named"),
    ("missed", style.RECORDED_PART_GREY, "not detected"),
    ("undecided", style.RECORDED_PART_GREY, "unidentifiable"),
    ("failed", style.PURPLE, "no answer"),
)
"""Outcomes of single effects, the best first, with colour and legend text."""
_CHART_CAPTIONS = {
    "board": (
        "{clean_count} recordings with nothing hidden, {single_count} with one effect of at least "
        "one noise. Named: alone or in a set of at most two, equivalent effects being one. Bars: "
        "95 % intervals (Wilson). Dashes: 1 % of false alarms."
    ),
    "cost": "Marks: medians; bars: 95 % intervals (Wilson).",
    "power": (
        "Recordings with one hidden effect: {power_counts}. Bands: 95 % intervals (Wilson). "
        "Compare with the false alarms: a diagnoser that always alarms detects everything."
    ),
    "calibration": (
        "Up to {calibration_count} recordings with nothing hidden. Dashes: calibrated p-values. "
        "Below: conservative; above: too many alarms. Bands: 95 % intervals (Clopper-Pearson)."
    ),
}
"""Captions of the charts of the page that are also printed, by name."""
_SINGLE_PANEL_SIZE = (6.0, 4.0)
"""Width and height of the panel of a figure with one panel, in inches."""


def draw_chart_figures(data: DiagnoserReportData) -> dict[str, Figure]:
    """Draw the charts of the page that have data and a caption, by name.

    Args:
        data: the data of the report; its printed figures are not used.
    """
    tables = {**data.tables, **build_chart_tables(data)}
    charts, figures = make_charts(data), {}
    for name, caption in _CHART_CAPTIONS.items():
        if charts[name]:
            size = _SINGLE_PANEL_SIZE if len(charts[name]) == 1 else None
            figure, axes = draw_chart(charts[name], tables, size=size)
            text = caption.format(**data.counts)
            figures[name] = finish_chart(figure, axes[0], data.title, text, "outside right upper")
    return figures


def draw_outcomes(rows: pd.DataFrame, order: Sequence[str], title: str) -> Figure:
    """Draw the outcomes of all recordings with one hidden effect, as stacked bars.

    Each diagnoser has a bar whose parts are the outcomes, such as right, ambiguous, wrong or
    missed, in per cent of the recordings.

    Args:
        rows: one row per answer on a single effect.
        order: names of the diagnosers.
        title: title of the figure.
    """
    # Width and height in inches, with the space for each diagnoser.
    figure, axes = style.make_panel_grid(1, 1, (8.6, 0.5 * len(order) + 2.2))
    axis: Axes = axes[0][0]
    styles = {outcome: (colour, label) for outcome, colour, label in OUTCOME_STYLES}
    counts = pd.crosstab(rows["diagnoser"], rows["outcome"]).reindex(
        index=list(order), columns=list(styles), fill_value=0
    )
    # Each diagnoser has answered all recordings, so the sums are equal; at least 1 for a division.
    total = max(int(counts.sum(axis=1).max()), 1)
    bar_starts = np.zeros(len(order))
    for outcome in counts.columns[counts.any()]:
        colour, label = styles[outcome]
        widths = 100.0 * counts[outcome].to_numpy() / total
        bars = axis.barh(
            list(order),
            widths,
            left=bar_starts,
            color=colour,
            edgecolor=style.NEUTRAL_MARK,
            linewidth=0.5,
            label=label,
        )
        is_dark = colour in (style.BLACK, style.BLUE, style.VERMILION)
        axis.bar_label(
            bars,
            # A narrower part has no room for its number.
            [str(n) if width > 4 else "" for n, width in zip(counts[outcome], widths, strict=True)],
            label_type="center",
            fontsize=8,
            color="white" if is_dark else style.NEUTRAL_MARK,
        )
        bar_starts += widths
    axis.invert_yaxis()
    axis.set_xlim(0, 100)
    axis.set_xlabel("recordings with one hidden effect of at least one noise [%]")
    style.style_axis(axis)
    axis.grid(visible=False)
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=8.5)
    figure.suptitle(title, fontsize=11)
    style.add_caption(figure, f"{total} recordings; numbers in bars count them.", letters=16)
    return figure


_FAMILY_LABELS = ("several", "unknown", "nothing", "no answer")
"""Answers that are not the name of a family; `nothing` means that the simulation is adequate."""
_PANELS_PER_ROW = 4
"""Maximum number of panels in a row."""
_MIN_LABELLED_PERCENT = 10.0
"""Minimum percentage of its row for which a cell shows its number."""


def draw_confusion_matrices(rows: pd.DataFrame, order: Sequence[str], title: str) -> Figure:
    """Draw one confusion matrix of cause families for each diagnoser.

    Rows are the families of the hidden causes, columns those of the answers, in per cent of a row.
    Cases with two hidden causes are left out.
    """
    graded_rows = select_graded_answers(rows[rows["kind"] != "double"])
    graded_rows = graded_rows.assign(
        family=_list_hidden_families(graded_rows), answer=_list_answer_families(graded_rows)
    )
    hidden = sorted(set(graded_rows["family"]), key=lambda name: (name in _LAST_ROW_LABELS, name))
    answer_labels = [name for name in hidden if name not in _LAST_ROW_LABELS]
    answer_labels += sorted(set(graded_rows["answer"]) - {*answer_labels, *_FAMILY_LABELS})
    answer_labels += [name for name in _FAMILY_LABELS if (graded_rows["answer"] == name).any()]
    column_count = min(_PANELS_PER_ROW, len(order))
    row_count = -(-len(order) // column_count)  # rounded up
    size = (
        # Width and height in inches, with the space for each label.
        1.6 + column_count * max(2.2, 0.16 * len(answer_labels)),
        1.4 + row_count * max(1.4, 0.17 * len(hidden)),
    )
    figure, axes = style.make_panel_grid(row_count, column_count, size, sharex=True, sharey=True)
    for panel_index, axis in enumerate(axes.flat):
        if panel_index >= len(order):  # the last row of panels is not full
            axis.set_axis_off()
            continue
        diagnoser_rows = graded_rows[graded_rows["diagnoser"] == order[panel_index]]
        counts = pd.crosstab(diagnoser_rows["family"], diagnoser_rows["answer"]).reindex(
            index=hidden, columns=answer_labels, fill_value=0
        )
        _draw_confusion_matrix(axis, counts, order[panel_index])
    figure.suptitle(title, fontsize=11)
    figure.supylabel("hidden", fontsize=9)
    cases = graded_rows.drop_duplicates("question")
    style.add_caption(
        figure,
        f"{len(cases)} recordings with nothing hidden, one effect of at least one noise or a "
        "foreign cause. Per cent of a row. Black frames: right. A cause that is found alone or in "
        "a set of at most two counts as its family, otherwise the first named cause counts.",
        letters=16,
    )
    return figure


_LAST_ROW_LABELS = ("(foreign)", "(clean)")
"""Row labels that follow below those of the effect families."""
_CORRECT_ANSWERS = {"(clean)": ("nothing",), "(foreign)": ("unknown",)}
"""Correct answers for the rows of clean recordings and unmodelled causes."""


def _list_hidden_families(rows: pd.DataFrame) -> pd.Series[str]:
    """Return the row of the confusion matrix of each answer: the family of the hidden effect.

    The family is the part of the name before the dot. Clean recordings and unmodelled causes have
    the rows ``(clean)`` and ``(foreign)``.
    """
    family = rows["hidden"].astype(str).str.partition(".")[0]
    return family.where(rows["kind"] == "single", "(" + rows["kind"] + ")")


def _list_answer_families(rows: pd.DataFrame) -> list[str]:
    """Return the column of the confusion matrix of each answer.

    It is the family that the answer names, or one of `_FAMILY_LABELS`.

    Args:
        rows: one row per answer.
    """
    correct = is_correct(rows)
    return [
        _get_answer_family(row, is_right)
        for row, is_right in zip(rows.to_dict("records"), correct, strict=True)
    ]


def _get_answer_family(row: dict[Any, Any], is_right: bool) -> str:
    """Return the family that an answer names, or the label of an answer without a family.

    The family is the part of an effect's name before the dot, as ``friction``. An answer that is
    correct because its small set contains the cause counts as the hidden family, otherwise the
    leading name counts.

    Args:
        row: row of the answer; its ``named`` has the causes separated by " + ", and the
            alternatives of a cause separated by bars.
        is_right: whether the answer is correct.
    """
    if row["status"] != "done":
        return "no answer"
    if row["verdict"] == "adequate":
        return "nothing"
    if is_right and row["kind"] == "single":
        return str(row["hidden"]).partition(".")[0]
    if row["verdict"] in ("unknown", "unidentifiable") or (is_right and row["kind"] == "foreign"):
        return "unknown"
    named_effects = str(row["named"] or "")
    if not named_effects:
        return "unknown"
    if " + " in named_effects:
        return "several"
    leading_name = named_effects.partition("|")[0]
    return leading_name.partition(".")[0]


def _draw_confusion_matrix(axis: Axes, counts: pd.DataFrame, name: str) -> None:
    """Draw the confusion matrix of one diagnoser in per cent; frames mark correct answers.

    Args:
        axis: axes to draw on.
        counts: number of answers, hidden families in rows and named families in columns.
        name: name of the diagnoser.
    """
    from matplotlib.patches import Rectangle

    totals = counts.sum(axis=1).to_numpy()
    shares = 100.0 * counts.to_numpy() / np.maximum(totals, 1)[:, None]
    axis.imshow(shares, cmap="Greys", vmin=0, vmax=100, aspect="auto")
    answer_labels = list(counts.columns)
    for row, family in enumerate(counts.index):
        for right_answer in _CORRECT_ANSWERS.get(family, (family,)):
            if right_answer in answer_labels:
                corner = answer_labels.index(right_answer) - 0.5, row - 0.5
                axis.add_patch(
                    Rectangle(corner, 1, 1, fill=False, edgecolor=style.NEUTRAL_MARK, linewidth=1.0)
                )
        for column, share in enumerate(shares[row]):
            if share >= _MIN_LABELLED_PERCENT:
                # White text on dark cells.
                ink = "white" if share > 55 else style.NEUTRAL_MARK
                axis.text(
                    column, row, f"{share:.0f}", ha="center", va="center", fontsize=5.5, color=ink
                )
    axis.set_title(name, fontsize=9)
    axis.set_xticks(range(len(answer_labels)), answer_labels, rotation=90, fontsize=6.5)
    labels = [f"{family} {n}" for family, n in zip(counts.index, totals, strict=True)]
    axis.set_yticks(range(len(labels)), labels, fontsize=6.5)
    axis.spines[:].set_visible(False)
    axis.tick_params(length=0)


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
    lines = render_text(
        _TEMPLATE,
        shown=report_data,
        shares={metric: index_by_diagnoser(tables["table"], metric) for metric in _SUMMARY_METRICS},
        columns=list(_SUMMARY_METRICS.values()),
        costs=index_by_diagnoser(tables["costs"]),
        unsupported=summarise_unsupported(left_out),
        undetectable_count=sum(not answer["item"] for answer in answers.values()),
        answers_file=ANSWERS_TABLE_FILE,
        report_path=folder / REPORT_FILE,
        failed=failed.to_dict("records"),
        max_failures=_MAX_LISTED_FAILURES,
    )
    for line in lines:
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
    figures = draw_chart_figures(data)
    if data.counts["clean_count"] and data.counts["single_count"]:
        singles = select_single_effects(data.rows)
        figures["outcomes"] = draw_outcomes(singles, data.order, data.title)
        figures["confusion"] = draw_confusion_matrices(data.rows, data.order, data.title)
    return {
        name: render_all_formats(add_trust_note(figure, data.experiment.trusted))
        for name, figure in figures.items()
    }
