"""Write the tables, figures and report page of a comparison, and print a summary.

The page, report.html, has the data, the conclusion and the limitations of the comparison.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from bench.benchmark.best_tuner_summary import RangeResult, explain_first, format_error_floor
from bench.benchmark.comparison_charts import CHARTS, ComparisonView, make_axis_labels
from bench.benchmark.comparison_printed_figures import (
    FIGURE_FILES,
    draw_figure,
    format_threshold_caption,
    list_figure_names,
)
from bench.benchmark.isolation.process_errors import (
    ISOLATION_NOTE,
    format_failure_reason,
)
from bench.benchmark.problem.fisher_information import STIFF_SIGMA_THRESHOLD
from bench.benchmark.problem.tuning_problem import numeric_warnings_silenced
from bench.benchmark.statistics.comparison_statistics import (
    REQUIRED_RUN_COLUMNS,
    ComparisonStatistics,
    build_tables,
)
from bench.benchmark.statistics.error_curves import build_summary
from bench.benchmark.statistics.training_amortisation import TARGETS_PER_TRAINING
from bench.benchmark.storage.result_folder import (
    CONFIGURATION_FILE,
    StoredComparison,
    read_comparison,
    read_environment,
)
from bench.benchmark.storage.run_journal import SEGMENTS_FOLDER, read_plan
from bench.benchmark.storage.run_status import FAILED_OR_SKIPPED_STATUSES, FAILED_STATUSES
from bench.figures.figure_layout import TRUSTED_TUNERS_NOTE
from bench.figures.figure_output import FigureFiles, render_all_formats, write_figures
from bench.pages.html_page import HtmlPage
from bench.pages.template import render_text
from sims.core.files import write_atomically

REPORT_FILE = "report.html"
"""File name of the report page in the folder of a comparison."""
_PAGE_TEMPLATE = Path(__file__).with_name("comparison.html")
"""Template of the report page."""
_SUMMARY_TEMPLATE = Path(__file__).with_name("comparison.txt")
"""Template of the printed summary."""
_PAGE_DIGITS = 7
"""Number of significant digits of values on the page that are in no file next to it."""
_PRINTED_CHECKPOINTS = (3, 10)
"""Numbers of simulations for printed errors along directions, in addition to the budget."""


@dataclass(frozen=True)
class ComparisonReportData:
    """A comparison, as shown on its page and in the printed summary.

    Attributes:
        view: The comparison with its statistics, labels and styles.
        tables: Tables by name, as written next to the page.
        pictures: Printed figures by name.
        environment: Content of environment.json.
        folder: Its folder, as named by the user.
        configuration: Text of experiment.toml.
        missing: Number of planned runs that have not been made yet.
    """

    view: ComparisonView
    tables: Mapping[str, pd.DataFrame]
    pictures: Mapping[str, FigureFiles]
    environment: Mapping[str, Any]
    folder: str
    configuration: str
    missing: int = 0

    def format_rerun_command(self) -> str:
        """Return the command that repeats the comparison."""
        words = ["simgap", "compare", f"{self.folder}/experiment.toml"]
        for plugin in self.environment.get("plugins", ()):
            words += ["--plugin", plugin]
        return shlex.join(words)


@numeric_warnings_silenced()
def write_report(folder: Path, print_line: Callable[[str], None]) -> int:
    """Write tables, figures and the report page of a comparison, and print a summary.

    The summary has the best tuners, their median errors, limitations of the comparison, failures
    and running times.

    Args:
        folder: folder of the comparison, to which the files are written.
        print_line: callback that prints one line of the summary.

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
    files = {FIGURE_FILES[name]: pictures[name] for name in pictures}
    figures = [path for path in write_figures(folder, files) if path.suffix == ".png"]
    results = ComparisonReportData(
        view=view,
        tables=tables,
        pictures=pictures,
        environment=read_environment(folder),
        folder=str(folder),
        configuration=(folder / CONFIGURATION_FILE).read_text(encoding="utf-8"),
        missing=_count_missing_runs(folder, stored),
    )
    write_atomically(folder / REPORT_FILE, render_page(results))

    failed = stored.statuses[stored.statuses["status"].isin(FAILED_OR_SKIPPED_STATUSES)]
    lines = render_text(
        _SUMMARY_TEMPLATE,
        **_collect_text_values(results),
        error_tables=list(_list_error_tables(tables["table"], view)),
        failures=format_failures(failed),
        seconds=_build_run_seconds(results),
        figures=figures,
        table_files=[f"{name}.csv" for name in tables if name != "table"],
        report_file=REPORT_FILE,
    )
    for line in lines:
        print_line(line)
    # A tuner that cannot be used here does not count as a failure of the comparison.
    return int((failed["status"] != "skipped").sum())


def _render_figures(view: ComparisonView) -> dict[str, FigureFiles]:
    """Render all figures that exist for the comparison, by name."""
    return {
        name: render_all_formats(draw_figure(view.stored, view.labels, name, view.statistics))
        for name in list_figure_names(view.stored)
    }


def _count_missing_runs(folder: Path, stored: StoredComparison) -> int:
    """Return the number of planned runs that are missing.

    Args:
        folder: result folder, which contains the plan while runs are missing.
        stored: comparison read from its result folder: configuration, runs and statuses.
    """
    plan = read_plan(folder) if (folder / SEGMENTS_FOLDER).exists() else None
    return max(len(plan) - int(stored.runs["run"].nunique()), 0) if plan else 0


def _collect_text_values(results: ComparisonReportData) -> dict[str, Any]:
    """Collect the values of both templates, that of the page and that of the printed summary.

    Args:
        results: Comparison with its statistics and tables.

    Returns:
        Values by their names in the templates.
    """
    view = results.view
    return {
        "results": results,
        "view": view,
        "range_results": [RangeResult(view.statistics, kind) for kind in view.ranges],
        "floor_text": format_error_floor(view.statistics),
        "shown_label": view.format_metric_label(view.shown_metric),
        "trust_note": TRUSTED_TUNERS_NOTE if view.experiment.trusted else "",
        "target_count": sum(view.statistics.target_counts.values()),
    }


def render_page(results: ComparisonReportData) -> str:
    """Render the HTML page of a comparison of tuners.

    Tables and chart data are written into the page, from which its script draws the charts.

    Args:
        results: Comparison with its view, tables and the pictures that exist.

    Returns:
        The page, which needs no other file.
    """
    view = results.view
    page = HtmlPage({FIGURE_FILES[name]: files for name, files in results.pictures.items()})
    page.add_tables(results.tables)
    # Every chart has a printed figure if it has data, except for that of running times (ERT).
    charts = {
        name: make_chart(view) if name in results.pictures or name == "ert" else None
        for name, make_chart in CHARTS.items()
    }
    for chart in charts.values():
        page.add_tables(chart.tables if chart else {}, _PAGE_DIGITS)
    statuses = view.stored.statuses
    values = _collect_text_values(results)
    # A list for each range, with its rankings after 1, 3, 10 and all simulations. `together` has
    # one element for each of these numbers: the rankings of all ranges after it.
    rankings = [result.rankings for result in values["range_results"]]
    return page.render(
        _PAGE_TEMPLATE,
        **values,
        charts=charts,
        tuner_count=view.stored.runs["tuner"].nunique(),
        run_count=view.stored.runs["run"].nunique(),
        together=list(zip(*rankings, strict=True)) if all(rankings) else [],
        explain_first=explain_first,
        failed_count=int(statuses["status"].isin(FAILED_STATUSES).sum()),
        skipped_count=statuses[statuses["status"] == "skipped"]["tuner"].nunique(),
        failures=_list_failures(view),
        mean_seconds=_list_mean_seconds(results),
        last_simulations=str(int(results.tables["table"]["simulations"].max())),
        threshold_caption=format_threshold_caption(view.statistics.runtime_thresholds),
        stiff_threshold=f"{STIFF_SIGMA_THRESHOLD:g}",
        targets_per_training=TARGETS_PER_TRAINING,
        figure_files=FIGURE_FILES,
    )


def _list_failures(view: ComparisonView) -> list[dict[str, Any]]:
    """List every kind of failure with its first reason, the most frequent one first.

    Runs that failed or were skipped are grouped by tuner, status and reason.
    """
    statuses = view.stored.statuses
    failed = statuses[statuses["status"].isin(FAILED_OR_SKIPPED_STATUSES)]
    groups = failed.groupby(["tuner", "status", "reason"], sort=False)["run"]
    counts = groups.agg(run_count="size", run="first").reset_index()
    counts = counts.sort_values("run_count", ascending=False, kind="stable")
    return [{str(key): value for key, value in row.items()} for row in counts.to_dict("records")]


def _list_mean_seconds(results: ComparisonReportData) -> list[tuple[str, dict[Hashable, Any]]]:
    """List the tuners, best first, each with the row of table.csv at the end of its budget."""
    table = results.tables["table"]
    last = table[table["runs"] > 0].sort_values("simulations").groupby("tuner", sort=False).last()
    order = [tuner for tuner in results.view.statistics.order if tuner in last.index]
    return list(zip(order, last.loc[order].to_dict("records"), strict=True))


def _build_run_seconds(results: ComparisonReportData) -> pd.DataFrame:
    """Build the table of mean seconds per run: tuner, simulations and training."""
    columns = {
        "tuner_seconds": "tuner",
        "simulator_seconds": "simulator",
        "fit_seconds": "one training",
    }
    rows = dict(_list_mean_seconds(results))
    return pd.DataFrame.from_dict(rows, orient="index")[list(columns)].rename(columns=columns)


def _list_error_tables(
    lines: pd.DataFrame, view: ComparisonView
) -> Iterator[tuple[str, str, pd.DataFrame, pd.DataFrame | None, bool]]:
    """Yield the median errors of each range as tables for the terminal.

    Args:
        lines: error curves: one row for each tuner, range, metric and number of simulations.
        view: the comparison.

    Yields:
        Range; name of the metric; its median errors, one row per tuner, best first, and one column
        per number of simulations; the table of `_build_direction_errors`, None if there is none;
        and whether that table has errors in unseen scenarios.
    """
    metrics, statistics = set(lines["metric"]), view.statistics
    # The row of a skipped tuner has no range.
    for kind in lines["range"][lines["range"] != ""].unique():
        # The true parameters of a recording are unknown, so its table has errors of channels. A
        # single parameter has an absolute error, several have `param_error` only.
        preferred = ("heldout_error", "obs_error") if kind == "real" else ("param_abs_error",)
        metric = next((name for name in preferred if name in metrics), "param_error")
        medians = build_summary(lines, metric, kind, statistics.order_in(kind))
        # Number of simulations of a training, 0 for a tuner that is not trained.
        training = lines.drop_duplicates("tuner").set_index("tuner")["fit_simulations"]
        medians["trained on"] = [
            f"{training[tuner]:.0f}" if training[tuner] else "-" for tuner in medians.index
        ]
        table = medians.rename(index=statistics.format_label)
        direction_table, has_heldout_errors = _build_direction_errors(lines, kind, view)
        yield kind, metric, table, direction_table, has_heldout_errors


def _build_direction_errors(
    lines: pd.DataFrame, kind: str, view: ComparisonView
) -> tuple[pd.DataFrame | None, bool]:
    """Build the table of median errors along directions, and of held-out errors, of one range.

    A column is a kind of error after some number of simulations, such as ``stiff 10``: the error
    along directions of the parameter space that the data determine (stiff), along those that they
    do not (sloppy), or in unseen scenarios.

    Args:
        lines: error curves: one row for each tuner, range, metric and number of simulations.
        kind: range of the targets; ``real`` for a recording.
        view: the comparison.

    Returns:
        The table, one row per tuner, the best first, None without such errors or for a recording;
        and whether it has held-out errors.
    """
    statistics = view.statistics
    titles = {"stiff_error": "stiff", "sloppy_error": "sloppy", "heldout_error": "unseen"}
    shown_lines = lines[(lines["range"] == kind) & lines["metric"].isin(titles)]
    if kind == "real" or shown_lines.empty:
        return None, False
    budget = shown_lines["simulations"].max()
    shown_counts = [k for k in (*_PRINTED_CHECKPOINTS, budget) if k <= budget]
    shown_lines = shown_lines[shown_lines["simulations"].isin(shown_counts)]
    shown_lines = shown_lines.assign(
        column=shown_lines["metric"].map(titles) + " " + shown_lines["simulations"].astype(str)
    )
    column_order = [
        f"{title} {k}"
        for title in titles.values()
        for k in sorted(shown_lines["simulations"].unique())
    ]
    medians = shown_lines.pivot(index="tuner", columns="column", values="median")
    medians = medians[[c for c in column_order if c in medians]].dropna(axis=1, how="all")
    medians = medians.reindex([t for t in statistics.order_in(kind) if t in medians.index])
    table = medians.rename(index=statistics.format_label)
    return table, "heldout_error" in set(shown_lines["metric"])


def format_failures(failed: pd.DataFrame) -> list[str]:
    """Format failures as lines, one for each tuner and status.

    Each line has the error of the first reason, and where it was raised.

    Args:
        failed: Rows of the failed runs, with tuner, status and reason.

    Returns:
        An empty line, a heading, the aligned lines, and a note on isolation if it may be the cause;
        no lines without failures.
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
    tuner_width, runs_width, status_width = (max(len(line[i]) for line in lines) for i in range(3))
    laid_out = [
        f"{tuner:{tuner_width}}  {runs:>{runs_width}}  {status:{status_width}}  {reason}".rstrip()
        for tuner, runs, status, reason in lines
    ]
    # The isolation may have caused these failures; its note is written once for all of them.
    is_refused = [reason.endswith(ISOLATION_NOTE) for reason in failed["reason"].astype(str)]
    isolated_tuners = list(dict.fromkeys(failed["tuner"][is_refused].astype(str)))
    note = [f"{', '.join(isolated_tuners)}: {ISOLATION_NOTE}"] if isolated_tuners else []
    return ["", "failures", *laid_out, *note]
