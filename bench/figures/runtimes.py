"""Figures of the statistics: runtime distributions, amortised training, who wins at which cost,
mean ranks.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bench.analysis.amortisation import COSTS, Price, break_even, winners
from bench.analysis.curves import Curves
from bench.analysis.runtimes import percentile_interval, resampled, solved
from bench.analysis.table import checkpoints
from bench.figures.style import Styles, canvas, finish, save
from bench.problem.experiment import Experiment
from sims.base import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TITLES = {
    "in": "Targets in the training range",
    "wide": "Targets anywhere in the bounds",
    "real": "Recording",
}
SHARED = 100
"""Targets that share one training in the figure of costs."""


def runtime_figure(
    folder: Path, experiment: Experiment, style: Styles, curves: Curves, spread: Array
) -> Path:
    """Share of (run, threshold) pairs that are reached, against simulations."""
    ranges = list(dict.fromkeys(curves.keys["range"]))
    figure, axes = canvas(len(ranges))
    budget = curves.values.shape[1] - 1
    points = np.unique(
        np.concatenate([[0], np.geomspace(1, budget, 60).astype(int), checkpoints(budget)])
    )
    marks = [int(np.flatnonzero(points == k)[0]) for k in checkpoints(budget)]
    for axis, kind in zip(axes, ranges, strict=True):
        part = curves.of(range=str(kind))
        for tuner in part.tuners():
            share = solved(part.of(tuner=tuner), spread, points)
            axis.step(
                points, share, where="post", markevery=marks, markersize=4.5, **style.of(tuner)
            )
        axis.set_xscale("symlog", linthresh=1, linscale=0.5)
        ticks = checkpoints(budget)
        axis.set_xticks(ticks, [str(k) for k in ticks])
        axis.minorticks_off()
        axis.set_xlim(-0.08, budget * 1.1)
        axis.set_ylim(-0.02, 1.02)
        axis.set_xlabel("simulations used on the target")
        axis.set_ylabel("share of (run, threshold) pairs reached for good")
        axis.set_title(
            f"{TITLES[str(kind)]} ({part.keys['target'].nunique()} targets)", fontsize=10
        )
    caption = (
        f"{len(spread)} thresholds from {spread[0]:.2g} to {spread[-1]:.2g} on a logarithmic scale. Reached: the "
        "recommendation's error stays at or below it from there on. A failed run reaches none."
    )
    finish(figure, axes, style, experiment, caption)
    return save(folder, "runtime-distribution", figure)


def amortisation_figure(
    folder: Path,
    experiment: Experiment,
    style: Styles,
    held: Mapping[str, Mapping[str, Price]],
    level: float,
) -> Path:
    """Simulations in total against the number of targets, training included, with the break-even
    points.
    """
    figure, axes = canvas(len(held))
    targets = np.logspace(0, 4, 200)
    for axis, (kind, prices) in zip(axes, held.items(), strict=True):
        for tuner, price in prices.items():
            ert = float(price.effort.ert())
            if np.isfinite(ert):
                total = price.fit_simulations + targets * ert
                axis.plot(targets, total, markevery=25, markersize=4.5, **style.of(tuner))
        _mark_even(axis, prices)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xlabel("number of targets")
        axis.set_ylabel("simulations in total, training included")
        axis.set_title(TITLES[kind], fontsize=10)
    caption = (
        f"To reach an error of {level:.2g} for good: training + targets × expected simulations (ERT). Rings: a learned "
        "tuner passes a search tuner; bars: 95 % bootstrap interval. A tuner without a line never got there."
    )
    finish(figure, axes, style, experiment, caption)
    return save(folder, "amortisation", figure)


def _mark_even(axis: Axes, prices: Mapping[str, Price]) -> None:
    """A ring at each break-even point, with its 95 % interval as a bar."""
    for learned in prices.values():
        for search in prices.values():
            if learned.fit_simulations and not search.fit_simulations:
                even = float(break_even(learned, search))
                if 1 <= even <= 1e4:
                    total = even * float(search.effort.ert())
                    picked = resampled(len(learned.effort.successes), "break-even")
                    low, high = np.clip(
                        percentile_interval(break_even(learned, search, picked)), 1, 1e4
                    )
                    axis.plot(
                        [low, high],
                        [total, total],
                        color="#333333",
                        linewidth=1.0,
                        alpha=0.6,
                        zorder=4,
                    )
                    axis.plot(
                        even,
                        total,
                        "o",
                        markersize=9,
                        markerfacecolor="none",
                        color="#333333",
                        zorder=5,
                    )


def cost_figure(
    folder: Path,
    experiment: Experiment,
    style: Styles,
    held: Mapping[str, Mapping[str, Price]],
    level: float,
) -> Path:
    """Seconds a target against the cost of a simulation; a strip below names who needs the least."""
    figure, axes = canvas(len(held))
    for axis, (kind, prices) in zip(axes, held.items(), strict=True):
        for tuner, price in prices.items():
            if np.isfinite(price.effort.ert()):
                axis.plot(
                    COSTS,
                    price.seconds(COSTS, SHARED),
                    markevery=20,
                    markersize=4.5,
                    **style.of(tuner),
                )
        axis.set_xscale("log")
        axis.set_yscale("log")
        for low, high, tuner in winners(prices, SHARED):
            colour = style.of(tuner)["color"]
            axis.axvspan(low, high, ymin=0.0, ymax=0.035, color=colour, linewidth=0)
            if high / low > 30:
                axis.annotate(
                    tuner,
                    (np.sqrt(low * high), 0.045),
                    xycoords=("data", "axes fraction"),
                    ha="center",
                    fontsize=7.5,
                )
        axis.set_xlabel("seconds that one simulation takes")
        axis.set_ylabel("seconds for one target")
        axis.set_title(TITLES[kind], fontsize=10)
    caption = (
        f"To reach an error of {level:.2g} for good: ERT × seconds of a simulation + seconds of the tuner as measured; "
        f"training shared by {SHARED} targets. The strip names who needs least."
    )
    finish(figure, axes, style, experiment, caption)
    return save(folder, "who-wins-at-which-cost", figure)


def rank_figure(
    folder: Path, ranked: pd.DataFrame, p_values: pd.DataFrame, friedman: float
) -> Path:
    """Critical-difference diagram: mean ranks over problems, bars join what cannot be told apart at
    5 %.
    """
    from matplotlib import pyplot as plt
    from scikit_posthocs import critical_difference_diagram

    figure: Figure = plt.figure(figsize=(8.5, 1.6 + 0.28 * ranked.shape[1]))
    axis = figure.add_subplot()
    critical_difference_diagram(ranked.mean(axis=0), p_values, ax=axis, label_props={"fontsize": 9})
    axis.set_title(
        f"Mean rank over {len(ranked)} problems, 1 is best (Friedman p = {friedman:.2g}; bars: Nemenyi p > 0.05)",
        fontsize=10,
    )
    return save(folder, "critical-difference", figure)


def joint_runtime_figure(
    folder: Path, experiment: Experiment, style: Any, shares: Mapping[str, Array]
) -> Path:
    """Runtime distributions over all problems; `shares` after 0, 1, 2, ... hundredths of each
    problem's budget.
    """
    figure, axes = canvas(1)
    for tuner, share in shares.items():
        axes[0].step(
            np.arange(len(share)),
            share,
            where="post",
            markevery=10,
            markersize=4.5,
            **style.of(tuner),
        )
    axes[0].set_xlabel("simulations used, in hundredths of the problem's budget")
    axes[0].set_ylabel("share of (run, threshold) pairs reached for good")
    axes[0].set_ylim(-0.02, 1.02)
    finish(figure, axes, style, experiment, "Mean over problems, each with equal weight.")
    return save(folder, "runtime-distribution", figure)
