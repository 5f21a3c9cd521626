"""Data from which the page of a comparison is rendered."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import pandas as pd

from bench.benchmark.figures.comparison_figures import FIGURE_FILES, AxisLabels
from bench.benchmark.figures.error_figures import format_parameter_label
from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics
from bench.benchmark.storage.result_folder import StoredComparison
from bench.figures.style import FigureFiles, MarkStyle, TunerStyles, style_of
from bench.pages.chart import PrintedFigure


@dataclass(frozen=True)
class ComparisonReportData:
    """A comparison, as shown on its page.

    Attributes:
        stored: Content of its folder.
        labels: Axis labels.
        statistics: Statistics for tables and figures.
        tables: Tables by name, as written next to the page.
        pictures: Printed figures by name.
        environment: Content of environment.json.
        folder: Its folder, as named by the user.
        configuration: Text of experiment.toml.
        missing: Number of planned runs that have not been made yet.
    """

    stored: StoredComparison
    labels: AxisLabels
    statistics: ComparisonStatistics
    tables: Mapping[str, pd.DataFrame]
    pictures: Mapping[str, FigureFiles]
    environment: Mapping[str, Any]
    folder: str
    configuration: str
    missing: int = 0

    @property
    def experiment(self) -> Experiment:
        """The experiment that was run."""
        return self.stored.experiment

    @property
    def ranges(self) -> list[str]:
        """Ranges that have runs, in the experiment's order."""
        return [kind for kind in self.experiment.ranges if kind in self.statistics.target_counts]

    @cached_property
    def style(self) -> TunerStyles:
        """Styles of the tuners, and their order by the deciding error."""
        return style_of(self.experiment, self.statistics)

    def get_tuner_styles(self, present: pd.Series[Any]) -> list[tuple[str, MarkStyle]]:
        """Return the tuners of a column, best first, each with its style."""
        there = set(present)
        return [
            (name, self.style.get_mark_style(name)) for name in self.style.order if name in there
        ]

    def count_targets(self, kind: str) -> int:
        """Return the number of targets of a range; for a recording, of starting points."""
        return self.statistics.target_counts[kind]

    @property
    def shown_metric(self) -> str:
        """The deciding error; for a single parameter in its own unit."""
        metric = self.statistics.metric
        return self.statistics.parameter_error_metric if metric == "param_error" else metric

    def format_metric_label(self, metric: str) -> str:
        """Return the axis label of an error."""
        channel = self.labels.channel
        real = "real" in self.experiment.ranges
        return {
            "param_abs_error": format_parameter_label(self.labels.parameter),
            "param_error": format_parameter_label(""),
            "stiff_error": "error along stiff directions [training widths]",
            "sloppy_error": "error along sloppy directions [training widths]",
            "obs_error": f"RMSE of {channel}" + (", runs tuned on" if real else ""),
            "heldout_error": f"RMSE of {channel}, "
            + ("held-out runs" if real else "unseen scenarios"),
        }[metric]

    def make_static_figure(self, name: str, shows: str) -> PrintedFigure | None:
        """Return the printed version of a figure; None if it was not drawn.

        Args:
            name: Name of the figure.
            shows: Text description for readers who cannot see it.
        """
        if name not in self.pictures:
            return None
        picture = self.pictures[name]
        return PrintedFigure(picture.svg, picture.pdf, shows, FIGURE_FILES[name])
