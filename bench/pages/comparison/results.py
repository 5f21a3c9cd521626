"""What the page of a comparison is made from."""

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
    """A comparison as its page tells it.

    Attributes:
        stored: what lies in its folder.
        labels: of its axes.
        statistics: behind its tables and figures.
        tables: by name, as they are written beside the page.
        pictures: its figures by name, as they are printed.
        environment: what environment.json says.
        folder: where it lies, as it was named.
        configuration: the text of experiment.toml.
        missing: runs that are planned and not made yet.
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
        """What was compared."""
        return self.stored.experiment

    @property
    def ranges(self) -> list[str]:
        """Ranges of which there are runs, in the experiment's order."""
        return [kind for kind in self.experiment.ranges if kind in self.statistics.targets]

    @cached_property
    def style(self) -> Styles:
        """Looks of the tuners, and their order by the error that decides."""
        return style_of(self.experiment, self.statistics)

    def looks(self, present: pd.Series[Any]) -> list[tuple[str, Look]]:
        """The tuners of a column, best first, each with its look."""
        there = set(present)
        return [(name, self.style.look(name)) for name in self.style.order if name in there]

    def count(self, kind: str) -> int:
        """Targets of a range; of a recording, starting points."""
        return self.statistics.targets[kind]

    @property
    def shown_metric(self) -> str:
        """The error that decides; of one parameter in its own unit."""
        metric = self.statistics.metric
        return self.statistics.parameter_metric if metric == "param_error" else metric

    def label(self, metric: str) -> str:
        """What an error is called on an axis."""
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
        """A figure as it is printed; None where it was not drawn.

        Args:
            name: of the figure.
            shows: what, for those who do not see it.
        """
        if name not in self.pictures:
            return None
        picture = self.pictures[name]
        return Static(picture.svg, picture.pdf, shows, FILES[name])
