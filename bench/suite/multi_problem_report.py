"""Joint statistics over several comparisons, and their page (`simgap plot A B --out DIR`).

They are mean ranks, runtime distributions, expected running times (ERT) and tests of pairs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from bench.benchmark.comparison_charts import PANEL_TITLES, make_simulations_axis
from bench.benchmark.comparison_report import REPORT_FILE
from bench.benchmark.statistics.comparison_statistics import (
    REQUIRED_RUN_COLUMNS,
    ComparisonStatistics,
    add_trust_column,
)
from bench.benchmark.statistics.expected_running_time import (
    compute_runtime_shares,
)
from bench.benchmark.statistics.paired_tests import compare_all_pairs
from bench.benchmark.statistics.tuner_ranking import (
    MIN_PROBLEMS_FOR_RANKS,
    SIGNIFICANCE,
    compute_nemenyi_p_values,
    compute_problem_ranks,
)
from bench.benchmark.storage.result_folder import read_comparison
from bench.figures.figure_layout import add_trust_note, finish_chart, make_panel_grid
from bench.figures.figure_output import FigureFiles, render_all_formats, write_figures
from bench.figures.style import NEUTRAL_MARK, MarkStyle, get_colour, get_mark_style
from bench.pages.chart import Axis, Panel, draw_chart, make_method_series
from bench.pages.html_page import HtmlPage
from sims.core.files import write_atomically
from sims.core.simulator import Array, InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TEMPLATE = Path(__file__).with_name("multi_problem.html")
_DIGITS = 7
"""Number of significant digits of values that are in no file next to the page."""
_METRIC_LABELS = {
    "param_error": "mean parameter error [training widths], median",
    "stiff_error": "error along stiff directions [training widths], median",
    "heldout_error": "RMSE on held-out runs, median",
    "obs_error": "RMSE on the runs tuned on, median",
}
_MIN_TUNERS_FRIEDMAN = 3
"""Minimum number of tuners for Friedman's test."""


class MultiProblemResult(NamedTuple):
    """Result of evaluating several comparisons together.

    Attributes:
        together: comparisons.
        files: files that were written.
    """

    together: ComparisonCollection
    files: list[Path]

    def to_document(self) -> dict[str, Any]:
        """Return the result as a JSON document.

        It has the ranks of each tuner on each problem, their means, the p-value of the Friedman
        test, and the files written.
        """
        ranked = self.together.mean_ranks
        return {
            "problems": list(ranked.index),
            "ranks": {str(tuner): list(ranked[tuner]) for tuner in ranked},
            "mean_ranks": ranked.mean().sort_values().to_dict(),
            "friedman_p": self.together.rank_tests[0]
            if self.together.has_enough_problems
            else None,
            "trusted": self.together.has_trusted_runs,
            "files": self.files,
        }


def compare_across_problems(
    folders: Sequence[Path], out: Path, print_line: Callable[[str], None]
) -> MultiProblemResult:
    """Compute joint statistics of several comparisons, and write tables, figures and a page.

    Args:
        folders: folders of the comparisons.
        out: folder to which the files are written.
        print_line: callback that prints one line.

    Raises:
        InputError: a folder is not that of a comparison, or they share no tuners.
    """
    collection = load_comparisons(folders)
    out.mkdir(parents=True, exist_ok=True)
    files = []
    frames = collection.build_tables()
    for name, frame in frames.items():
        files.append(out / f"{name}.csv")
        write_atomically(files[-1], frame.to_csv(index=False))
    mean_ranks = collection.mean_ranks.mean().sort_values().round(2)
    count = len(collection.mean_ranks)
    print_line(f"mean rank over {count} problems (1 is best)\n{mean_ranks.to_string()}")
    if not collection.has_enough_problems:
        print_line(
            f"no critical-difference diagram: it needs {MIN_PROBLEMS_FOR_RANKS} problems and "
            f"{_MIN_TUNERS_FRIEDMAN} tuners"
        )
    pictures = {
        name: render_all_formats(figure) for name, figure in collection.build_figures().items()
    }
    for path in write_figures(out, pictures):
        files.append(path)
        if path.suffix == ".png":
            print_line(f"figure  {path}")
    files.append(out / REPORT_FILE)
    command = ["simgap", "plot", *map(str, folders), "--out", str(out)]
    write_atomically(files[-1], render_multi_problem_page(collection, frames, pictures, command))
    print_line(f"report  {files[-1]}")
    return MultiProblemResult(collection, files)


def load_comparisons(folders: Sequence[Path]) -> ComparisonCollection:
    """Load several comparisons.

    Raises:
        InputError: a folder is not that of a comparison, or they share no tuners.
    """
    comparisons = []
    for folder in folders:
        stored = read_comparison(folder, REQUIRED_RUN_COLUMNS)
        if stored.runs.empty:
            raise InputError(f"{folder}: contains no runs")
        comparisons.append(ComparisonStatistics(stored))
    first_labels, *other_labels = (part.curves.list_tuners() for part in comparisons)
    tuners = [t for t in first_labels if all(t in labels for labels in other_labels)]
    if not tuners:
        raise InputError(f"{', '.join(map(str, folders))}: have no tuner in common")
    return ComparisonCollection(comparisons, tuners)


@dataclass(frozen=True)
class ComparisonCollection:
    """Several comparisons.

    Attributes:
        parts: statistics of the comparisons, each with one problem per range.
        tuners: labels of the tuners that all comparisons have.
    """

    parts: Sequence[ComparisonStatistics]
    tuners: Sequence[str]

    @cached_property
    def mean_ranks(self) -> pd.DataFrame:
        """Ranks among the common tuners: one row per problem, one column per tuner, 1 is best.

        Common tuners are those that every comparison has.
        """
        problem_ranks = pd.concat(
            [compute_problem_ranks(part.curves, part.floor) for part in self.parts]
        )
        # Ranks among all tuners of a comparison have gaps if some tuners are left out.
        return problem_ranks[list(self.tuners)].rank(axis=1)

    @property
    def has_enough_problems(self) -> bool:
        """True if there are enough problems and tuners for Friedman's and Nemenyi's tests."""
        return (
            len(self.mean_ranks) >= MIN_PROBLEMS_FOR_RANKS
            and len(self.tuners) >= _MIN_TUNERS_FRIEDMAN
        )

    @cached_property
    def rank_tests(self) -> tuple[float, pd.DataFrame]:
        """Friedman's p-value, and Nemenyi's for each pair; requires `has_enough_problems`."""
        return compute_nemenyi_p_values(self.mean_ranks)

    def build_tables(self) -> dict[str, pd.DataFrame]:
        """Build the tables ert, pairs, ranks, and nemenyi if `has_enough_problems`, by name.

        They are the expected running times (ERT), paired tests, ranks, and the p-values of
        Nemenyi's test between all tuners.
        """
        ert, paired = [], []
        for part in self.parts:
            ert.append(add_trust_column(part.running_times, part.experiment))
            pairs = compare_all_pairs(part.curves, part.floor)
            paired.append(add_trust_column(pairs, part.experiment))
        frames = {
            "ert": pd.concat(ert),
            "pairs": pd.concat(paired),
            "ranks": self._add_trusted_column(self.mean_ranks).reset_index(names="problem"),
        }
        if self.has_enough_problems:
            frames["nemenyi"] = self._add_trusted_column(self.rank_tests[1]).reset_index(
                names="tuner"
            )
        return frames

    @property
    def has_trusted_runs(self) -> bool:
        """True if tuners ran without isolation in any of the comparisons."""
        return any(part.experiment.trusted for part in self.parts)

    def _add_trusted_column(self, frame: pd.DataFrame) -> pd.DataFrame:
        """Add the column `has_trusted_runs` to a table if any tuner ran without isolation."""
        return frame.assign(trusted=True) if self.has_trusted_runs else frame

    def build_figures(self) -> dict[str, Figure]:
        """Draw runtime-distribution, and critical-difference if `has_enough_problems`.

        The critical-difference figure shows mean ranks and which tuners do not differ significantly
        (Friedman and Nemenyi tests).
        """
        figures = {"runtime-distribution": self._draw_runtime_distribution()}
        if self.has_enough_problems:
            friedman, p_values = self.rank_tests
            figures["critical-difference"] = draw_critical_difference_figure(
                self.mean_ranks, p_values, friedman
            )
        return {
            name: add_trust_note(figure, self.has_trusted_runs) for name, figure in figures.items()
        }

    def _draw_runtime_distribution(self) -> Figure:
        """Draw the runtime distribution over all problems.

        It is the share of pairs (run, error threshold) that are reached within a share of the
        problem's budget. The tuners are ordered by mean rank.
        """
        panel, table = self.make_runtime_panel()
        figure, axes = draw_chart([panel], {panel.table: table})
        return finish_chart(
            figure,
            axes[0],
            f"{len(self.mean_ranks)} problems",
            "Mean over problems, each with equal weight. Legend: the best mean rank first.",
            "outside right upper",
        )

    @property
    def styles(self) -> dict[str, MarkStyle]:
        """Style of each tuner, in the order of their mean ranks, the best first."""
        order = self.mean_ranks.mean().sort_values(kind="stable").index
        return {str(name): get_mark_style(self.tuners.index(str(name))) for name in order}

    def make_runtime_panel(self) -> tuple[Panel, pd.DataFrame]:
        """Make the panel of runtime distributions over all problems, with its table."""
        return _make_runtime_panel(self.styles, self._compute_runtime_distributions())

    def _compute_runtime_distributions(self) -> dict[str, Array]:
        """Compute the runtime distribution of each tuner (101,), the mean over problems.

        It is the share of error thresholds reached after 0..100 % of the budget.
        """
        distributions = [
            problem
            for part in self.parts
            for problem in compute_runtime_shares(part.curves, part.runtime_thresholds)
        ]
        return {t: np.mean([problem[t] for problem in distributions], axis=0) for t in self.tuners}


def draw_critical_difference_figure(
    ranked: pd.DataFrame, p_values: pd.DataFrame, friedman: float
) -> Figure:
    """Draw the critical-difference diagram: mean ranks over problems.

    Bars join tuners that do not differ significantly at 5 %.

    Args:
        ranked: Ranks, one row per problem, one column per tuner.
        p_values: P-values of Nemenyi's test of each pair of tuners.
        friedman: P-value of Friedman's test.
    """
    from scikit_posthocs import critical_difference_diagram

    # Width and height in inches, with the space for each tuner.
    figure, axes = make_panel_grid(1, 1, (8.5, 1.6 + 0.28 * ranked.shape[1]))
    axis = axes[0, 0]
    # Each tuner has its colour of every other figure; text stays dark, since light colours are hard
    # to read.
    colours = {str(name): get_colour(index) for index, name in enumerate(ranked.columns)}
    artists = critical_difference_diagram(
        ranked.mean(axis=0), p_values, ax=axis, label_props={"fontsize": 9}, color_palette=colours
    )
    for label in artists["labels"]:
        label.set_color(NEUTRAL_MARK)
    tests = f"Friedman p = {friedman:.2g}; bars: Nemenyi p > 0.05"
    axis.set_title(f"Mean rank over {len(ranked)} problems, 1 is best ({tests})", fontsize=10)
    return figure


def _make_runtime_panel(
    styles: Mapping[str, MarkStyle], shares: Mapping[str, Array]
) -> tuple[Panel, pd.DataFrame]:
    """Make the panel of runtime distributions over all problems, with its table.

    Args:
        styles: tuners in the order of the legend, each with its style.
        shares: by tuner, the share reached after 0, 1, 2, ... hundredths of each problem's budget.
    """
    tables = [
        pd.DataFrame({"tuner": name, "hundredths": np.arange(len(share)), "share": share})
        for name, share in shares.items()
    ]
    series = make_method_series(styles, "tuner", "share", draw="steps")
    x_axis = Axis("simulations used, in hundredths of the problem's budget", scales=("linear",))
    # A margin of 0.02, so that lines at 0 and 1 are visible.
    y_axis = Axis("share of (run, threshold) pairs reached", scales=("linear",), ends=(-0.02, 1.02))
    panel = Panel("All problems", "runtime", "hundredths", series, x_axis, y_axis)
    return panel, pd.concat(tables, ignore_index=True)


def _make_error_panels(collection: ComparisonCollection) -> tuple[list[Panel], pd.DataFrame]:
    """Make the panels of error against simulations, one per problem, with their table.

    Medians over targets are drawn with their intervals.

    Args:
        collection: Comparisons on several problems with their common tuners.

    Returns:
        A panel for each problem and range of targets, and the medians that all panels draw.
    """
    frames, panels = [], []
    counts: Counter[str] = Counter()
    for part in collection.parts:
        experiment, metric = part.experiment, part.metric
        x_axis = make_simulations_axis(experiment.budget)
        for kind in dict.fromkeys(part.curves.keys["range"]):
            medians = part.compute_median_curves(metric, str(kind))
            medians = medians[medians["tuner"].isin(collection.tuners)]
            problem = f"{experiment.name} {kind}"
            counts[problem] += 1
            # If an experiment is given twice, its curves must not be mixed.
            problem += f", {counts[problem]}" if counts[problem] > 1 else ""
            frames.append(medians.assign(problem=problem, metric=metric))
            names = set(medians["tuner"])
            styles = {name: look for name, look in collection.styles.items() if name in names}
            where = {"problem": problem}
            series = make_method_series(
                styles, "tuner", "median", where=where, low="low", high="high"
            )
            targets = part.target_counts[str(kind)]
            title = f"{experiment.title or experiment.name}. {PANEL_TITLES[str(kind)]} ({targets})"
            y_axis, facets = Axis(_METRIC_LABELS[metric], "log"), {"problem": problem}
            panels.append(Panel(title, "errors", "simulations", series, x_axis, y_axis, facets))
    return panels, pd.concat(frames, ignore_index=True)


def render_multi_problem_page(
    collection: ComparisonCollection,
    tables: Mapping[str, pd.DataFrame],
    pictures: Mapping[str, FigureFiles],
    command: Sequence[str],
) -> str:
    """Render the HTML page of a comparison on several problems.

    The page has the mean ranks with Friedman's and Nemenyi's tests, the runtime distribution over
    all problems, and error curves by problem.

    Args:
        collection: comparisons.
        tables: tables by name, as written next to the page.
        pictures: printed figures by name.
        command: words of the command that makes the page.
    """
    page = HtmlPage(pictures)
    page.add_tables({name: tables[name] for name in ("ranks", "ert", "pairs")})
    runtime_panel, shares = collection.make_runtime_panel()
    page.add_table(runtime_panel.table, shares, _DIGITS)
    error_panels, errors = _make_error_panels(collection)
    page.add_table("errors", errors, _DIGITS)
    friedman, p_values = collection.rank_tests if collection.has_enough_problems else (None, None)
    mean_ranks = collection.mean_ranks.mean().sort_values(kind="stable")
    best = str(mean_ranks.index[0])
    significantly_worse: list[str] = []
    undecided_tuners: list[str] = []
    if p_values is not None:
        for tuner, p_value in p_values[best].drop(best).items():
            is_significant = p_value < SIGNIFICANCE
            (significantly_worse if is_significant else undecided_tuners).append(str(tuner))
    return page.render(
        _TEMPLATE,
        tuners=collection.tuners,
        friedman=friedman,
        command=command,
        problem_count=len(collection.mean_ranks),
        best=best,
        best_rank=float(mean_ranks.iloc[0]),
        # The best tuner is better than these.
        better=significantly_worse,
        undecided=undecided_tuners,
        runtime_panel=runtime_panel,
        error_panels=error_panels,
        rank_columns=[[name, "", 3] for name in collection.styles],
    )
