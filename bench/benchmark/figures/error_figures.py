"""Draw errors against the number of simulations and against distance from training.

The distance is that of the target from the training range. Bands and bars are 95 % bootstrap
intervals of the median over targets.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics
from bench.benchmark.statistics.error_floor import ERROR_FLOOR
from bench.benchmark.statistics.error_table import select_checkpoints
from bench.benchmark.statistics.median_curves import format_bin_labels, select_distance_checkpoints
from bench.figures.style import (
    CAPTION_GREY,
    PANEL_TITLES,
    RECORDED_PART_GREY,
    TunerStyles,
    finish_figure,
    make_panel_row,
    make_reference_id,
    set_title,
    style_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bench.benchmark.storage.reference_results import ReferenceResult


def draw_error_figure(
    experiment: Experiment,
    statistics: ComparisonStatistics,
    channel: str,
    parameter: str,
    behind: Sequence[ReferenceResult] = (),
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
    shown = list_error_panels(experiment, statistics, channel, parameter)
    figure, axes = make_panel_row(len(shown))
    drawn = [(panel.metric, panel.kind) for panel in shown]
    style = style_of(experiment, statistics, behind, drawn)
    what = "starts" if "real" in experiment.ranges else "targets"
    for axis, panel in zip(axes, shown, strict=True):
        draw_error_panel(axis, statistics, panel.metric, panel.kind, style)
        set_title(axis, f"{panel.title} ({statistics.target_counts[panel.kind]} {what})")
        axis.set_ylabel(f"{panel.label}, median")
    for axis, panel in zip(axes, shown, strict=True):
        shade_equal(axis, statistics.floor_of(panel.metric))
    finish_figure(figure, axes, style, experiment)
    return figure


class ErrorPanel(NamedTuple):
    """Content of one panel of `draw_error_figure`: a metric in a range, with title and label."""

    metric: str
    kind: str
    title: str
    label: str


def list_error_panels(
    experiment: Experiment, statistics: ComparisonStatistics, channel: str, parameter: str
) -> list[ErrorPanel]:
    """List the panels of `draw_error_figure`.

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
        return [ErrorPanel(m, "real", PANEL_TITLES[m], f"RMSE of {channel}") for m in metrics]
    metric, label = statistics.parameter_error_metric, format_parameter_label(parameter)
    return [
        ErrorPanel(metric, r, PANEL_TITLES[r], label) for r in list_present_ranges(experiment, runs)
    ]


def draw_misfit_figure(
    experiment: Experiment,
    statistics: ComparisonStatistics,
    channel: str,
    behind: Sequence[ReferenceResult] = (),
) -> Figure:
    """Draw the misfit against simulations, if the targets come from another simulator.

    Its floor is the model error that no parameter removes.

    Args:
        experiment: The experiment.
        statistics: Its statistics.
        channel: Error channel with unit, e.g. ``q [rad]``.
        behind: Reference results that are drawn in grey.
    """
    kinds = list_present_ranges(experiment, statistics.all_runs)
    figure, axes = make_panel_row(len(kinds))
    drawn = [("obs_error", kind) for kind in kinds]
    style = style_of(experiment, statistics, behind, drawn)
    for axis, kind in zip(axes, kinds, strict=True):
        part = statistics.select_range(kind)
        draw_error_panel(axis, statistics, "obs_error", kind, style)
        floor = compute_min_misfit(part)
        axis.axhline(floor, color=CAPTION_GREY, linewidth=0.8, linestyle=(0, (2, 2)))
        _label_below(axis, floor, f"least that any tuner reached: {floor:.2g} (median)")
        set_title(axis, f"{PANEL_TITLES[kind]} ({statistics.target_counts[kind]} targets)")
        axis.set_ylabel(f"RMSE of {channel}, median")
    finish_figure(figure, axes, style, experiment)
    return figure


def compute_min_misfit(runs: pd.DataFrame) -> float:
    """Compute the smallest observation error that any tuner reached, median over targets.

    The smallest possible error is unknown; this is an upper bound of it.
    """
    return float(runs.groupby("target")["obs_error"].min().median())


def draw_error_panel(
    axis: Axes, statistics: ComparisonStatistics, metric: str, kind: str, style: TunerStyles
) -> None:
    """Draw each tuner's median of a metric against simulations with its interval.

    Args:
        axis: Axes to draw on.
        statistics: Statistics of the comparison.
        metric: Name of the metric.
        kind: Range of the targets.
        style: Styles of the tuners; its references are drawn in grey.
    """
    medians, budget = statistics.compute_median_curves(metric, kind), style.experiment.budget
    for tuner, line in medians.groupby("tuner", sort=False):
        look, points = style.get_plot_style(str(tuner)), line["simulations"].to_numpy()
        # Markers only where tables have numbers; the line goes through all points.
        marks = np.flatnonzero(np.isin(points, select_checkpoints(budget))).tolist()
        axis.plot(points, line["median"], markevery=marks, markersize=4.5, **look)
        band = {"color": look["color"], "alpha": 0.13, "linewidth": 0}
        axis.fill_between(points, line["low"], line["high"], **band)
    for reference in style.behind:
        _draw_reference_lines(axis, reference, kind, metric, budget, style)
    axis.set_yscale("log")
    format_simulations_axis(axis, budget)


def _label_below(axis: Axes, level: float, text: str) -> None:
    """Write a text below a horizontal level, at the left end of the axis."""
    axis.annotate(text, (0, level), xytext=(4, -10), textcoords="offset points", fontsize=7.5)


def shade_equal(axis: Axes, floor: float | None) -> None:
    """Shade the errors that count as equal, if some are visible.

    Args:
        axis: Axes of a figure whose panels are all drawn, since their limits are fixed here.
        floor: Result of `ComparisonStatistics.floor_of`.
    """
    low, high = axis.get_ylim()
    if floor is None or not low < floor < high:
        return
    axis.axhspan(low, floor, color=RECORDED_PART_GREY, linewidth=0, zorder=0)
    _label_below(axis, floor, f"below {floor:.2g}: count as equal")
    axis.set_ylim(low, high)


def _draw_reference_lines(
    axis: Axes, reference: ReferenceResult, kind: str, metric: str, budget: int, style: TunerStyles
) -> None:
    """Draw each tuner's median of a reference, at the simulation counts of its table."""
    for tuner in reference.tuners:
        curve = reference.get_curve(tuner, kind, metric, budget)
        if len(curve):
            medians = np.maximum(curve["median"].to_numpy(dtype=np.float64), ERROR_FLOOR)
            name, look = (
                make_reference_id(reference, tuner),
                style.get_reference_style(reference, tuner),
            )
            axis.plot(curve["simulations"], medians, gid=name, **look)


def format_simulations_axis(axis: Axes, budget: int) -> None:
    """Scale the horizontal axis for simulations: logarithmic, but linear from 0 to 1."""
    ticks = select_checkpoints(budget)
    axis.set_xscale("symlog", linthresh=1, linscale=0.5)
    axis.set_xticks(ticks, [str(k) for k in ticks])
    axis.set_xlim(-0.08, budget * 1.1)
    axis.minorticks_off()
    axis.set_xlabel("simulations used on the target")


def draw_distance_figure(
    experiment: Experiment, statistics: ComparisonStatistics, parameter: str
) -> Figure:
    """Draw the median error at several simulation counts by the target's distance from training.

    Args:
        experiment: The experiment.
        statistics: Its statistics.
        parameter: Parameter with unit if there is one; empty for several.
    """
    table = statistics.medians_by_distance
    shown = select_distance_checkpoints(experiment.budget)
    figure, axes = make_panel_row(len(shown))
    style = style_of(experiment, statistics)
    for axis, k in zip(axes, shown, strict=True):
        for tuner, line in table[table["simulations"] == k].groupby("tuner", sort=False):
            _distance_line(axis, line, str(tuner), style)
        axis.set_xticks(range(len(format_bin_labels(table))), format_bin_labels(table), fontsize=7)
        axis.set_xlim(-0.5, len(format_bin_labels(table)) - 0.5)
        axis.set_yscale("log")
        set_title(axis, f"After {k} simulations")
        axis.set_xlabel(
            "distance of the target from the training range,\nin widths of that range; n targets"
        )
        axis.set_ylabel(f"{format_parameter_label(parameter)}, median")
    finish_figure(figure, axes, style, experiment)
    return figure


def _distance_line(axis: Axes, line: pd.DataFrame, tuner: str, style: TunerStyles) -> None:
    middle = line["median"].to_numpy()
    bars = np.array([middle - line["low"], line["high"] - middle])
    # A single target has no interval. By rounding, a percentile interval may not contain the
    # median; error bars must not be negative.
    lengths = np.maximum(np.nan_to_num(bars), 0.0)
    places = line["bin"].to_numpy() + style.get_category_offset(tuner)
    look = style.get_plot_style(tuner)
    axis.errorbar(places, middle, yerr=lengths, markersize=4.5, elinewidth=0.8, capsize=1.5, **look)


def list_present_ranges(experiment: Experiment, runs: pd.DataFrame) -> list[str]:
    """List the experiment's ranges that have runs."""
    return [r for r in experiment.ranges if (runs["range"] == r).any()]


def format_parameter_label(parameter: str) -> str:
    """Return the axis label for the error of parameters.

    Args:
        parameter: Parameter with unit if there is one; empty for several.
    """
    if parameter:
        return f"absolute error of {parameter}"
    return "mean parameter error [training widths]"
