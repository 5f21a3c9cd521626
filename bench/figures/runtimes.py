"""Figures of the statistics: runtime distributions, amortised training, who wins at which cost,
mean ranks.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from bench.analysis.amortisation import (
    MOST_TARGETS,
    SHARED,
    Price,
    break_even,
    seconds_table,
    totals_table,
    winners,
)
from bench.analysis.runtimes import percentile_interval, resampled
from bench.analysis.statistics import Statistics
from bench.analysis.table import checkpoints
from bench.figures.errors import simulations_axis
from bench.figures.style import INK, TITLES, Styles, blank, canvas, colour, finish, titled
from bench.problem.experiment import Experiment
from sims.base import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Prices = Mapping[str, Mapping[str, Price]]
"""By range of targets, by tuner."""
_WIDE = 30.0
"""Factor of cost over which a tuner must win for its name to fit above its part of the strip."""


def runtime_figure(experiment: Experiment, style: Styles, statistics: Statistics) -> Figure:
    """Share of (run, threshold) pairs that are reached, against simulations.

    Args:
        experiment: what was compared.
        style: of its tuners.
        statistics: of it.
    """
    spread, table = statistics.spread, statistics.shares
    ranges = list(dict.fromkeys(table["range"]))
    figure, axes = canvas(len(ranges))
    budget = int(table["simulations"].max())
    for axis, kind in zip(axes, ranges, strict=True):
        for tuner, line in table[table["range"] == kind].groupby("tuner", sort=False):
            points = line["simulations"].to_numpy()
            marks = np.flatnonzero(np.isin(points, checkpoints(budget))).tolist()
            # Steps, not slopes: between two simulations nothing is reached.
            look = style.of(str(tuner))
            axis.step(points, line["share"], where="post", markevery=marks, markersize=4.5, **look)
        simulations_axis(axis, budget)
        axis.set_ylim(-0.02, 1.02)
        axis.set_ylabel("share of (run, threshold) pairs reached for good")
        targets = statistics.curves.of(range=str(kind)).keys["target"].nunique()
        titled(axis, f"{TITLES[str(kind)]} ({targets} targets)")
    finish(figure, axes, style, experiment, spread_caption(spread))
    return figure


def spread_caption(spread: Array) -> str:
    """How a runtime distribution over these thresholds is read."""
    span = f"from {spread[0]:.2g} to {spread[-1]:.2g} on a logarithmic scale"
    return (
        f"{len(spread)} thresholds {span}. "
        "Reached: the recommendation's error stays at or below it from there on. "
        "A failed run reaches none."
    )


def amortisation_figure(
    experiment: Experiment, style: Styles, prices: Prices, level: float
) -> Figure:
    """Simulations in total against the number of targets, training included, with the break-even
    points.

    Args:
        experiment: what was compared.
        style: of its tuners.
        prices: of reaching `level`.
        level: of the deciding metric.
    """
    figure, axes = canvas(len(prices))
    table = totals_table(prices)
    for axis, (kind, by_tuner) in zip(axes, prices.items(), strict=True):
        for tuner, line in table[table["range"] == kind].groupby("tuner", sort=False):
            look = style.of(str(tuner))
            axis.plot(line["targets"], line["simulations"], markevery=25, markersize=4.5, **look)
        _mark_even(axis, by_tuner)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xlabel("number of targets")
        axis.set_ylabel("simulations in total, training included")
        titled(axis, TITLES[kind])
    caption = (
        f"To reach an error of {level:.2g} for good: training + targets × expected simulations "
        "(ERT). Rings: a learned tuner passes a search tuner; bars: 95 % bootstrap interval. "
        "A tuner without a line never got there, or began there."
    )
    finish(figure, axes, style, experiment, caption)
    return figure


def _mark_even(axis: Axes, prices: Mapping[str, Price]) -> None:
    """A ring at each break-even point, with its 95 % interval as a bar."""
    # Only against each other: who needs no training has nothing to get back.
    learning = [p for p in prices.values() if p.fit_simulations]
    searching = [p for p in prices.values() if not p.fit_simulations]
    for learned in learning:
        for search in searching:
            even = float(break_even(learned, search))
            if not 1 <= even <= MOST_TARGETS:
                continue
            total = even * float(search.effort.ert())
            picked = resampled(len(learned.effort.successes), "break-even")
            # Some resamples may never break even: their bar ends where the figure does.
            spread = percentile_interval(break_even(learned, search, picked))
            ends = np.clip(spread, 1, MOST_TARGETS)
            axis.plot(ends, [total, total], color=INK, linewidth=1.0, alpha=0.6, zorder=4)
            axis.plot(even, total, "o", markersize=9, markerfacecolor="none", color=INK, zorder=5)


def cost_figure(experiment: Experiment, style: Styles, prices: Prices, level: float) -> Figure:
    """Seconds a target against the cost of a simulation; a strip below names who needs the least.
    Arguments as of `amortisation_figure`.
    """
    figure, axes = canvas(len(prices))
    table = seconds_table(prices)
    for axis, (kind, by_tuner) in zip(axes, prices.items(), strict=True):
        for tuner, line in table[table["range"] == kind].groupby("tuner", sort=False):
            across, up = line["simulation_seconds"], line["seconds"]
            axis.plot(across, up, markevery=20, markersize=4.5, **style.of(str(tuner)))
        axis.set_xscale("log")
        axis.set_yscale("log")
        _strip(axis, by_tuner, style)
        axis.set_xlabel("seconds that one simulation takes")
        axis.set_ylabel("seconds for one target")
        titled(axis, TITLES[kind])
    caption = (
        f"To reach an error of {level:.2g} for good: ERT × seconds of a simulation + seconds of "
        f"the tuner as measured; training shared by {SHARED} targets. "
        "The strip names who needs least."
    )
    finish(figure, axes, style, experiment, caption)
    return figure


def _strip(axis: Axes, prices: Mapping[str, Price], style: Styles) -> None:
    """Who needs the least time at each cost, as a coloured strip at the foot of a panel."""
    for low, high, tuner in winners(prices, SHARED):
        colour = style.of(tuner)["color"]
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


def rank_figure(ranked: pd.DataFrame, p_values: pd.DataFrame, friedman: float) -> Figure:
    """Critical-difference diagram: mean ranks over problems, bars join what cannot be told apart at
    5 %.

    Args:
        ranked: ranks, a row a problem, a column a tuner.
        p_values: Nemenyi's, of each pair of tuners.
        friedman: p-value of Friedman's test.
    """
    from scikit_posthocs import critical_difference_diagram

    figure, axes = blank(1, 1, (8.5, 1.6 + 0.28 * ranked.shape[1]))
    axis = axes[0, 0]
    # Each tuner in the colour that it has in every other figure; a light one would be no text.
    colours = {str(name): colour(place) for place, name in enumerate(ranked.columns)}
    drawn = critical_difference_diagram(
        ranked.mean(axis=0), p_values, ax=axis, label_props={"fontsize": 9}, color_palette=colours
    )
    for label in drawn["labels"]:
        label.set_color(INK)
    tests = f"Friedman p = {friedman:.2g}; bars: Nemenyi p > 0.05"
    axis.set_title(f"Mean rank over {len(ranked)} problems, 1 is best ({tests})", fontsize=10)
    return figure


def joint_runtime_figure(
    experiment: Experiment, style: Styles, shares: Mapping[str, Array]
) -> Figure:
    """Runtime distributions over all problems.

    Args:
        experiment: stands for all of them.
        style: of their tuners.
        shares: by tuner, reached after 0, 1, 2, ... hundredths of each problem's budget.
    """
    figure, axes = canvas(1)
    axis = axes[0]
    for tuner, share in shares.items():
        hundredths = np.arange(len(share))
        look = style.of(tuner)
        axis.step(hundredths, share, where="post", markevery=10, markersize=4.5, **look)
    axis.set_xlabel("simulations used, in hundredths of the problem's budget")
    axis.set_ylabel("share of (run, threshold) pairs reached for good")
    axis.set_ylim(-0.02, 1.02)
    finish(figure, axes, style, experiment, "Mean over problems, each with equal weight.")
    return figure
