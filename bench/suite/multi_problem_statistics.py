"""Joint statistics over several comparisons: mean ranks, runtime distribution, ERT and pairs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from bench.benchmark.comparison_figures import draw_critical_difference_figure
from bench.benchmark.comparison_report import REPORT_FILE, REQUIRED_RUN_COLUMNS
from bench.benchmark.problem.experiment import Experiment, TunerEntry
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics
from bench.benchmark.statistics.comparison_tables import add_trust_column
from bench.benchmark.statistics.error_curves import RunCurves
from bench.benchmark.statistics.expected_running_time import (
    build_ert_table,
    compute_solved_fraction,
)
from bench.benchmark.statistics.paired_tests import compare_all_pairs
from bench.benchmark.statistics.tuner_ranking import (
    MIN_PROBLEMS_FOR_RANKS,
    compute_nemenyi_p_values,
    compute_problem_ranks,
)
from bench.benchmark.storage.result_folder import read_comparison
from bench.figures.figure_output import FigureFiles, render_all_formats, write_figure_files
from bench.figures.style import TunerStyles, add_trust_note, finish_figure
from bench.pages.chart_figure import draw_chart
from bench.suite.multi_problem_page import (
    MultiProblemPageData,
    make_runtime_panel,
    render_multi_problem_page,
)
from sims.core.files import write_atomically
from sims.core.simulator import Array, InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
        """Return the result as a JSON document."""
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
        folders: result folders of the comparisons.
        out: folder to write to.
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
    for name, picture in pictures.items():
        figure_files = write_figure_files(out / "figures" / name, picture.png, picture.pdf)
        print_line(f"figure  {figure_files[0]}")
        files += figure_files
    files.append(out / REPORT_FILE)
    write_atomically(
        files[-1],
        render_multi_problem_page(collection.build_page_data(frames, pictures, folders, out)),
    )
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
        comparisons.append(LoadedComparison(ComparisonStatistics(stored), stored.experiment))
    first_labels, *other_labels = (part.statistics.curves.list_tuners() for part in comparisons)
    tuners = [t for t in first_labels if all(t in labels for labels in other_labels)]
    if not tuners:
        raise InputError(f"{', '.join(map(str, folders))}: have no tuner in common")
    return ComparisonCollection(comparisons, tuners)


@dataclass(frozen=True)
class LoadedComparison:
    """One of several comparisons.

    Attributes:
        statistics: statistics of the comparison.
        experiment: configuration of the comparison.
    """

    statistics: ComparisonStatistics
    experiment: Experiment


@dataclass(frozen=True)
class ComparisonCollection:
    """Several comparisons.

    Attributes:
        parts: comparisons, each with one problem per range.
        tuners: labels of the tuners that all comparisons have.
    """

    parts: Sequence[LoadedComparison]
    tuners: Sequence[str]

    @cached_property
    def mean_ranks(self) -> pd.DataFrame:
        """Ranks among the common tuners: one row per problem, one column per tuner, 1 is best."""
        problem_errors = pd.concat(
            [
                compute_problem_ranks(part.statistics.curves, part.statistics.floor)
                for part in self.parts
            ]
        )
        # Ranks among all tuners have gaps if some tuners are left out.
        return problem_errors[list(self.tuners)].rank(axis=1)

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
        """Build the tables ert, pairs, ranks, and nemenyi if `has_enough_problems`, by name."""
        ert, paired = [], []
        for part in self.parts:
            curves, levels = part.statistics.curves, part.statistics.levels
            times = build_ert_table(curves, levels, part.experiment.budget)
            ert.append(add_trust_column(times, part.experiment))
            paired.append(
                add_trust_column(compare_all_pairs(curves, part.statistics.floor), part.experiment)
            )
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

    def build_page_data(
        self,
        frames: Mapping[str, pd.DataFrame],
        pictures: Mapping[str, FigureFiles],
        folders: Sequence[Path],
        out: Path,
    ) -> MultiProblemPageData:
        """Build the data of the page.

        Args:
            frames: tables by name.
            pictures: rendered figures by name.
            folders: result folders of the comparisons.
            out: folder of the page.
        """
        friedman, p_values = self.rank_tests if self.has_enough_problems else (float("nan"), None)
        parts = [(part.experiment, part.statistics) for part in self.parts]
        return MultiProblemPageData(
            parts,
            self.tuners,
            self.mean_ranks,
            p_values,
            friedman,
            self._compute_runtime_distributions(),
            frames,
            pictures,
            [str(folder) for folder in folders],
            str(out),
        )

    @property
    def has_trusted_runs(self) -> bool:
        """True if tuners ran without isolation in any of the comparisons."""
        return any(part.experiment.trusted for part in self.parts)

    def _add_trusted_column(self, frame: pd.DataFrame) -> pd.DataFrame:
        """Add the column `has_trusted_runs` to a table if any tuner ran without isolation."""
        return frame.assign(trusted=True) if self.has_trusted_runs else frame

    def build_figures(self) -> dict[str, Figure]:
        """Draw runtime-distribution, and critical-difference if `has_enough_problems`."""
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

        It is the share of solved targets against the number of simulations. The tuners are ordered
        by mean rank. An `Experiment` of all tuners is made for their styles only.
        """
        order = list(self.mean_ranks.mean().sort_values(kind="stable").index)
        experiment = Experiment(
            "all",
            f"{len(self.mean_ranks)} problems",
            tuners=tuple(TunerEntry(t, t) for t in self.tuners),
        )
        style = TunerStyles(experiment, order)
        mark_styles = [(name, style.get_mark_style(name)) for name in style.order]
        panel, table = make_runtime_panel(mark_styles, self._compute_runtime_distributions())
        figure, axes = draw_chart([panel], {panel.table: table})
        caption = "Mean over problems, each with equal weight."
        finish_figure(figure, axes, style, experiment, caption)
        return figure

    def _compute_runtime_distributions(self) -> dict[str, Array]:
        """Compute the runtime distribution of each tuner (101,), the mean over problems.

        It is the share of error thresholds reached after 0..100 % of the budget.
        """
        distributions = [
            problem
            for part in self.parts
            for problem in _compute_runtime_shares(
                part.statistics.curves, part.statistics.runtime_thresholds
            )
        ]
        return {t: np.mean([problem[t] for problem in distributions], axis=0) for t in self.tuners}


def _compute_runtime_shares(curves: RunCurves, thresholds: Array) -> list[dict[str, Array]]:
    """Compute the share of thresholds that each tuner has reached after 0..100 % of the budget.

    Args:
        curves: errors of all runs of one comparison.
        thresholds: thresholds of the runtime distribution.

    Returns:
        For each range: the shares (101,) by tuner.
    """
    budget = curves.values.shape[1] - 1
    points = np.floor(np.linspace(0, budget, 101)).astype(np.int64)
    shares = []
    for kind in dict.fromkeys(curves.keys["range"]):
        range_curves = curves.select(range=str(kind))
        shares.append(
            {
                t: compute_solved_fraction(range_curves.select(tuner=t), thresholds, points)
                for t in range_curves.list_tuners()
            }
        )
    return shares
