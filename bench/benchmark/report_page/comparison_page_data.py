"""Data from which the page of a comparison is rendered."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from bench.benchmark.figures.comparison_figures import FIGURE_FILES
from bench.benchmark.figures.comparison_view import ComparisonView
from bench.figures.style import FigureFiles
from bench.pages.chart import PrintedFigure


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

    def make_static_figure(self, name: str, description: str) -> PrintedFigure | None:
        """Return the printed version of a figure; None if it was not drawn.

        Args:
            name: Name of the figure.
            description: Text description for readers who cannot see it.
        """
        return PrintedFigure.from_files(self.pictures, name, description, FIGURE_FILES[name])

    def format_rerun_command(self) -> str:
        """Return the command that repeats the comparison."""
        words = ["simgap", "compare", f"{self.folder}/experiment.toml"]
        for plugin in self.environment.get("plugins", ()):
            words += ["--plugin", plugin]
        return shlex.join(words)
