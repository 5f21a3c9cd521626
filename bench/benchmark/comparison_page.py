"""Page of one comparison, report.html: its data, conclusion and limitations."""

from __future__ import annotations

import re
import shlex
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from bench.benchmark.best_tuner_summary import RangeResult, format_error_floor
from bench.benchmark.comparison_charts import CHARTS, ComparisonView
from bench.benchmark.comparison_figures import FIGURE_FILES, format_threshold_caption
from bench.benchmark.problem.fisher_information import STIFF_SIGMA_THRESHOLD
from bench.benchmark.statistics.training_amortisation import TARGETS_PER_TRAINING
from bench.benchmark.storage.run_status import FAILED_OR_SKIPPED_STATUSES, FAILED_STATUSES
from bench.figures.figure_output import FigureFiles
from bench.figures.style import TRUSTED_TUNERS_NOTE
from bench.pages.html_page import HtmlPage


@dataclass(frozen=True)
class ComparisonReportData:
    """A comparison, as shown on its page.

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


def explain_first(worse: Sequence[str]) -> list[str]:
    """Write out the first of several worse tuners, which explains the format of the others.

    ``cma_es 5.8x (8/10)`` becomes ``cma_es 5.8x the error (larger on 8 of 10 targets)``.

    Args:
        worse: texts of tuners that are significantly worse than the best one.
    """
    first = [
        re.sub(r" (\d\S*x) \((\d+)/(\d+)\)$", r" \1 the error (larger on \2 of \3 targets)", text)
        for text in worse[:1]
    ]
    return [*first, *worse[1:]]


def list_failures(view: ComparisonView) -> list[dict[str, Any]]:
    """List every kind of failure with its first reason, the most frequent one first.

    Runs that failed or were skipped are grouped by tuner, status and reason.
    """
    statuses = view.stored.statuses
    failed = statuses[statuses["status"].isin(FAILED_OR_SKIPPED_STATUSES)]
    groups = failed.groupby(["tuner", "status", "reason"], sort=False)["run"]
    counts = groups.agg(run_count="size", run="first").reset_index()
    counts = counts.sort_values("run_count", ascending=False, kind="stable")
    return [{str(key): value for key, value in row.items()} for row in counts.to_dict("records")]


def collect_text_values(results: ComparisonReportData) -> dict[str, Any]:
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


def list_mean_seconds(results: ComparisonReportData) -> list[tuple[str, dict[Hashable, Any]]]:
    """List the tuners, best first, each with the row of table.csv at the end of its budget."""
    table = results.tables["table"]
    last = table[table["runs"] > 0].sort_values("simulations").groupby("tuner", sort=False).last()
    order = [tuner for tuner in results.view.statistics.order if tuner in last.index]
    return list(zip(order, last.loc[order].to_dict("records"), strict=True))


_TEMPLATE = Path(__file__).with_name("comparison.html")
_DIGITS = 7
"""Number of significant digits of values that are in no file next to the page."""


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
        page.add_tables(chart.tables if chart else {}, _DIGITS)
    statuses = view.stored.statuses
    values = collect_text_values(results)
    # Rankings by range; `together` has those of all ranges after the same number of simulations.
    rankings = [result.rankings for result in values["range_results"]]
    return page.render(
        _TEMPLATE,
        **values,
        charts=charts,
        tuner_count=view.stored.runs["tuner"].nunique(),
        run_count=view.stored.runs["run"].nunique(),
        together=list(zip(*rankings, strict=True)) if all(rankings) else [],
        explain_first=explain_first,
        failed_count=int(statuses["status"].isin(FAILED_STATUSES).sum()),
        skipped_count=statuses[statuses["status"] == "skipped"]["tuner"].nunique(),
        failures=list_failures(view),
        mean_seconds=list_mean_seconds(results),
        last_simulations=str(int(results.tables["table"]["simulations"].max())),
        threshold_caption=format_threshold_caption(view.statistics.runtime_thresholds),
        stiff_threshold=f"{STIFF_SIGMA_THRESHOLD:g}",
        targets_per_training=TARGETS_PER_TRAINING,
        figure_files=FIGURE_FILES,
    )
