"""Draw errors against the number of simulations and against distance from training.

The distance is that of the target from the training range. Bands and bars are 95 % bootstrap
intervals of the median over targets.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd

from bench.analysis.medians import bin_names, moments
from bench.analysis.rounding import FLOOR
from bench.analysis.statistics import Statistics
from bench.analysis.table import checkpoints
from bench.figures.style import (
    SHADE,
    SOFT,
    TITLES,
    Styles,
    behind_id,
    canvas,
    finish,
    style_of,
    titled,
)
from bench.problem.experiment import Experiment

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bench.store.reference import Reference


def error_figure(
    experiment: Experiment,
    statistics: Statistics,
    channel: str,
    parameter: str,
    behind: Sequence[Reference] = (),
) -> Figure:
    """Draw the error against simulations.

    There is one panel per range; for a recording, one for held-out runs and one for the runs used
    for tuning.

    Args:
        experiment: The experiment.
        statistics: Its statistics.
        channel: Error channel with unit, e.g. ``q [rad]``.
        parameter: Parameter with unit if there is one; empty for several.
        behind: Reference results that are drawn in grey.
    """
    shown = panels(experiment, statistics, channel, parameter)
    figure, axes = canvas(len(shown))
    drawn = [(panel.metric, panel.kind) for panel in shown]
    style = style_of(experiment, statistics, behind, drawn)
    what = "starts" if "real" in experiment.ranges else "targets"
    for axis, panel in zip(axes, shown, strict=True):
        samples_panel(axis, statistics, panel.metric, panel.kind, style)
        titled(axis, f"{panel.title} ({statistics.targets[panel.kind]} {what})")
        axis.set_ylabel(f"{panel.label}, median")
    for axis, panel in zip(axes, shown, strict=True):
        shade_equal(axis, statistics.floor_of(panel.metric))
    finish(figure, axes, style, experiment)
    return figure


class Shown(NamedTuple):
    """Content of one panel of `error_figure`: a metric in a range, with title and label."""

    metric: str
    kind: str
    title: str
    label: str


def panels(
    experiment: Experiment, statistics: Statistics, channel: str, parameter: str
) -> list[Shown]:
    """List the panels of `error_figure`.

    Args:
        experiment: The experiment.
        statistics: Its statistics.
        channel: Error channel with unit, e.g. ``q [rad]``.
        parameter: Parameter with unit if there is one; empty for several.
    """
    runs = statistics.all_runs
    # The true parameters of a recording are unknown, so its error on held-out runs is shown.
    if "real" in experiment.ranges:
        metrics = [m for m in ("heldout_error", "obs_error") if runs[m].notna().any()]
        return [Shown(m, "real", TITLES[m], f"RMSE of {channel}") for m in metrics]
    metric, label = statistics.parameter_metric, parameter_label(parameter)
    return [Shown(metric, r, TITLES[r], label) for r in ranges(experiment, runs)]


def misfit_figure(
    experiment: Experiment, statistics: Statistics, channel: str, behind: Sequence[Reference] = ()
) -> Figure:
    """Draw the misfit against simulations, if the targets come from another simulator.

    Its floor is the model error that no parameter removes.

    Args:
        experiment: The experiment.
        statistics: Its statistics.
        channel: Error channel with unit, e.g. ``q [rad]``.
        behind: Reference results that are drawn in grey.
    """
    kinds = ranges(experiment, statistics.all_runs)
    figure, axes = canvas(len(kinds))
    drawn = [("obs_error", kind) for kind in kinds]
    style = style_of(experiment, statistics, behind, drawn)
    for axis, kind in zip(axes, kinds, strict=True):
        part = statistics.of(kind)
        samples_panel(axis, statistics, "obs_error", kind, style)
        floor = least_misfit(part)
        axis.axhline(floor, color=SOFT, linewidth=0.8, linestyle=(0, (2, 2)))
        _label_below(axis, floor, f"least that any tuner reached: {floor:.2g} (median)")
        titled(axis, f"{TITLES[kind]} ({statistics.targets[kind]} targets)")
        axis.set_ylabel(f"RMSE of {channel}, median")
    finish(figure, axes, style, experiment)
    return figure


def least_misfit(runs: pd.DataFrame) -> float:
    """Compute the smallest observation error that any tuner reached, median over targets.

    The smallest possible error is unknown; this is an upper bound of it.
    """
    return float(runs.groupby("target")["obs_error"].min().median())


def samples_panel(
    axis: Axes, statistics: Statistics, metric: str, kind: str, style: Styles
) -> None:
    """Draw each tuner's median of a metric against simulations with its interval.

    Args:
        axis: Axes to draw on.
        statistics: Statistics of the comparison.
        metric: Name of the metric.
        kind: Range of the targets.
        style: Styles of the tuners; its references are drawn in grey.
    """
    medians, budget = statistics.medians(metric, kind), style.experiment.budget
    for tuner, line in medians.groupby("tuner", sort=False):
        look, points = style.of(str(tuner)), line["simulations"].to_numpy()
        # Markers only where tables have numbers; the line goes through all points.
        marks = np.flatnonzero(np.isin(points, checkpoints(budget))).tolist()
        axis.plot(points, line["median"], markevery=marks, markersize=4.5, **look)
        band = {"color": look["color"], "alpha": 0.13, "linewidth": 0}
        axis.fill_between(points, line["low"], line["high"], **band)
    for reference in style.behind:
        _grey_lines(axis, reference, kind, metric, budget, style)
    axis.set_yscale("log")
    simulations_axis(axis, budget)


def _label_below(axis: Axes, level: float, text: str) -> None:
    """Write a text below a horizontal level, at the left end of the axis."""
    axis.annotate(text, (0, level), xytext=(4, -10), textcoords="offset points", fontsize=7.5)


def shade_equal(axis: Axes, floor: float | None) -> None:
    """Shade the errors that count as equal, if some are visible.

    Args:
        axis: Axes of a figure whose panels are all drawn, since their limits are fixed here.
        floor: Result of `bench.analysis.statistics.Statistics.floor_of`.
    """
    low, high = axis.get_ylim()
    if floor is None or not low < floor < high:
        return
    axis.axhspan(low, floor, color=SHADE, linewidth=0, zorder=0)
    _label_below(axis, floor, f"below {floor:.2g}: count as equal")
    axis.set_ylim(low, high)


def _grey_lines(
    axis: Axes, reference: Reference, kind: str, metric: str, budget: int, style: Styles
) -> None:
    """Draw each tuner's median of a reference, at the simulation counts of its table."""
    for tuner in reference.tuners:
        curve = reference.curve(tuner, kind, metric, budget)
        if len(curve):
            medians = np.maximum(curve["median"].to_numpy(dtype=np.float64), FLOOR)
            name, look = behind_id(reference, tuner), style.grey(reference, tuner)
            axis.plot(curve["simulations"], medians, gid=name, **look)


def simulations_axis(axis: Axes, budget: int) -> None:
    """Scale the horizontal axis for simulations: logarithmic, but linear from 0 to 1."""
    ticks = checkpoints(budget)
    axis.set_xscale("symlog", linthresh=1, linscale=0.5)
    axis.set_xticks(ticks, [str(k) for k in ticks])
    axis.set_xlim(-0.08, budget * 1.1)
    axis.minorticks_off()
    axis.set_xlabel("simulations used on the target")


def distance_figure(experiment: Experiment, statistics: Statistics, parameter: str) -> Figure:
    """Draw the median error at several simulation counts by the target's distance from training.

    Args:
        experiment: The experiment.
        statistics: Its statistics.
        parameter: Parameter with unit if there is one; empty for several.
    """
    table = statistics.distances
    shown = moments(experiment.budget)
    figure, axes = canvas(len(shown))
    style = style_of(experiment, statistics)
    for axis, k in zip(axes, shown, strict=True):
        for tuner, line in table[table["simulations"] == k].groupby("tuner", sort=False):
            _distance_line(axis, line, str(tuner), style)
        axis.set_xticks(range(len(bin_names(table))), bin_names(table), fontsize=7)
        axis.set_xlim(-0.5, len(bin_names(table)) - 0.5)
        axis.set_yscale("log")
        titled(axis, f"After {k} simulations")
        axis.set_xlabel(
            "distance of the target from the training range,\nin widths of that range; n targets"
        )
        axis.set_ylabel(f"{parameter_label(parameter)}, median")
    finish(figure, axes, style, experiment)
    return figure


def _distance_line(axis: Axes, line: pd.DataFrame, tuner: str, style: Styles) -> None:
    middle = line["median"].to_numpy()
    bars = np.array([middle - line["low"], line["high"] - middle])
    # A single target has no interval. By rounding, a percentile interval may not contain the
    # median; error bars must not be negative.
    lengths = np.maximum(np.nan_to_num(bars), 0.0)
    places = line["bin"].to_numpy() + style.offset(tuner)
    look = style.of(tuner)
    axis.errorbar(places, middle, yerr=lengths, markersize=4.5, elinewidth=0.8, capsize=1.5, **look)


def ranges(experiment: Experiment, runs: pd.DataFrame) -> list[str]:
    """List the experiment's ranges that have runs."""
    return [r for r in experiment.ranges if (runs["range"] == r).any()]


def parameter_label(parameter: str) -> str:
    """Return the axis label for the error of parameters.

    Args:
        parameter: Parameter with unit if there is one; empty for several.
    """
    if parameter:
        return f"absolute error of {parameter}"
    return "mean parameter error [training widths]"
