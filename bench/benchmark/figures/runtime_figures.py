"""Draw runtime distributions, amortised training cost, cost of winning, and mean ranks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bench.benchmark.figures.error_figures import format_simulations_axis
from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics
from bench.benchmark.statistics.error_table import select_checkpoints
from bench.benchmark.statistics.training_amortisation import (
    AT_ONCE,
    NEVER,
    TARGETS_PER_TRAINING,
    TuningCost,
    build_break_even_table,
    build_time_per_target_table,
    find_cheapest_tuners,
    placed_even,
)
from bench.figures.style import (
    NEUTRAL_MARK,
    PANEL_TITLES,
    RECORDED_PART_GREY,
    TunerStyles,
    finish_figure,
    get_colour,
    make_panel_grid,
    make_panel_row,
    set_title,
    style_axis,
)
from sims.core.simulator import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TuningCosts = Mapping[str, Mapping[str, TuningCost]]
"""Cost of reaching a threshold, by range of targets and tuner."""
_WIDE = 30.0
"""Minimum ratio of the simulation costs over which a tuner wins for writing its name."""


def draw_runtime_figure(
    experiment: Experiment, style: TunerStyles, statistics: ComparisonStatistics
) -> Figure:
    """Draw the share of (run, threshold) pairs that are reached, against simulations.

    Args:
        experiment: The experiment.
        style: Styles of its tuners.
        statistics: Its statistics.
    """
    spread, table = statistics.spread, statistics.runtime_distribution
    ranges = list(dict.fromkeys(table["range"]))
    figure, axes = make_panel_row(len(ranges))
    budget = int(table["simulations"].max())
    for axis, kind in zip(axes, ranges, strict=True):
        for tuner, line in table[table["range"] == kind].groupby("tuner", sort=False):
            points = line["simulations"].to_numpy()
            marks = np.flatnonzero(np.isin(points, select_checkpoints(budget))).tolist()
            # Steps, not slopes: no threshold is reached between two simulations.
            look = style.get_plot_style(str(tuner))
            axis.step(points, line["share"], where="post", markevery=marks, markersize=4.5, **look)
        format_simulations_axis(axis, budget)
        axis.set_ylim(-0.02, 1.02)
        axis.set_ylabel("share of (run, threshold) pairs reached for good")
        targets = statistics.curves.select(range=str(kind)).keys["target"].nunique()
        set_title(axis, f"{PANEL_TITLES[str(kind)]} ({targets} targets)")
    finish_figure(figure, axes, style, experiment, format_threshold_caption(spread))
    return figure


def format_threshold_caption(spread: Array) -> str:
    """Return a caption that explains a runtime distribution over these thresholds."""
    span = f"from {spread[0]:.2g} to {spread[-1]:.2g} on a logarithmic scale"
    return (
        f"{len(spread)} thresholds {span}. "
        "Reached: the recommendation's error stays at or below it from there on. "
        "A failed run reaches none."
    )


def draw_amortisation_figure(
    experiment: Experiment, style: TunerStyles, prices: TuningCosts, level: float
) -> Figure:
    """Draw from which number of targets on each training pays, against each searching tuner.

    Args:
        experiment: The experiment.
        style: Styles of its tuners.
        prices: Cost of reaching `level`.
        level: Threshold of the deciding metric.
    """
    searching, learning = break_even_sides(prices, style)
    row = max(0.42, 0.14 * len(learning))  # Inches.
    size = (2.8 + 3.9 * len(prices), 1.7 + row * max(len(searching), 3))
    figure, grid = make_panel_grid(1, len(prices), size, sharey=True)
    axes = list(grid[0])
    for axis, (kind, by_tuner) in zip(axes, prices.items(), strict=True):
        style_axis(axis)
        table = placed_even(build_break_even_table(experiment.name, kind, level, by_tuner))
        for place, tuner in enumerate(learning):
            shift = 0.6 * ((place + 0.5) / len(learning) - 0.5)
            _break_even(
                axis,
                table[table["learned"] == tuner],
                searching,
                shift,
                style.get_plot_style(tuner),
            )
        for edge, end in ((AT_ONCE * 10**0.25, 0.1), (NEVER / 10**0.25, 1e5)):
            axis.axvspan(edge, end, color=RECORDED_PART_GREY, linewidth=0, zorder=0)
        axis.set_xscale("log")
        axis.set_xlim(0.1, 1e5)
        ticks = {AT_ONCE: "at\nonce", 1: "1", 10: "10", 100: "100", 1e3: "1000", NEVER: "never"}
        axis.set_xticks(list(ticks), list(ticks.values()), fontsize=8)
        axis.minorticks_off()
        axis.set_xlabel("training pays from this number of targets on")
        set_title(axis, PANEL_TITLES[kind])
    axes[0].set_yticks(range(len(searching)), searching)
    axes[0].set_ylabel("instead of")
    axes[0].set_ylim(len(searching) - 0.5, -0.5)
    caption = (
        f"To reach an error of {level:.2g} for good. A mark: from this number of targets on, the "
        "training and the expected simulations (ERT) of the trained tuner are fewer than those of "
        "the tuner that searches. At once: the search never reaches the error. Never: not within "
        "10 000 targets. Bar: 95 % bootstrap interval over targets."
    )
    finish_figure(figure, axes, style, experiment, caption, "trained tuner")
    return figure


def break_even_sides(prices: TuningCosts, style: TunerStyles) -> tuple[list[str], list[str]]:
    """List the searching tuners, and the trained ones that reach the error in some range.

    Args:
        prices: Cost of reaching the error.
        style: Styles of the tuners.

    Returns:
        Two lists, each in the order of the ranking.
    """
    found: dict[str, list[TuningCost]] = {}
    for by_tuner in prices.values():
        for tuner, price in by_tuner.items():
            found.setdefault(tuner, []).append(price)
    order = [tuner for tuner in style.order if tuner in found]
    learning = [t for t in order if any(price.fit_simulations for price in found[t])]
    reaching = [t for t in learning if any(np.isfinite(p.effort.compute_ert()) for p in found[t])]
    return [t for t in order if t not in learning], reaching


def _break_even(
    axis: Axes, table: pd.DataFrame, searching: Sequence[str], shift: float, look: dict[str, Any]
) -> None:
    """Draw one trained tuner's marker and interval in the row of each searching tuner."""
    rows = np.array([searching.index(str(t)) for t in table["search"]]) + shift
    middle = table["targets"].to_numpy()
    ends = np.array([middle - table["low"], table["high"] - middle])
    mark = {**look, "linestyle": "none", "markersize": 5.0}
    axis.errorbar(middle, rows, xerr=np.maximum(ends, 0.0), elinewidth=1.0, capsize=2.0, **mark)


def draw_cost_figure(
    experiment: Experiment, style: TunerStyles, prices: TuningCosts, level: float
) -> Figure:
    """Draw seconds per target against the cost of a simulation.

    A strip below names the tuner that needs the least time.

    Args:
        experiment: The experiment.
        style: Styles of its tuners.
        prices: Cost of reaching `level`.
        level: Threshold of the deciding metric.
    """
    figure, axes = make_panel_row(len(prices))
    table = build_time_per_target_table(prices)
    for axis, (kind, by_tuner) in zip(axes, prices.items(), strict=True):
        for tuner, line in table[table["range"] == kind].groupby("tuner", sort=False):
            across, up = line["simulation_seconds"], line["seconds"]
            axis.plot(across, up, markevery=20, markersize=4.5, **style.get_plot_style(str(tuner)))
        axis.set_xscale("log")
        axis.set_yscale("log")
        _draw_winner_strip(axis, by_tuner, style)
        axis.set_xlabel("seconds that one simulation takes")
        axis.set_ylabel("seconds for one target")
        set_title(axis, PANEL_TITLES[kind])
    caption = (
        f"To reach an error of {level:.2g} for good: ERT × seconds of a simulation + seconds of "
        f"the tuner as measured; training shared by {TARGETS_PER_TRAINING} targets. "
        "The strip names who needs least."
    )
    finish_figure(figure, axes, style, experiment, caption)
    return figure


def _draw_winner_strip(axis: Axes, prices: Mapping[str, TuningCost], style: TunerStyles) -> None:
    """Draw the tuner with the least time at each cost as a coloured strip at the bottom."""
    for low, high, tuner in find_cheapest_tuners(prices, TARGETS_PER_TRAINING):
        colour = style.get_plot_style(tuner)["color"]
        axis.axvspan(low, high, ymin=0.0, ymax=0.035, color=colour, linewidth=0)
        # In the middle of its part, on a logarithmic scale.
        if high / low > _WIDE:
            axis.annotate(
                tuner,
                (np.sqrt(low * high), 0.045),
                xycoords=("data", "axes fraction"),
                ha="center",
                fontsize=7.5,
            )


def draw_critical_difference_figure(
    ranked: pd.DataFrame, p_values: pd.DataFrame, friedman: float
) -> Figure:
    """Draw the critical-difference diagram: mean ranks over problems.

    Bars join tuners that do not differ significantly at 5 %.

    Args:
        ranked: Ranks, one row per problem, one column per tuner.
        p_values: P-values of Nemenyi's test of each pair of tuners.
        friedman: P-value of Friedman's test.
    """
    from scikit_posthocs import critical_difference_diagram

    figure, axes = make_panel_grid(1, 1, (8.5, 1.6 + 0.28 * ranked.shape[1]))
    axis = axes[0, 0]
    # Each tuner has its colour of every other figure; text stays dark, since light colours are hard
    # to read.
    colours = {str(name): get_colour(place) for place, name in enumerate(ranked.columns)}
    drawn = critical_difference_diagram(
        ranked.mean(axis=0), p_values, ax=axis, label_props={"fontsize": 9}, color_palette=colours
    )
    for label in drawn["labels"]:
        label.set_color(NEUTRAL_MARK)
    tests = f"Friedman p = {friedman:.2g}; bars: Nemenyi p > 0.05"
    axis.set_title(f"Mean rank over {len(ranked)} problems, 1 is best ({tests})", fontsize=10)
    return figure


def draw_joint_runtime_figure(
    experiment: Experiment, style: TunerStyles, shares: Mapping[str, Array]
) -> Figure:
    """Draw runtime distributions over all problems.

    Args:
        experiment: An experiment that represents all of them.
        style: Styles of their tuners.
        shares: By tuner, the share reached after 0, 1, 2, ... hundredths of each problem's budget.
    """
    figure, axes = make_panel_row(1)
    axis = axes[0]
    for tuner, share in shares.items():
        hundredths = np.arange(len(share))
        look = style.get_plot_style(tuner)
        axis.step(hundredths, share, where="post", markevery=10, markersize=4.5, **look)
    axis.set_xlabel("simulations used, in hundredths of the problem's budget")
    axis.set_ylabel("share of (run, threshold) pairs reached for good")
    axis.set_ylim(-0.02, 1.02)
    finish_figure(figure, axes, style, experiment, "Mean over problems, each with equal weight.")
    return figure
