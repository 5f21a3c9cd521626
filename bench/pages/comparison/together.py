"""HTML report over several comparisons: report.html of `simgap plot A B --out DIR`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from bench.analysis.statistics import Statistics
from bench.analysis.table import checkpoints
from bench.figures.style import TITLES, Look, Pictures, look
from bench.pages.chart import Axis, Chart, Panel, Series, Static
from bench.pages.comparison.conclusion import SURE
from bench.pages.elements import code, listed, paragraph, safe, strong
from bench.pages.grid import Column, Grid
from bench.pages.page import Page
from bench.pages.text import number
from bench.problem.experiment import Experiment
from sims.base import Array

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
class Several:
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

    parts: Sequence[tuple[Experiment, Statistics]]
    tuners: Sequence[str]
    ranked: pd.DataFrame
    p_values: pd.DataFrame | None
    friedman: float
    shares: Mapping[str, Array]
    tables: Mapping[str, pd.DataFrame]
    pictures: Mapping[str, Pictures]
    folders: Sequence[str]
    out: str

    def looks(self) -> list[tuple[str, Look]]:
        """Return the tuners, best mean rank first, each with its style."""
        order = self.ranked.mean().sort_values(kind="stable").index
        places = {name: place for place, name in enumerate(self.tuners)}
        return [(str(name), look(places[str(name)])) for name in order]


def together_page(several: Several) -> str:
    """Build the page as HTML: results over all problems first, then each problem."""
    count = len(several.ranked)
    page = Page(f"{count} problems together: comparison of tuners", f"Made by {code('simgap')}.")
    page.add(f"<header>\n<h1>{len(several.tuners)} tuners on {count} problems</h1>")
    page.add(paragraph("A problem is an experiment and a range of targets.", "soft") + "</header>")
    page.add(
        f'<div class="conclusion">{listed(_conclusion(several))}</div>', _runtime(several, page)
    )
    page.section("ranks", "Ranks", _ranks(several, page), _difference(several, page))
    page.section("problems", "Each problem", _errors(several, page))
    page.section("numbers", "Numbers", _ert(several, page), _pairs(several, page))
    again = " ".join(["simgap plot", *several.folders, "--out", several.out])
    page.section("making", "How it was made", f"<pre>{safe(again, 2000)}</pre>")
    return page.html()


def _conclusion(several: Several) -> Iterator[str]:
    means = several.ranked.mean().sort_values(kind="stable")
    best, of = str(means.index[0]), f"{len(several.tuners)} tuners"
    yield (
        f"{strong(safe(best))} has the best mean rank over {len(several.ranked)} problems: "
        f"{number(means.iloc[0])} among {of} (1 is best)."
    )
    if several.p_values is None:
        yield "Too few problems or tuners for a test of mean ranks: the order may be chance."
        return
    others = several.p_values[best].drop(best)
    better = [str(name) for name in others.index[others < SURE]]
    left = [str(name) for name in others.index[others >= SURE]]
    said = f"Friedman's test over all: p = {number(several.friedman, 2)}. Nemenyi's at 5 %: "
    said += f"better than {_named(better)}" if better else "better than none of the others"
    yield said + (f"; not told apart from {_named(left)}." if left else ".")


def _named(names: Sequence[str]) -> str:
    return ", ".join(safe(name, 40) for name in names)


def _runtime(several: Several, page: Page) -> str:
    parts = [
        pd.DataFrame({"tuner": name, "hundredths": np.arange(len(share)), "share": share})
        for name, share in several.shares.items()
    ]
    page.table("runtime", pd.concat(parts), _DIGITS)
    series = tuple(
        Series(name, "share", drawn, {"tuner": name}, draw="steps")
        for name, drawn in several.looks()
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
    return page.chart(Chart("runtime", title, caption, (panel,), still))


def _ranks(several: Several, page: Page) -> str:
    page.table("ranks", several.tables["ranks"])
    columns = (Column("problem"), *(Column(name, digits=3) for name, _ in several.looks()))
    return page.grid(Grid("each-rank", "Rank on each problem: ranks.csv", "ranks", columns))


def _difference(several: Several, page: Page) -> str:
    still = _still(several, "critical-difference", "Mean ranks of the tuners on a line.")
    if still is None:
        return paragraph("No critical-difference diagram: too few problems or tuners.", "soft")
    caption = "Mean ranks, 1 is best; a bar joins tuners that cannot be told apart at 5 %."
    return "<h3>Critical differences</h3>\n" + page.picture("difference", still, caption)


def _errors(several: Several, page: Page) -> str:
    """Build the chart of error against simulations, with one panel per problem."""
    frames, panels = [], []
    met: Counter[str] = Counter()
    for experiment, statistics in several.parts:
        metric = statistics.metric
        ticks = tuple(float(k) for k in checkpoints(experiment.budget))
        ends = (-0.08, experiment.budget * 1.1)
        for kind in dict.fromkeys(statistics.curves.keys["range"]):
            medians = statistics.medians(metric, str(kind))
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
                for name, drawn in several.looks()
                if name in there
            )
            count = statistics.targets[str(kind)]
            title = f"{experiment.title or experiment.name}. {TITLES[str(kind)]} ({count})"
            up = Axis(_LABELS[metric], "log")
            facets = {"problem": problem}
            panels.append(Panel(title, "errors", "simulations", series, across, up, facets))
    page.table("errors", pd.concat(frames, ignore_index=True), _DIGITS)
    caption = (
        "A line is the median over targets of the error that decides, the band its 95 % bootstrap "
        "interval. Choose the problem above the figure."
    )
    return page.chart(Chart("errors", "Error against simulations", caption, tuple(panels)))


def _ert(several: Several, page: Page) -> str:
    page.table("ert", several.tables["ert"])
    columns = (
        Column("experiment"),
        Column("range"),
        Column("tuner"),
        Column("threshold", "error to be reached", 3),
        Column("ert", "expected simulations", 3),
        Column("low", "95 % low", 3),
        Column("high", "95 % high", 3),
        Column("successes", digits=6),
        Column("runs", digits=6),
    )
    filters = ("experiment", "range", "tuner", "threshold")
    title = "Expected running times: ert.csv"
    return page.grid(Grid("times", title, "ert", columns, filters, {}, "", "tuner"))


def _pairs(several: Several, page: Page) -> str:
    table = several.tables["pairs"]
    if table.empty:
        return ""
    page.table("pairs", table)
    columns = (
        Column("experiment"),
        Column("range"),
        Column("a"),
        Column("b"),
        Column("targets", digits=6),
        Column("a_better", "share where a is better", 3),
        Column("error_ratio", "error of a over b, median", 3),
        Column("p_holm", "p, Holm-corrected", 2),
    )
    title = "Tuner against tuner: pairs.csv"
    return page.grid(
        Grid("against", title, "pairs", columns, ("experiment", "range", "a", "b"), {}, "p_holm")
    )


def _still(several: Several, name: str, shows: str) -> Static | None:
    if name not in several.pictures:
        return None
    picture = several.pictures[name]
    return Static(picture.svg, picture.pdf, shows, name)
