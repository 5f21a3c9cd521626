"""HTML report over several comparisons: report.html of `simgap plot A B --out DIR`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.report_page.comparison_conclusion import SIGNIFICANCE_LEVEL
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics
from bench.benchmark.statistics.error_table import select_checkpoints
from bench.figures.style import PANEL_TITLES, FigureFiles, MarkStyle, get_mark_style
from bench.pages.chart import Axis, Chart, Panel, PrintedFigure, Series
from bench.pages.data_grid import DataGrid, GridColumn
from bench.pages.html_elements import make_code, make_list, make_paragraph, make_strong, safe
from bench.pages.html_page import HtmlPage
from bench.pages.text_format import format_number
from sims.core.simulator import Array

_DIGITS = 7
"""Number of significant digits of values that are in no file next to the page."""
_ACROSS = "simulations used on the target"
_LABELS = {
    "param_error": "mean parameter error [training widths], median",
    "stiff_error": "error along stiff directions [training widths], median",
    "heldout_error": "RMSE on held-out runs, median",
    "obs_error": "RMSE on the runs tuned on, median",
}


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
    folders: Sequence[str]
    out: str

    def get_tuner_styles(self) -> list[tuple[str, MarkStyle]]:
        """Return the tuners, best mean rank first, each with its style."""
        order = self.ranked.mean().sort_values(kind="stable").index
        places = {name: place for place, name in enumerate(self.tuners)}
        return [(str(name), get_mark_style(places[str(name)])) for name in order]


def render_multi_problem_page(several: MultiProblemPageData) -> str:
    """Build the page as HTML: results over all problems first, then each problem."""
    count = len(several.ranked)
    page = HtmlPage(
        f"{count} problems together: comparison of tuners", f"Made by {make_code('simgap')}."
    )
    page.append(f"<header>\n<h1>{len(several.tuners)} tuners on {count} problems</h1>")
    page.append(
        make_paragraph("A problem is an experiment and a range of targets.", "soft") + "</header>"
    )
    page.append(
        f'<div class="conclusion">{make_list(_conclusion(several))}</div>', _runtime(several, page)
    )
    page.add_section("ranks", "Ranks", _ranks(several, page), _difference(several, page))
    page.add_section("problems", "Each problem", _errors(several, page))
    page.add_section("numbers", "Numbers", _ert(several, page), _pairs(several, page))
    again = " ".join(["simgap plot", *several.folders, "--out", several.out])
    page.add_section("making", "How it was made", f"<pre>{safe(again, 2000)}</pre>")
    return page.to_html()


def _conclusion(several: MultiProblemPageData) -> Iterator[str]:
    means = several.ranked.mean().sort_values(kind="stable")
    best, of = str(means.index[0]), f"{len(several.tuners)} tuners"
    yield (
        f"{make_strong(safe(best))} has the best mean rank over {len(several.ranked)} problems: "
        f"{format_number(means.iloc[0])} among {of} (1 is best)."
    )
    if several.p_values is None:
        yield "Too few problems or tuners for a test of mean ranks: the order may be chance."
        return
    others = several.p_values[best].drop(best)
    better = [str(name) for name in others.index[others < SIGNIFICANCE_LEVEL]]
    left = [str(name) for name in others.index[others >= SIGNIFICANCE_LEVEL]]
    said = f"Friedman's test over all: p = {format_number(several.friedman, 2)}. Nemenyi's at 5 %: "
    said += f"better than {_named(better)}" if better else "better than none of the others"
    yield said + (f"; not told apart from {_named(left)}." if left else ".")


def _named(names: Sequence[str]) -> str:
    return ", ".join(safe(name, 40) for name in names)


def _runtime(several: MultiProblemPageData, page: HtmlPage) -> str:
    parts = [
        pd.DataFrame({"tuner": name, "hundredths": np.arange(len(share)), "share": share})
        for name, share in several.shares.items()
    ]
    page.add_table("runtime", pd.concat(parts), _DIGITS)
    series = tuple(
        Series(name, "share", drawn, {"tuner": name}, draw="steps")
        for name, drawn in several.get_tuner_styles()
    )
    across = Axis("simulations used, in hundredths of the problem's budget", scales=("linear",))
    up = Axis("share of (run, threshold) pairs reached", scales=("linear",), ends=(-0.02, 1.02))
    panel = Panel("All problems", "runtime", "hundredths", series, across, up)
    caption = (
        "The mean over problems, each with equal weight. Reached: the error stays at or below the "
        "threshold from there on. Higher is better; where a line ends is what can be solved at all."
    )
    still = _still(
        several, "runtime-distribution", "The share of thresholds reached by each tuner."
    )
    title = "Runtime distributions over all problems"
    return page.render_chart(Chart("runtime", title, caption, (panel,), still))


def _ranks(several: MultiProblemPageData, page: HtmlPage) -> str:
    page.add_table("ranks", several.tables["ranks"])
    columns = (
        GridColumn("problem"),
        *(GridColumn(name, digits=3) for name, _ in several.get_tuner_styles()),
    )
    return page.render_grid(
        DataGrid("each-rank", "Rank on each problem: ranks.csv", "ranks", columns)
    )


def _difference(several: MultiProblemPageData, page: HtmlPage) -> str:
    still = _still(several, "critical-difference", "Mean ranks of the tuners on a line.")
    if still is None:
        return make_paragraph("No critical-difference diagram: too few problems or tuners.", "soft")
    caption = "Mean ranks, 1 is best; a bar joins tuners that cannot be told apart at 5 %."
    return "<h3>Critical differences</h3>\n" + page.render_figure("difference", still, caption)


def _errors(several: MultiProblemPageData, page: HtmlPage) -> str:
    """Build the chart of error against simulations, with one panel per problem."""
    frames, panels = [], []
    met: Counter[str] = Counter()
    for experiment, statistics in several.parts:
        metric = statistics.metric
        ticks = tuple(float(k) for k in select_checkpoints(experiment.budget))
        ends = (-0.08, experiment.budget * 1.1)
        for kind in dict.fromkeys(statistics.curves.keys["range"]):
            medians = statistics.compute_median_curves(metric, str(kind))
            medians = medians[medians["tuner"].isin(several.tuners)]
            problem = f"{experiment.name} {kind}"
            met[problem] += 1
            # If an experiment is given twice, its curves must not be mixed.
            problem += f", {met[problem]}" if met[problem] > 1 else ""
            frames.append(medians.assign(problem=problem, metric=metric))
            across = Axis(_ACROSS, "symlog", ("symlog", "linear"), ticks, ends=ends)
            there = set(medians["tuner"])
            series = tuple(
                Series(name, "median", drawn, {"tuner": name, "problem": problem}, "low", "high")
                for name, drawn in several.get_tuner_styles()
                if name in there
            )
            count = statistics.target_counts[str(kind)]
            title = f"{experiment.title or experiment.name}. {PANEL_TITLES[str(kind)]} ({count})"
            up = Axis(_LABELS[metric], "log")
            facets = {"problem": problem}
            panels.append(Panel(title, "errors", "simulations", series, across, up, facets))
    page.add_table("errors", pd.concat(frames, ignore_index=True), _DIGITS)
    caption = (
        "A line is the median over targets of the error that decides, the band its 95 % bootstrap "
        "interval. Choose the problem above the figure."
    )
    return page.render_chart(Chart("errors", "Error against simulations", caption, tuple(panels)))


def _ert(several: MultiProblemPageData, page: HtmlPage) -> str:
    page.add_table("ert", several.tables["ert"])
    columns = (
        GridColumn("experiment"),
        GridColumn("range"),
        GridColumn("tuner"),
        GridColumn("threshold", "error to be reached", 3),
        GridColumn("ert", "expected simulations", 3),
        GridColumn("low", "95 % low", 3),
        GridColumn("high", "95 % high", 3),
        GridColumn("successes", digits=6),
        GridColumn("runs", digits=6),
    )
    filters = ("experiment", "range", "tuner", "threshold")
    title = "Expected running times: ert.csv"
    return page.render_grid(DataGrid("times", title, "ert", columns, filters, {}, "", "tuner"))


def _pairs(several: MultiProblemPageData, page: HtmlPage) -> str:
    table = several.tables["pairs"]
    if table.empty:
        return ""
    page.add_table("pairs", table)
    columns = (
        GridColumn("experiment"),
        GridColumn("range"),
        GridColumn("a"),
        GridColumn("b"),
        GridColumn("targets", digits=6),
        GridColumn("a_better", "share where a is better", 3),
        GridColumn("error_ratio", "error of a over b, median", 3),
        GridColumn("p_holm", "p, Holm-corrected", 2),
    )
    title = "Tuner against tuner: pairs.csv"
    return page.render_grid(
        DataGrid(
            "against", title, "pairs", columns, ("experiment", "range", "a", "b"), {}, "p_holm"
        )
    )


def _still(several: MultiProblemPageData, name: str, shows: str) -> PrintedFigure | None:
    if name not in several.pictures:
        return None
    picture = several.pictures[name]
    return PrintedFigure(picture.svg, picture.pdf, shows, name)
