"""A comparison with its statistics, labels and styles, from which charts and pages are made."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics
from bench.benchmark.storage.result_folder import StoredComparison
from bench.figures.style import MarkStyle, TunerStyles, style_of


class AxisLabels(NamedTuple):
    """Axis labels of a comparison.

    Attributes:
        channel: Error channel with unit, e.g. ``q [rad]``.
        parameter: Name of the parameter, e.g. ``restitution``; empty for several parameters.
    """

    channel: str
    parameter: str


def make_axis_labels(problem: TuningProblem) -> AxisLabels:
    """Make the axis labels for a comparison's problem, with units.

    The label of a parameter is empty if there are several, because they share no unit.
    """
    channel = problem.channels[problem.error_channel]
    parameters = problem.cube.parameters
    parameter = ""
    if len(parameters) == 1:
        unit = parameters[0].unit
        parameter = parameters[0].name + (f" [{unit}]" if unit != "1" else "")
    return AxisLabels(f"{channel.name} [{channel.unit}]", parameter)


@dataclass(frozen=True)
class ComparisonView:
    """A comparison as charts and pages show it.

    Attributes:
        stored: Content of its folder.
        labels: Axis labels.
        statistics: Its statistics.
    """

    stored: StoredComparison
    labels: AxisLabels
    statistics: ComparisonStatistics

    @property
    def experiment(self) -> Experiment:
        """The experiment that was run."""
        return self.stored.experiment

    @property
    def is_recording(self) -> bool:
        """True if the target is a recording, whose true parameters are unknown."""
        return "real" in self.experiment.ranges

    @property
    def ranges(self) -> list[str]:
        """Ranges that have runs, in the experiment's order."""
        return [kind for kind in self.experiment.ranges if kind in self.statistics.target_counts]

    @cached_property
    def style(self) -> TunerStyles:
        """Styles of the tuners, and their order by the deciding error."""
        return style_of(self.experiment, self.statistics)

    def get_tuner_styles(self, tuners: Iterable[str]) -> list[tuple[str, MarkStyle]]:
        """Return the tuners of a column, best first, each with its style."""
        present_tuners = set(tuners)
        return [
            (name, self.style.get_mark_style(name))
            for name in self.style.order
            if name in present_tuners
        ]

    @property
    def levels(self) -> list[float]:
        """Error thresholds with costs, beginning with the one of printed figures."""
        first = self.statistics.reference_level
        return [first, *(level for level in self.statistics.tuning_costs if level != first)]

    @property
    def shown_metric(self) -> str:
        """The deciding error; for a single parameter in its own unit."""
        metric = self.statistics.metric
        return self.statistics.parameter_error_metric if metric == "param_error" else metric

    @property
    def unit_of_levels(self) -> str:
        """Unit of the error thresholds, with brackets; empty for that of the error."""
        in_widths = self.statistics.metric in ("param_error", "stiff_error")
        return " [training widths]" if in_widths else ""

    def format_metric_label(self, metric: str) -> str:
        """Return the axis label of an error.

        Errors along stiff directions are those of parameter combinations that the data determine,
        sloppy ones those of the others.
        """
        channel, parameter = self.labels
        return {
            "param_abs_error": (
                f"absolute error of {parameter}"
                if parameter
                else "mean parameter error [training widths]"
            ),
            "param_error": "mean parameter error [training widths]",
            "stiff_error": "error along stiff directions [training widths]",
            "sloppy_error": "error along sloppy directions [training widths]",
            "obs_error": f"RMSE of {channel}" + (", runs tuned on" if self.is_recording else ""),
            "heldout_error": f"RMSE of {channel}, "
            + ("held-out runs" if self.is_recording else "unseen scenarios"),
        }[metric]
