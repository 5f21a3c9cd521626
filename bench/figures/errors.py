"""Errors of a comparison against the number of simulations, and against the target's distance from
the training range.

Bands and bars are 95 % bootstrap intervals of the median over targets.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bench.analysis.table import checkpoints, interval, target_curves
from bench.figures.style import FLOOR, SOFT, TITLES, Styles, behind_id, canvas, finish
from bench.problem.experiment import Experiment
from sims.base import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bench.store.reference import Reference

_RESAMPLES = 500
"""Of the bootstrap: enough for a band a few pixels wide."""
_POINTS = 40
"""Numbers of simulations at which a curve is drawn, on a logarithmic scale."""
_MOMENTS = (3, 10)
"""Numbers of simulations at which errors are drawn against distance, beside the whole budget."""
_BINS = 4
"""Of distances outside the training range; targets within it make one more."""


def error_figure(
    experiment: Experiment,
    runs: pd.DataFrame,
    channel: str,
    parameter: str,
    behind: Sequence[Reference] = (),
) -> Figure:
    """Error against simulations.

    One panel a range, or, for a recording, held-out runs beside the runs tuned on.

    Args:
        experiment: what was compared.
        runs: rows of runs.parquet.
        channel: the error channel with its unit, e.g. ``q [rad]``.
        parameter: the parameter with its unit where there is one; empty for several.
        behind: reference results that are drawn in grey behind these.
    """
    real = "real" in experiment.ranges
    # Of a recording nobody knows the truth: what counts is its error on what was not fitted.
    if real:
        metrics = [m for m in ("heldout_error", "obs_error") if runs[m].notna().any()]
        panels = [(runs, m, TITLES[m], f"RMSE of {channel}") for m in metrics]
    else:
        metric, label = parameter_metric(runs), _parameter_label(parameter)
        ranges = _ranges(experiment, runs)
        panels = [(runs[runs["range"] == r], metric, TITLES[r], label) for r in ranges]

    figure, axes = canvas(len(panels))
    style = Styles(experiment, runs, panels[0][1], behind)
    what = "starts" if real else "targets"
    for axis, (part, metric, title, label) in zip(axes, panels, strict=True):
        samples_panel(axis, part, metric, experiment.budget, style)
        axis.set_title(f"{title} ({part['target'].nunique()} {what})", fontsize=10)
        axis.set_ylabel(f"{label}, median")
    finish(figure, axes, style, experiment)
    return figure


def misfit_figure(
    experiment: Experiment, runs: pd.DataFrame, channel: str, behind: Sequence[Reference] = ()
) -> Figure:
    """What tuning leaves where the targets come from another simulator: the floor that no parameter
    removes. Arguments as of `error_figure`.
    """
    ranges = _ranges(experiment, runs)
    figure, axes = canvas(len(ranges))
    style = Styles(experiment, runs, "obs_error", behind)
    for axis, kind in zip(axes, ranges, strict=True):
        part = runs[runs["range"] == kind]
        samples_panel(axis, part, "obs_error", experiment.budget, style)
        # Nobody knows the least error there is, but somebody's least bounds it from above.
        floor = float(part.groupby("target")["obs_error"].min().median())
        axis.axhline(floor, color=SOFT, linewidth=0.8, linestyle=(0, (2, 2)))
        axis.annotate(
            f"least that any tuner reached: {floor:.2g} (median)",
            (0, floor),
            xytext=(4, -10),
            textcoords="offset points",
            fontsize=7.5,
        )
        axis.set_title(f"{TITLES[kind]} ({part['target'].nunique()} targets)", fontsize=10)
        axis.set_ylabel(f"RMSE of {channel}, median")
    finish(figure, axes, style, experiment)
    return figure


def samples_panel(axis: Axes, runs: pd.DataFrame, metric: str, budget: int, style: Styles) -> None:
    """Each tuner's median of a metric over targets against simulations, with its interval."""
    ticks = checkpoints(budget)
    between = np.unique(np.geomspace(1, budget, _POINTS).astype(int))
    points = sorted({*ticks, *between.tolist()})
    marks = [points.index(k) for k in ticks]
    for tuner, group in runs.groupby("tuner", sort=False):
        curves = np.maximum(target_curves(group, metric, points).to_numpy(dtype=np.float64), FLOOR)
        # A target whose runs all failed has no curve; failures are counted in the table.
        curves = curves[np.isfinite(curves).all(axis=1)]
        if not len(curves):
            continue
        low, high = interval(curves, np.median, "figure", str(tuner), metric, resamples=_RESAMPLES)
        look = style.of(str(tuner))
        # Marks only where tables have numbers; the line goes through all points.
        axis.plot(points, np.median(curves, axis=0), markevery=marks, markersize=4.5, **look)
        axis.fill_between(points, low, high, color=look["color"], alpha=0.13, linewidth=0)
    for reference in style.behind:
        _grey_lines(axis, reference, str(runs["range"].iloc[0]), metric, budget, style)
    axis.set_yscale("log")
    simulations_axis(axis, budget)


def _grey_lines(
    axis: Axes, reference: Reference, kind: str, metric: str, budget: int, style: Styles
) -> None:
    """Each tuner's median of a reference, at the numbers of simulations that its table has."""
    for tuner in reference.tuners:
        curve = reference.curve(tuner, kind, metric, budget)
        if len(curve):
            medians = np.maximum(curve["median"].to_numpy(dtype=np.float64), FLOOR)
            name, look = behind_id(reference, tuner), style.grey(reference, tuner)
            axis.plot(curve["simulations"], medians, gid=name, **look)


def simulations_axis(axis: Axes, budget: int) -> None:
    """Simulations along the horizontal axis, logarithmic but for a first piece from 0 to 1."""
    ticks = checkpoints(budget)
    axis.set_xscale("symlog", linthresh=1, linscale=0.5)
    axis.set_xticks(ticks, [str(k) for k in ticks])
    axis.set_xlim(-0.08, budget * 1.1)
    axis.minorticks_off()
    axis.set_xlabel("simulations used on the target")


def distance_figure(experiment: Experiment, runs: pd.DataFrame, parameter: str) -> Figure:
    """Median error after few, some and all simulations, by how far the target lies outside the
    training range. Arguments as of `error_figure`.
    """
    metric = parameter_metric(runs)
    wide = runs[runs["range"] == "wide"]
    bins, names = _binned(wide.groupby("target")["outside"].first())
    moments = [k for k in _MOMENTS if k < experiment.budget] + [experiment.budget]

    figure, axes = canvas(len(moments))
    style = Styles(experiment, runs, metric)
    for axis, k in zip(axes, moments, strict=True):
        for tuner, group in wide.groupby("tuner", sort=False):
            values = target_curves(group, metric, [k])[k].dropna().clip(lower=FLOOR)
            places = bins[values.index].to_numpy()
            _distance_line(axis, values.to_numpy(), places, str(tuner), style)
        axis.set_xticks(range(_BINS + 1), names, fontsize=7)
        axis.set_yscale("log")
        axis.set_title(f"After {k} simulations", fontsize=10)
        axis.set_xlabel(
            "distance of the target from the training range,\nin widths of that range; n targets"
        )
        axis.set_ylabel(f"{_parameter_label(parameter)}, median")
    finish(figure, axes, style, experiment)
    return figure


def _binned(distances: pd.Series[float]) -> tuple[pd.Series[Any], list[str]]:
    """The bin of each target, -1 within the training range, and the names of all bins."""
    # Bins of one width; targets on the edge of the training range are within it.
    edges = np.linspace(0.0, float(distances.max()), _BINS + 1)
    outside = np.searchsorted(edges[1:-1], distances, side="left")
    bins = pd.Series(np.where(distances > 0, outside, -1), index=distances.index)
    ranges = ["inside", *(f"{edges[b]:.2f}–{edges[b + 1]:.2f}" for b in range(_BINS))]
    counts = [int((bins == b).sum()) for b in range(-1, _BINS)]
    return bins, [f"{name}\nn={count}" for name, count in zip(ranges, counts, strict=True)]


def _distance_line(
    axis: Axes, values: Array, bins: NDArray[np.integer[Any]], tuner: str, style: Styles
) -> None:
    places, middle, bars = [], [], []
    for b in range(-1, _BINS):
        part = values[bins == b]
        if not len(part):
            continue
        names = ("distance", tuner, str(b))
        low, high = interval(part[:, None], np.median, *names, resamples=_RESAMPLES)
        median = float(np.median(part))
        places.append(b + 1 + style.offset(tuner))
        middle.append(median)
        # One target has no interval: its bar has no length.
        bars.append((median - low[0], high[0] - median) if len(part) > 1 else (0.0, 0.0))
    # A percentile interval may lie to one side of the median by rounding; a bar has no such side.
    lengths = np.maximum(np.array(bars).T, 0.0)
    look = style.of(tuner)
    axis.errorbar(places, middle, yerr=lengths, markersize=4.5, elinewidth=0.8, capsize=1.5, **look)


def _ranges(experiment: Experiment, runs: pd.DataFrame) -> list[str]:
    """The experiment's ranges of which there are runs."""
    return [r for r in experiment.ranges if (runs["range"] == r).any()]


def parameter_metric(runs: pd.DataFrame) -> str:
    """One parameter's error is drawn in its own unit, several ones' in training widths."""
    return "param_abs_error" if "param_abs_error" in runs else "param_error"


def _parameter_label(parameter: str) -> str:
    if parameter:
        return f"absolute error of {parameter}"
    return "mean parameter error [training widths]"
