"""Draw the figures of one comparison by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from bench.analysis.statistics import Statistics
from bench.figures import errors, identifiability, runtimes
from bench.figures.style import BEHIND, mark, style_of
from bench.problem.experiment import Experiment
from bench.problem.problem import Problem
from bench.store.folder import Stored
from sims.base import InputError, unknown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from bench.store.reference import Reference

FILES: Mapping[str, str] = {
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

FRONT = ("error", "misfit", "directions")
"""Figures of errors against simulations, which can show references in grey."""


class Labels(NamedTuple):
    """Axis labels of a comparison.

    Attributes:
        channel: Error channel with unit, e.g. ``q [rad]``.
        parameter: Name of the parameter, e.g. ``restitution``; empty for several parameters.
    """

    channel: str
    parameter: str


def labels_of(problem: Problem) -> Labels:
    """Make the axis labels for a comparison's problem."""
    channel = problem.channels[problem.error_channel]
    parameters = problem.cube.parameters
    parameter = ""
    if len(parameters) == 1:
        unit = parameters[0].unit
        parameter = parameters[0].name + (f" [{unit}]" if unit != "1" else "")
    return Labels(f"{channel.name} [{channel.unit}]", parameter)


def statistics_of(stored: Stored) -> Statistics:
    """Compute the statistics for tables and figures; needs at least one run."""
    return Statistics(stored.experiment, stored.runs, stored.statuses, stored.costs)


def names(stored: Stored) -> list[str]:
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
        "directions": bool(identifiability.directional(experiment, runs)),
    }
    return [name for name in FILES if allowed[name]]


def figure(
    stored: Stored,
    labels: Labels,
    name: str,
    statistics: Statistics | None = None,
    behind: Sequence[Reference] = (),
) -> Figure:
    """Draw one figure of a comparison.

    Args:
        stored: The comparison, as read by `bench.store.folder.read`.
        labels: Axis labels, see `labels_of`.
        name: One of `names(stored)`.
        statistics: Result of `statistics_of(stored)`, to share it between several figures.
        behind: Reference results that are drawn in grey, if the figure is one of `FRONT`.

    Raises:
        InputError: The comparison has no figure of that name, or a reference cannot be drawn.
    """
    if name not in (known := names(stored)):
        raise unknown("figure", name, known)
    if behind:
        refuse_behind(stored, name, behind)
    return mark(_figure(stored, labels, name, statistics, behind), stored.experiment.trusted)


def refuse_behind(stored: Stored, name: str, behind: Sequence[Reference]) -> None:
    """Reject references that cannot be drawn in a figure.

    Args:
        stored: The comparison.
        name: Name of the figure.
        behind: Reference results.

    Raises:
        InputError: They are of another problem, there are too many, or the figure shows no errors
            against simulations.
    """
    if name not in FRONT:
        raise InputError(f"figure {name}: expected one of {', '.join(FRONT)} before a reference")
    if len(behind) > len(BEHIND):
        raise InputError(f"expected {len(BEHIND)} references at most, found {len(behind)}")
    for reference in behind:
        reference.mismatches(stored.experiment)


def _figure(
    stored: Stored,
    labels: Labels,
    name: str,
    statistics: Statistics | None,
    behind: Sequence[Reference],
) -> Figure:
    experiment = stored.experiment
    if name == "spectra":
        assert stored.spectra is not None
        return identifiability.spectra_figure(experiment, stored.spectra)
    numbers = statistics or statistics_of(stored)
    if name == "error":
        return errors.error_figure(experiment, numbers, *labels, behind)
    if name == "misfit":
        return errors.misfit_figure(experiment, numbers, labels.channel, behind)
    if name == "distance":
        return errors.distance_figure(experiment, numbers, labels.parameter)
    if name == "directions":
        return identifiability.directions_figure(experiment, numbers, labels.channel, behind)
    return _of_effort(experiment, name, numbers)


def _of_effort(experiment: Experiment, name: str, statistics: Statistics) -> Figure:
    style = style_of(experiment, statistics)
    if name == "runtime":
        return runtimes.runtime_figure(experiment, style, statistics)
    # Tables contain every level; a figure shows the most informative one.
    level = statistics.level
    draw = runtimes.cost_figure if name == "cost" else runtimes.amortisation_figure
    return draw(experiment, style, statistics.prices[level], level)
