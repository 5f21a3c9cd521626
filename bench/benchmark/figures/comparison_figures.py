"""Draw the figures of one comparison by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from bench.benchmark.figures import error_figures, identifiability_figures, runtime_figures
from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics
from bench.benchmark.storage.result_folder import StoredComparison
from bench.figures.style import REFERENCE_GREYS, add_trust_note, style_of
from sims.core.simulator import InputError, make_unknown_name_error

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from bench.benchmark.storage.reference_results import ReferenceResult

FIGURE_FILES: Mapping[str, str] = {
    "error": "error-vs-simulations",
    "misfit": "misfit-vs-simulations",
    "distance": "error-vs-distance",
    "runtime": "runtime-distribution",
    "cost": "who-wins-at-which-cost",
    "amortisation": "amortisation",
    "spectra": "identifiability",
    "directions": "stiff-sloppy-prediction",
}
"""File name of every figure by its name, in the order in which they are written."""

OVERLAYABLE_FIGURES = ("error", "misfit", "directions")
"""Figures of errors against simulations, which can show references in grey."""


class AxisLabels(NamedTuple):
    """Axis labels of a comparison.

    Attributes:
        channel: Error channel with unit, e.g. ``q [rad]``.
        parameter: Name of the parameter, e.g. ``restitution``; empty for several parameters.
    """

    channel: str
    parameter: str


def make_axis_labels(problem: TuningProblem) -> AxisLabels:
    """Make the axis labels for a comparison's problem."""
    channel = problem.channels[problem.error_channel]
    parameters = problem.cube.parameters
    parameter = ""
    if len(parameters) == 1:
        unit = parameters[0].unit
        parameter = parameters[0].name + (f" [{unit}]" if unit != "1" else "")
    return AxisLabels(f"{channel.name} [{channel.unit}]", parameter)


def compute_statistics(stored: StoredComparison) -> ComparisonStatistics:
    """Compute the statistics for tables and figures; needs at least one run."""
    return ComparisonStatistics(stored.experiment, stored.runs, stored.statuses, stored.costs)


def list_figure_names(stored: StoredComparison) -> list[str]:
    """List the names of the figures that a comparison's data allow; empty without a run."""
    experiment, runs = stored.experiment, stored.runs
    if runs.empty:
        return []
    wide = "wide" in experiment.ranges
    allowed = {
        "error": True,
        # Without a true system other than the simulator, the misfit is only the sensor noise.
        "misfit": bool(experiment.world),
        "distance": wide and bool(runs.loc[runs["range"] == "wide", "outside"].gt(0).any()),
        "runtime": True,
        "cost": True,
        "amortisation": any(simulations for simulations, _ in stored.costs.values()),
        "spectra": stored.spectra is not None,
        "directions": bool(identifiability_figures.list_directional_metrics(experiment, runs)),
    }
    return [name for name in FIGURE_FILES if allowed[name]]


def draw_figure(
    stored: StoredComparison,
    labels: AxisLabels,
    name: str,
    statistics: ComparisonStatistics | None = None,
    behind: Sequence[ReferenceResult] = (),
) -> Figure:
    """Draw one figure of a comparison.

    Args:
        stored: The comparison, as read by `bench.benchmark.storage.result_folder.read_comparison`.
        labels: Axis labels, see `make_axis_labels`.
        name: One of `names(stored)`.
        statistics: Result of `statistics_of(stored)`, to share it between several figures.
        behind: Reference results that are drawn in grey, if the figure is one of
            `OVERLAYABLE_FIGURES`.

    Raises:
        InputError: The comparison has no figure of that name, or a reference cannot be drawn.
    """
    if name not in (known := list_figure_names(stored)):
        raise make_unknown_name_error("figure", name, known)
    if behind:
        check_references_allowed(stored, name, behind)
    return add_trust_note(
        _figure(stored, labels, name, statistics, behind), stored.experiment.trusted
    )


def check_references_allowed(
    stored: StoredComparison, name: str, behind: Sequence[ReferenceResult]
) -> None:
    """Reject references that cannot be drawn in a figure.

    Args:
        stored: The comparison.
        name: Name of the figure.
        behind: Reference results.

    Raises:
        InputError: They are of another problem, there are too many, or the figure shows no errors
            against simulations.
    """
    if name not in OVERLAYABLE_FIGURES:
        raise InputError(
            f"figure {name}: expected one of {', '.join(OVERLAYABLE_FIGURES)} before a reference"
        )
    if len(behind) > len(REFERENCE_GREYS):
        raise InputError(f"expected {len(REFERENCE_GREYS)} references at most, found {len(behind)}")
    for reference in behind:
        reference.find_mismatches(stored.experiment)


def _figure(
    stored: StoredComparison,
    labels: AxisLabels,
    name: str,
    statistics: ComparisonStatistics | None,
    behind: Sequence[ReferenceResult],
) -> Figure:
    experiment = stored.experiment
    if name == "spectra":
        assert stored.spectra is not None
        return identifiability_figures.draw_spectra_figure(experiment, stored.spectra)
    numbers = statistics or compute_statistics(stored)
    if name == "error":
        return error_figures.draw_error_figure(experiment, numbers, *labels, behind)
    if name == "misfit":
        return error_figures.draw_misfit_figure(experiment, numbers, labels.channel, behind)
    if name == "distance":
        return error_figures.draw_distance_figure(experiment, numbers, labels.parameter)
    if name == "directions":
        return identifiability_figures.draw_directions_figure(
            experiment, numbers, labels.channel, behind
        )
    return _of_effort(experiment, name, numbers)


def _of_effort(experiment: Experiment, name: str, statistics: ComparisonStatistics) -> Figure:
    style = style_of(experiment, statistics)
    if name == "runtime":
        return runtime_figures.draw_runtime_figure(experiment, style, statistics)
    # Tables contain every level; a figure shows the most informative one.
    level = statistics.reference_level
    draw = (
        runtime_figures.draw_cost_figure
        if name == "cost"
        else runtime_figures.draw_amortisation_figure
    )
    return draw(experiment, style, statistics.tuning_costs[level], level)
