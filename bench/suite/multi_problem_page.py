"""Page over several comparisons (report.html of `simgap plot A B --out DIR`)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from bench.benchmark.comparison_page import SIGNIFICANCE_LEVEL
from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics
from bench.benchmark.statistics.error_curves import select_checkpoints
from bench.figures.figure_output import FigureFiles
from bench.figures.style import PANEL_TITLES, MarkStyle, get_mark_style
from bench.pages.chart import Axis, Panel, PrintedFigure, Series
from bench.pages.html_page import HtmlPage
from sims.core.simulator import Array

_TEMPLATE = Path(__file__).with_name("multi_problem.html")
_DIGITS = 7
"""Number of significant digits of values that are in no file next to the page."""
_METRIC_LABELS = {
    "param_error": "mean parameter error [training widths], median",
    "stiff_error": "error along stiff directions [training widths], median",
    "heldout_error": "RMSE on held-out runs, median",
    "obs_error": "RMSE on the runs tuned on, median",
}
TunerMarkStyles = Sequence[tuple[str, MarkStyle]]
"""Tuners in the order of the legend, each with its style."""


@dataclass(frozen=True)
class MultiProblemPageData:
    """Several comparisons, as shown on their page.

    Attributes:
        parts: Experiment and statistics of each comparison.
        tuners: Tuners that all comparisons have.
        ranked: Ranks, one row per problem, one column per tuner; 1 is best.
        p_values: P-values of Nemenyi's test of each pair of tuners; None without enough problems.
        friedman: P-value of Friedman's test; NaN without enough problems.
        shares: By tuner, the share reached after 0, 1, 2, ... hundredths of each problem's budget.
        tables: Tables by name, as written next to the page.
        pictures: Printed figures by name.
        folders: Folders of the comparisons.
        out: Folder of the page.
    """

    parts: Sequence[tuple[Experiment, ComparisonStatistics]]
    tuners: Sequence[str]
    ranked: pd.DataFrame
    p_values: pd.DataFrame | None
    friedman: float
    shares: Mapping[str, Array]
    tables: Mapping[str, pd.DataFrame]
    pictures: Mapping[str, FigureFiles]
    folders: list[str]
    out: str

    def get_tuner_styles(self) -> list[tuple[str, MarkStyle]]:
        """Return the tuners, best mean rank first, each with its style."""
        order = self.ranked.mean().sort_values(kind="stable").index
        places = {name: place for place, name in enumerate(self.tuners)}
        return [(str(name), get_mark_style(places[str(name)])) for name in order]

    def make_static_figure(self, name: str, description: str) -> PrintedFigure | None:
        """Return the printed version of a figure; None if it was not drawn.

        Args:
            name: Name of the figure.
            description: Text description for readers who cannot see it.
        """
        return PrintedFigure.from_files(self.pictures, name, description)


def render_multi_problem_page(several: MultiProblemPageData) -> str:
    """Render the page as HTML."""
    page, styles = HtmlPage(), several.get_tuner_styles()
    for name in ("ranks", "ert", "pairs"):
        if len(several.tables[name]):
            page.add_table(name, several.tables[name])
    runtime_panel, shares = make_runtime_panel(styles, several.shares)
    page.add_table(runtime_panel.table, shares, _DIGITS)
    error_panels, errors = _make_error_panels(several)
    page.add_table("errors", errors, _DIGITS)
    mean_ranks = several.ranked.mean().sort_values(kind="stable")
    best = str(mean_ranks.index[0])
    significantly_worse: list[str] = []
    undecided_tuners: list[str] = []
    if several.p_values is not None:
        for tuner, p_value in several.p_values[best].drop(best).items():
            (significantly_worse if p_value < SIGNIFICANCE_LEVEL else undecided_tuners).append(
                str(tuner)
            )
    return page.render(
        _TEMPLATE,
        several=several,
        problem_count=len(several.ranked),
        best=best,
        best_rank=float(mean_ranks.iloc[0]),
        better=significantly_worse,
        undecided=undecided_tuners,
        runtime_panel=runtime_panel,
        error_panels=error_panels,
        rank_columns=[[name, "", 3] for name, _ in styles],
    )


def make_runtime_panel(
    styles: TunerMarkStyles, shares: Mapping[str, Array]
) -> tuple[Panel, pd.DataFrame]:
    """Make the panel of runtime distributions over all problems, with its table.

    Args:
        styles: Tuners with their styles.
        shares: By tuner, the share reached after 0, 1, 2, ... hundredths of each problem's budget.
    """
    tables = [
        pd.DataFrame({"tuner": name, "hundredths": np.arange(len(share)), "share": share})
        for name, share in shares.items()
    ]
    series = tuple(
        Series(name, "share", mark_style, {"tuner": name}, draw="steps")
        for name, mark_style in styles
    )
    x_axis = Axis("simulations used, in hundredths of the problem's budget", scales=("linear",))
    # A margin of 0.02, so that lines at 0 and 1 are visible.
    y_axis = Axis("share of (run, threshold) pairs reached", scales=("linear",), ends=(-0.02, 1.02))
    panel = Panel("All problems", "runtime", "hundredths", series, x_axis, y_axis)
    return panel, pd.concat(tables, ignore_index=True)


def _make_error_panels(page_data: MultiProblemPageData) -> tuple[list[Panel], pd.DataFrame]:
    """Make the panels of error against simulations, one per problem, with their table."""
    frames, panels = [], []
    counts: Counter[str] = Counter()
    for experiment, statistics in page_data.parts:
        metric = statistics.metric
        x_axis = Axis(
            "simulations used on the target",
            "symlog",
            ("symlog", "linear"),
            tuple(float(k) for k in select_checkpoints(experiment.budget)),
            # Marks at the ends must not be cut off.
            ends=(-0.08, experiment.budget * 1.1),
        )
        for kind in dict.fromkeys(statistics.curves.keys["range"]):
            medians = statistics.compute_median_curves(metric, str(kind))
            medians = medians[medians["tuner"].isin(page_data.tuners)]
            problem = f"{experiment.name} {kind}"
            counts[problem] += 1
            # If an experiment is given twice, its curves must not be mixed.
            problem += f", {counts[problem]}" if counts[problem] > 1 else ""
            frames.append(medians.assign(problem=problem, metric=metric))
            present_tuners = set(medians["tuner"])
            series = tuple(
                Series(
                    name, "median", mark_style, {"tuner": name, "problem": problem}, "low", "high"
                )
                for name, mark_style in page_data.get_tuner_styles()
                if name in present_tuners
            )
            targets = statistics.target_counts[str(kind)]
            title = f"{experiment.title or experiment.name}. {PANEL_TITLES[str(kind)]} ({targets})"
            y_axis, facets = Axis(_METRIC_LABELS[metric], "log"), {"problem": problem}
            panels.append(Panel(title, "errors", "simulations", series, x_axis, y_axis, facets))
    return panels, pd.concat(frames, ignore_index=True)
