"""Write the tables, figures and report page of a comparison, and print a summary."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Mapping
from pathlib import Path

import pandas as pd

from bench.benchmark import best_tuner_summary, comparison_figures
from bench.benchmark.comparison_charts import ComparisonView, make_axis_labels
from bench.benchmark.comparison_page import (
    ComparisonReportData,
    format_redraws,
    list_mean_seconds,
    render_page,
)
from bench.benchmark.isolation.isolation_layers import ISOLATION_NOTE, without_isolation
from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.problem.tuning_problem import numeric_warnings_silenced
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics, build_tables
from bench.benchmark.statistics.error_curves import build_summary
from bench.benchmark.storage.result_folder import (
    CONFIGURATION_FILE,
    StoredComparison,
    read_comparison,
    read_environment,
)
from bench.benchmark.storage.run_journal import SEGMENTS_FOLDER, read_plan
from bench.benchmark.storage.run_status import FAILED_OR_SKIPPED_STATUSES
from bench.figures.figure_output import FigureFiles, render_all_formats, write_figure_files
from bench.figures.style import TRUSTED_TUNERS_NOTE
from sims.core.files import write_atomically

REQUIRED_RUN_COLUMNS = (
    "run",
    "experiment",
    "tuner",
    "target",
    "seed",
    "range",
    "k",
    "param_error",
    "param_abs_error",
    "stiff_error",
    "sloppy_error",
    "obs_error",
    "heldout_error",
    "outside",
    "tuner_seconds",
    "simulator_seconds",
)
"""Columns of the runs that tables and figures use."""
REPORT_FILE = "report.html"
"""File name of the report page in the folder of a comparison."""
_LINE_WIDTH = 120
"""Width of a line on the terminal in characters."""
_PRINTED_CHECKPOINTS = (3, 10)
"""Numbers of simulations for printed errors along directions, in addition to the budget."""


@numeric_warnings_silenced()
def write_report(folder: Path, print_line: Callable[[str], None]) -> int:
    """Write tables, figures and the report page of a comparison, and print a summary.

    The summary has the best tuners, their median errors, limitations of the comparison, failures
    and running times.

    Returns:
        Number of failed runs.

    Raises:
        InputError: the folder is not that of a comparison, or cannot be written to.
    """
    stored = read_comparison(folder, REQUIRED_RUN_COLUMNS)
    if stored.runs.empty:
        print_line(f"no run was made; {folder}/status.csv has the reasons")
        return 0
    view = ComparisonView(stored, make_axis_labels(stored.experiment), ComparisonStatistics(stored))
    tables = build_tables(stored, view.statistics)
    for name, frame in tables.items():
        write_atomically(folder / f"{name}.csv", frame.to_csv(index=False))
    pictures = _render_figures(view)
    figures = _write_figures(folder, pictures)
    results = ComparisonReportData(
        view,
        tables,
        pictures,
        read_environment(folder),
        str(folder),
        (folder / CONFIGURATION_FILE).read_text(encoding="utf-8"),
        _count_missing_runs(folder, stored),
    )
    write_atomically(folder / REPORT_FILE, render_page(results))

    lines = tables["table"]
    for text in (
        *_describe_best_tuners(view),
        *_format_median_errors(lines, view),
        *_list_limitations(stored.experiment),
    ):
        print_line(text)
    if redraw_note := format_redraws(results):
        print_line(f"\n{redraw_note}")
    failed = stored.statuses[stored.statuses["status"].isin(FAILED_OR_SKIPPED_STATUSES)]
    for text in format_failures(failed):
        print_line(text)
    print_line("\n" + _format_run_seconds(results))
    print_line(f"\ntable   {folder / 'table.csv'}")
    print_line(f"more    {folder}/{', '.join(f'{name}.csv' for name in tables if name != 'table')}")
    for figure in figures:
        print_line(f"figure  {figure}")
    print_line(f"report  {folder / REPORT_FILE}")
    # A tuner that cannot be used here does not count as a failure of the comparison.
    return int((failed["status"] != "skipped").sum())


def _render_figures(view: ComparisonView) -> dict[str, FigureFiles]:
    """Render all figures that exist for the comparison, by name."""
    return {
        name: render_all_formats(
            comparison_figures.draw_figure(view.stored, view.labels, name, view.statistics)
        )
        for name in comparison_figures.list_figure_names(view.stored)
    }


def _write_figures(folder: Path, pictures: Mapping[str, FigureFiles]) -> list[Path]:
    """Write the figures to the folder ``figures``; return the paths of the PNG files.

    Args:
        folder: result folder.
        pictures: rendered figures by name.
    """
    return [
        write_figure_files(
            folder / "figures" / comparison_figures.FIGURE_FILES[name], picture.png, picture.pdf
        )[0]
        for name, picture in pictures.items()
    ]


def _count_missing_runs(folder: Path, stored: StoredComparison) -> int:
    """Return the number of planned runs that are missing.

    Args:
        folder: result folder, which contains the plan while runs are missing.
        stored: comparison read from its result folder: configuration, runs and statuses.
    """
    plan = read_plan(folder) if (folder / SEGMENTS_FOLDER).exists() else None
    return max(len(plan) - int(stored.runs["run"].nunique()), 0) if plan else 0


def _list_limitations(experiment: Experiment) -> list[str]:
    """Return notes on how the runs were made that limit the value of the results."""
    texts = []
    if experiment.trusted:
        texts.append(f"\n{TRUSTED_TUNERS_NOTE}")
    if not experiment.salt_sha256:
        texts.append("\nthe targets have a public salt, so anyone can draw them")
    return texts


def _describe_best_tuners(view: ComparisonView) -> list[str]:
    """Describe the best tuners after 1, 3, 10 and all simulations, one paragraph per range.

    A range is where targets are drawn from: the training range, or anywhere within the bounds.

    Args:
        view: Comparison with its statistics.

    Returns:
        Paragraphs of several lines, for the terminal.
    """
    statistics, texts = view.statistics, []
    label = view.format_metric_label(view.shown_metric)
    for kind in view.ranges:
        range_text = (
            f"{best_tuner_summary.RANGE_PHRASES[kind]}, "
            f"{best_tuner_summary.format_target_count(statistics, kind)}"
        )
        lines = [
            f"\nbest tuners, {range_text} "
            f"({label}; {best_tuner_summary.format_error_floor(statistics)})"
        ]
        for ranking in best_tuner_summary.rank_at_checkpoints(statistics, kind):
            lines += _format_ranking(ranking)
        lines += [best_tuner_summary.list_failed_runs(statistics, kind)]
        lines += [
            best_tuner_summary.warn_about_target_count(statistics, kind)
            or best_tuner_summary.explain_ranking(statistics, kind)
        ]
        texts.append("\n".join(line for line in lines if line))
    return texts


def _format_ranking(ranking: best_tuner_summary.TunerRanking) -> list[str]:
    """Format the lines of one number of simulations; verdicts without tuners are left out.

    Args:
        ranking: Verdicts on all tuners after one number of simulations.

    Returns:
        Lines for best, worse, undecided and failed tuners; the first one begins with the number of
        simulations.
    """
    best = (
        f"{', '.join(ranking.best)} ({ranking.error})" if ranking.best else "none: every run failed"
    )
    names_by_verdict = {
        "best": best,
        "worse": ", ".join(ranking.worse),
        "not decided": ", ".join(ranking.undecided),
        "all runs failed": ", ".join(ranking.failed),
    }
    lines = [
        textwrap.fill(
            f"{verdict}: {names}", _LINE_WIDTH, initial_indent=" " * 12, subsequent_indent=" " * 14
        )
        for verdict, names in names_by_verdict.items()
        if names
    ]
    lines[0] = f"  after {ranking.simulations}".ljust(12) + lines[0].lstrip()
    return lines


def _format_median_errors(lines: pd.DataFrame, view: ComparisonView) -> list[str]:
    """Format the median errors of each range, then the errors along directions where known.

    Args:
        lines: error curves: one row for each tuner, range, metric and number of simulations.
        view: the comparison.
    """
    texts = []
    for kind in lines["range"][lines["range"] != ""].unique():
        texts.append("\n" + _format_error_table(lines, kind, view))
        if direction_table := _format_direction_errors(lines, kind, view):
            texts.append("\n" + direction_table)
    return texts


def _format_error_table(lines: pd.DataFrame, kind: str, view: ComparisonView) -> str:
    """Format the median errors of one range as a table for the terminal.

    Args:
        lines: error curves: one row for each tuner, range, metric and number of simulations.
        kind: range of the targets, such as ``in``; ``real`` for a recording.
        view: the comparison.
    """
    labels, statistics = view.labels, view.statistics
    metrics = set(lines["metric"])
    if kind == "real":
        held_out = "heldout_error" in metrics
        metric, error_kind = ("heldout_error", "held-out") if held_out else ("obs_error", "fitted")
        title = f"median {error_kind} RMSE of {labels.channel} after N simulations"
    else:
        metric = "param_abs_error" if "param_abs_error" in metrics else "param_error"
        error_kind = labels.parameter or "the parameters [training widths]"
        range_text = "in the training range" if kind == "in" else "anywhere in the bounds"
        title = f"median absolute error of {error_kind} after N simulations, targets {range_text}"
    medians = build_summary(lines, metric, kind, statistics.order_in(kind))
    training_simulations = lines.drop_duplicates("tuner").set_index("tuner")["fit_simulations"]
    medians["trained on"] = [
        f"{training_simulations[t]:.0f}" if training_simulations[t] else "-" for t in medians.index
    ]
    return f"{title}\n{_format_frame(medians.rename(index=statistics.format_label))}"


def _format_frame(frame: pd.DataFrame) -> str:
    """Format numbers with two digits, without names of rows and columns."""
    unnamed_frame = frame.rename_axis(index=None, columns=None)
    return unnamed_frame.to_string(float_format=lambda value: f"{value:.2g}")


def _format_direction_errors(lines: pd.DataFrame, kind: str, view: ComparisonView) -> str:
    """Format errors along stiff and sloppy directions, and held-out errors, of one range.

    The text is empty if there are none.

    Args:
        lines: error curves: one row for each tuner, range, metric and number of simulations.
        kind: range of the targets; ``real`` for a recording.
        view: the comparison.
    """
    statistics = view.statistics
    titles = {"stiff_error": "stiff", "sloppy_error": "sloppy", "heldout_error": "unseen"}
    shown_lines = lines[(lines["range"] == kind) & lines["metric"].isin(titles)]
    if kind == "real" or shown_lines.empty:
        return ""
    budget = shown_lines["simulations"].max()
    shown_counts = [k for k in (*_PRINTED_CHECKPOINTS, budget) if k <= budget]
    shown_lines = shown_lines[shown_lines["simulations"].isin(shown_counts)]
    shown_lines = shown_lines.assign(
        column=shown_lines["metric"].map(titles) + " " + shown_lines["simulations"].astype(str)
    )
    order = [
        f"{t} {k}" for t in titles.values() for k in sorted(shown_lines["simulations"].unique())
    ]
    medians = shown_lines.pivot(index="tuner", columns="column", values="median")
    medians = medians[[c for c in order if c in medians]].dropna(axis=1, how="all")
    medians = medians.reindex([t for t in statistics.order_in(kind) if t in medians.index])
    title = "median error along stiff and sloppy directions [training widths]"
    if "heldout_error" in set(shown_lines["metric"]):
        title += f" and RMSE of {view.labels.channel} in unseen scenarios"
    table = _format_frame(medians.rename(index=statistics.format_label))
    return f"{title}, after N simulations\n{table}"


def _format_run_seconds(results: ComparisonReportData) -> str:
    """Format the mean seconds per run of each tuner, of its simulations, and of its training."""
    columns = {
        "tuner_seconds": "tuner",
        "simulator_seconds": "simulator",
        "fit_seconds": "one training",
    }
    rows = dict(list_mean_seconds(results))
    seconds = pd.DataFrame.from_dict(rows, orient="index")[list(columns)].rename(columns=columns)
    return f"mean seconds of a run\n{_format_frame(seconds)}"


def format_failures(failed: pd.DataFrame) -> list[str]:
    """Format failures as lines, one for each tuner and status.

    Each line has the error of the first reason, and where it was raised.

    Args:
        failed: Rows of the failed runs, with tuner, status and reason.
    """
    lines = [
        (
            str(tuner),
            str(len(group)),
            str(status),
            format_failure_reason(str(group["reason"].iloc[0])),
        )
        for (tuner, status), group in failed.groupby(["tuner", "status"], sort=False)
    ]
    if not lines:
        return []
    lines.insert(0, ("tuner", "runs", "status", "first reason"))
    a, b, c = (max(len(line[i]) for line in lines) for i in range(3))
    laid_out = [
        f"{tuner:{a}}  {runs:>{b}}  {status:{c}}  {reason}".rstrip()
        for tuner, runs, status, reason in lines
    ]
    refused = [reason.endswith(ISOLATION_NOTE) for reason in failed["reason"].astype(str)]
    isolated_tuners = list(dict.fromkeys(failed["tuner"][refused].astype(str)))
    note = [f"{', '.join(isolated_tuners)}: {ISOLATION_NOTE}"] if isolated_tuners else []
    return ["", "failures", *laid_out, *note]


_TRACEBACK_FRAME = re.compile(r'File "(?P<file>[^"]+)", line (?P<line>\d+), in (?P<function>\S+)')


def format_failure_reason(reason: str) -> str:
    """Return error and location from a reason, which may be a traceback."""
    lines = without_isolation(reason.strip()).splitlines() or [""]
    frames = [i for i, line in enumerate(lines) if _TRACEBACK_FRAME.search(line)]
    if not frames:
        return lines[-1].strip()
    # The error message is the first line without indentation after the last frame; it may be
    # followed by pages of text.
    message = next((line for line in lines[frames[-1] + 1 :] if line[:1].strip()), lines[-1])
    file, number, function = _TRACEBACK_FRAME.findall(lines[frames[-1]])[0]
    return f"{message} ({Path(file).name}, line {number}, in {function})"
