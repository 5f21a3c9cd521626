"""Data from which the page of a comparison is rendered."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import pandas as pd

from bench.analysis.statistics import Statistics
from bench.figures.comparison import FILES, Labels
from bench.figures.errors import parameter_label
from bench.figures.style import Look, Pictures, Styles, style_of
from bench.pages.chart import Static
from bench.problem.experiment import Experiment
from bench.store.folder import Stored


@dataclass(frozen=True)
class Results:
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

    stored: Stored
    labels: Labels
    statistics: Statistics
    tables: Mapping[str, pd.DataFrame]
    pictures: Mapping[str, Pictures]
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
        return [kind for kind in self.experiment.ranges if kind in self.statistics.targets]

    @cached_property
    def style(self) -> Styles:
        """Styles of the tuners, and their order by the deciding error."""
        return style_of(self.experiment, self.statistics)

    def looks(self, present: pd.Series[Any]) -> list[tuple[str, Look]]:
        """Return the tuners of a column, best first, each with its style."""
        there = set(present)
        return [(name, self.style.look(name)) for name in self.style.order if name in there]

    def count(self, kind: str) -> int:
        """Return the number of targets of a range; for a recording, of starting points."""
        return self.statistics.targets[kind]

    @property
    def shown_metric(self) -> str:
        """The deciding error; for a single parameter in its own unit."""
        metric = self.statistics.metric
        return self.statistics.parameter_metric if metric == "param_error" else metric

    def label(self, metric: str) -> str:
        """Return the axis label of an error."""
        channel = self.labels.channel
        real = "real" in self.experiment.ranges
        return {
            "param_abs_error": parameter_label(self.labels.parameter),
            "param_error": parameter_label(""),
            "stiff_error": "error along stiff directions [training widths]",
            "sloppy_error": "error along sloppy directions [training widths]",
            "obs_error": f"RMSE of {channel}" + (", runs tuned on" if real else ""),
            "heldout_error": f"RMSE of {channel}, "
            + ("held-out runs" if real else "unseen scenarios"),
        }[metric]

    def still(self, name: str, shows: str) -> Static | None:
        """Return the printed version of a figure; None if it was not drawn.

        Args:
            name: Name of the figure.
            shows: Text description for readers who cannot see it.
        """
        if name not in self.pictures:
            return None
        picture = self.pictures[name]
        return Static(picture.svg, picture.pdf, shows, FILES[name])
