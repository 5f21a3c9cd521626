"""Page of one comparison, report.html: its data, conclusion and limitations."""

from __future__ import annotations

import re
import shlex
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from bench.benchmark import best_tuner_summary
from bench.benchmark.comparison_charts import CHARTS, ComparisonView
from bench.benchmark.comparison_figures import FIGURE_FILES, format_threshold_caption
from bench.benchmark.problem.fisher_information import STIFF_SIGMA_THRESHOLD
from bench.benchmark.statistics.training_amortisation import TARGETS_PER_TRAINING
from bench.benchmark.statistics.tuner_ranking import BEST, EQUAL, SIGNIFICANCE
from bench.benchmark.storage.run_status import FAILED_OR_SKIPPED_STATUSES, FAILED_STATUSES
from bench.figures.figure_output import FigureFiles
from bench.figures.style import TRUSTED_TUNERS_NOTE
from bench.pages.html_page import HtmlPage
from bench.pages.text_format import format_number, joined


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


SIGNIFICANCE_LEVEL = SIGNIFICANCE
"""Corrected p-value below which one tuner is called better than another."""


class RangeResult(NamedTuple):
    """Verdicts on the tuners in one range of targets.

    Attributes:
        where: The range in words, for the middle of a sentence.
        title: The range with its number of targets, for the beginning of a sentence.
        rankings: Verdicts after 1, 3, 10 and all simulations.
        has_failures: Whether a tuner failed in all of its runs.
        notes: Failed runs, and how the verdicts were decided.
    """

    where: str
    title: str
    rankings: list[best_tuner_summary.TunerRanking]
    has_failures: bool
    notes: list[str]


def list_range_results(view: ComparisonView) -> list[RangeResult]:
    """List the verdicts on the tuners by range of targets.

    Each result ranks the tuners after 1, 3, 10 and all simulations, with notes on failed runs and
    on how to read the ranking.

    Args:
        view: Comparison with its statistics.
    """
    results = []
    for kind in view.ranges:
        rankings = best_tuner_summary.rank_at_checkpoints(view.statistics, kind)
        notes = (
            best_tuner_summary.list_failed_runs(view.statistics, kind),
            best_tuner_summary.explain_ranking(view.statistics, kind),
        )
        results.append(
            RangeResult(
                best_tuner_summary.RANGE_PHRASES[kind],
                _format_title(view, kind),
                rankings,
                any(ranking.failed for ranking in rankings),
                [note for note in notes if note],
            )
        )
    return results


def _format_title(view: ComparisonView, kind: str) -> str:
    text = best_tuner_summary.RANGE_PHRASES[kind]
    count = best_tuner_summary.format_target_count(view.statistics, kind)
    return f"{text[0].upper()}{text[1:]} ({count})"


def write_conclusion(view: ComparisonView) -> list[str]:
    """List the tuners that are worse than the best after all simulations, by range."""
    return [_conclude_range(view, kind) for kind in view.ranges]


def _conclude_range(view: ComparisonView, kind: str) -> str:
    """Write one sentence with the verdicts on all tuners of a range after all simulations.

    Tuners that share the smallest error are not listed here.

    Args:
        view: comparison with its statistics, experiment and styles of tuners.
        kind: range of the targets.
    """
    rankings = best_tuner_summary.rank_at_checkpoints(view.statistics, kind)
    title = _format_title(view, kind)
    if not rankings:
        return f"{title}: the errors on the targets do not decide."
    last_ranking = rankings[-1]
    # The wording of the first one explains the format of the others.
    first = [
        re.sub(r" (\d\S*x) \((\d+)/(\d+)\)$", r" \1 the error (larger on \2 of \3 targets)", text)
        for text in last_ranking.worse[:1]
    ]
    parts = {
        "worse than the best": [*first, *last_ranking.worse[1:]],
        "not decided": last_ranking.undecided,
        "all runs failed": last_ranking.failed,
    }
    verdicts = "; ".join(f"{verdict}: {joined(names)}" for verdict, names in parts.items() if names)
    return (
        f"{title}, after {last_ranking.simulations} simulations: {verdicts or 'no tuner is worse'}."
    )


def write_running_times(results: ComparisonReportData) -> list[str]:
    """Describe how soon the best tuners of each range reach an error for good."""
    texts = ((kind, _format_running_times(results, kind)) for kind in results.view.ranges)
    return [f"{_format_title(results.view, kind)}: {text}" for kind, text in texts if text]


def _format_running_times(results: ComparisonReportData, kind: str) -> str:
    """Write a sentence with the expected running time (ERT) of the best tuners of a range.

    The ERT is the expected number of simulations until the error stays below the reference
    threshold (`reference_level`). The text is empty if none of the best tuners has reached the
    threshold.

    Args:
        results: the comparison.
        kind: range of the targets, such as ``in``.
    """
    view, table = results.view, results.tables["ert"]
    statistics, level = view.statistics, view.statistics.reference_level
    ranking = statistics.ranking[statistics.ranking["range"] == kind]
    final_rows = ranking[ranking["simulations"] == ranking["simulations"].max()]
    best = list(final_rows.loc[final_rows["verdict"].isin((BEST, EQUAL)), "tuner"])
    rows = table[
        (table["range"] == kind)
        & (table["threshold"] == level)
        & (table["successes"] > 0)
        & table["tuner"].isin(best)
    ]
    if rows.empty:
        return ""
    ordered = sorted(rows.to_dict("records"), key=lambda row: statistics.order.index(row["tuner"]))
    tuner_texts = ", ".join(_format_running_time(view, row) for row in ordered)
    unit = view.unit_of_levels or f" in {view.format_metric_label(statistics.metric)}"
    return (
        "expected simulations of the best tuners until the error stays at or below "
        f"{format_number(level)}{unit.replace('[', '').replace(']', '')}: {tuner_texts}."
    )


def _format_running_time(view: ComparisonView, row: Mapping[Any, Any]) -> str:
    """Format the expected running time (ERT) of one tuner.

    The text has its 95 % interval, the successful runs and the simulations of a training. An
    interval without an upper limit ends with ∞.

    Args:
        view: the comparison, with the costs of trainings.
        row: row of the table of ERT.
    """
    high = format_number(row["high"]) if np.isfinite(row["high"]) else "∞"
    interval = f"95 % {format_number(row['low'])} to {high}"
    simulations, _ = view.stored.costs.get(str(row["tuner"]), (0.0, 0.0))
    training = f"; training {format_number(simulations, 6)}" if simulations else ""
    successes = f"{int(row['successes'])} of {int(row['runs'])} runs"
    return f"{row['tuner']} {format_number(row['ert'])} ({interval}; {successes}{training})"


class FailureCounts(NamedTuple):
    """Number of failed runs, of all runs, and of tuners that could not be used."""

    failed: int
    runs: int
    skipped: int


def count_failures(view: ComparisonView) -> FailureCounts:
    """Count the runs that failed and the tuners that were skipped."""
    statuses = view.stored.statuses
    return FailureCounts(
        int(statuses["status"].isin(FAILED_STATUSES).sum()),
        len(statuses),
        int(statuses[statuses["status"] == "skipped"]["tuner"].nunique()),
    )


class Failure(NamedTuple):
    """Kind of failure: its tuner, status, number of runs, a run and the reason of that run."""

    tuner: str
    status: str
    run_count: int
    run: str
    reason: str

    @property
    def last_line(self) -> str:
        """Last line of the reason."""
        return (self.reason.strip().splitlines() or ["no reason was given"])[-1]


def list_failures(view: ComparisonView) -> list[Failure]:
    """List every kind of failure with its first reason, the most frequent one first.

    Runs that failed or were skipped are grouped by tuner, status and reason.
    """
    statuses = view.stored.statuses
    failed = statuses[statuses["status"].isin(FAILED_OR_SKIPPED_STATUSES)]
    failures = [
        Failure(str(tuner), str(status), len(group), str(group["run"].iloc[0]), str(reason))
        for (tuner, status, reason), group in failed.groupby(
            ["tuner", "status", "reason"], sort=False
        )
    ]
    return sorted(failures, key=lambda failure: -failure.run_count)


def list_small_samples(view: ComparisonView) -> list[str]:
    """List warnings about ranges with too few targets for a significant difference."""
    texts = (
        best_tuner_summary.warn_about_target_count(view.statistics, kind) for kind in view.ranges
    )
    return list(dict.fromkeys(text for text in texts if text))


def format_redraws(results: ComparisonReportData) -> str:
    """Describe how many targets were drawn again; empty for none.

    A target is drawn again if its own simulation diverges, because it then has no observations.

    Args:
        results: Comparison with the record of its environment.
    """
    redrawn_count, draws = (
        results.environment.get(key, 0) for key in ("redrawn_targets", "target_draws")
    )
    targets = sum(results.view.statistics.target_counts.values())
    if not redrawn_count:
        return ""
    return (
        f"{redrawn_count} of {targets} targets were drawn again because their own simulation "
        f"diverged ({draws} draws in all)."
    )


def write_provenance_notes(results: ComparisonReportData) -> Iterator[str]:
    """Yield notes on isolation, salt and targets that limit how far the results can be trusted.

    Args:
        results: Comparison with its configuration and the record of its environment.
    """
    experiment = results.view.experiment
    if experiment.trusted:
        yield f"{TRUSTED_TUNERS_NOTE.capitalize()}."
    if not experiment.salt_sha256:
        yield "The targets have a public salt, so anyone can draw them."
    if redraw_note := format_redraws(results):
        yield redraw_note


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
    charts = {
        name: make_chart(view) if name in results.pictures or name == "ert" else None
        for name, make_chart in CHARTS.items()
    }
    for chart in charts.values():
        page.add_tables(chart.tables if chart else {}, _DIGITS)
    range_results = list_range_results(view)
    rankings = [result.rankings for result in range_results]
    equal_errors = best_tuner_summary.format_error_floor(view.statistics)
    return page.render(
        _TEMPLATE,
        results=results,
        view=view,
        charts=charts,
        tuner_count=view.stored.runs["tuner"].nunique(),
        run_count=view.stored.runs["run"].nunique(),
        equal_errors=equal_errors.capitalize(),
        floor_text=equal_errors,
        range_results=range_results,
        together=list(zip(*rankings, strict=True)) if all(rankings) else [],
        best_headings=[f"best (median error), {result.where}" for result in range_results],
        conclusion=write_conclusion(view),
        small_samples=list_small_samples(view),
        failure_counts=count_failures(view),
        failures=list_failures(view),
        provenance_notes=list(write_provenance_notes(results)),
        running_times=write_running_times(results),
        mean_seconds=list_mean_seconds(results),
        shown_label=view.format_metric_label(view.shown_metric),
        last_simulations=str(int(results.tables["table"]["simulations"].max())),
        threshold_caption=format_threshold_caption(view.statistics.runtime_thresholds),
        stiff_threshold=f"{STIFF_SIGMA_THRESHOLD:g}",
        targets_per_training=TARGETS_PER_TRAINING,
        figure_files=FIGURE_FILES,
        joined=joined,
    )
