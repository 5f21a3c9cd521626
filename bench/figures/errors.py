"""The figures of a comparison: error against number of simulations, and against distance from the
training range.

Made for print: every tuner has its own marker and line style beside its colour, colours differ in
lightness, bands are 95 % bootstrap intervals of the median over targets. Each figure is written as
PNG and PDF.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bench.analysis.table import checkpoints, interval, target_curves
from bench.figures.style import FLOOR, TITLES, Styles, canvas, finish, save
from bench.problem.experiment import Experiment

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_RESAMPLES = 500


def draw(
    folder: Path, experiment: Experiment, runs: pd.DataFrame, channel_unit: str, parameter: str
) -> list[Path]:
    """Draw every figure that the runs allow into `folder`/figures; returns the PNG files.

    Args:
        folder: the comparison's folder.
        experiment: what was compared.
        runs: rows of runs.parquet.
        channel_unit: the error channel with its unit, for axes, e.g. ``q [rad]``.
        parameter: the parameter with its unit where there is one, e.g. ``restitution``; empty for
            several.
    """
    import matplotlib

    matplotlib.use("Agg")
    made = [
        save(
            folder,
            "error-vs-simulations",
            _samples_figure(experiment, runs, channel_unit, parameter),
        )
    ]
    if experiment.world:
        made.append(
            save(folder, "misfit-vs-simulations", _misfit_figure(experiment, runs, channel_unit))
        )
    if "wide" in experiment.ranges and runs.loc[runs["range"] == "wide", "outside"].gt(0).any():
        made.append(
            save(folder, "error-vs-distance", _distance_figure(experiment, runs, parameter))
        )
    return made


def _samples_figure(
    experiment: Experiment, runs: pd.DataFrame, channel_unit: str, parameter: str
) -> Figure:
    """One panel a range (or, for a recording, held-out runs beside the runs tuned on)."""
    if "real" in experiment.ranges:
        metrics = [m for m in ("heldout_error", "obs_error") if runs[m].notna().any()]
        panels = [(runs, m, TITLES[m], f"RMSE of {channel_unit}") for m in metrics]
    else:
        metric = _parameter_metric(runs)
        label = _parameter_label(parameter)
        ranges = [r for r in experiment.ranges if (runs["range"] == r).any()]
        panels = [(runs[runs["range"] == r], metric, TITLES[r], label) for r in ranges]
    figure, axes = canvas(len(panels))
    style = Styles(experiment, runs, panels[0][1])
    for axis, (part, metric, title, label) in zip(axes, panels, strict=True):
        samples_panel(axis, part, metric, experiment.budget, style)
        targets = part["target"].nunique()
        what = "starts" if "real" in experiment.ranges else "targets"
        axis.set_title(f"{title} ({targets} {what})", fontsize=10)
        axis.set_ylabel(f"{label}, median")
    finish(figure, axes, style, experiment)
    return figure


def _misfit_figure(experiment: Experiment, runs: pd.DataFrame, channel_unit: str) -> Figure:
    """What tuning leaves where the targets come from another simulator: the floor that no parameter
    removes.
    """
    ranges = [r for r in experiment.ranges if (runs["range"] == r).any()]
    figure, axes = canvas(len(ranges))
    style = Styles(experiment, runs, "obs_error")
    for axis, kind in zip(axes, ranges, strict=True):
        part = runs[runs["range"] == kind]
        samples_panel(axis, part, "obs_error", experiment.budget, style)
        floor = float(part.groupby("target")["obs_error"].min().median())
        axis.axhline(floor, color="#444444", linewidth=0.8, linestyle=(0, (2, 2)))
        axis.annotate(
            f"least that any tuner reached: {floor:.2g} (median)",
            (0, floor),
            xytext=(4, -10),
            textcoords="offset points",
            fontsize=7.5,
        )
        axis.set_title(f"{TITLES[kind]} ({part['target'].nunique()} targets)", fontsize=10)
        axis.set_ylabel(f"RMSE of {channel_unit}, median")
    finish(figure, axes, style, experiment)
    return figure


def samples_panel(axis: Axes, runs: pd.DataFrame, metric: str, budget: int, style: Styles) -> None:
    """Each tuner's median of a metric over targets against simulations, with its interval."""
    points = sorted(
        {*checkpoints(budget), *np.unique(np.geomspace(1, budget, 40).astype(int)).tolist()}
    )
    for tuner, group in runs.groupby("tuner", sort=False):
        curves = np.maximum(target_curves(group, metric, points).to_numpy(dtype=np.float64), FLOOR)
        curves = curves[np.isfinite(curves).all(axis=1)]
        if not len(curves):
            continue
        low, high = interval(curves, np.median, "figure", str(tuner), metric, resamples=_RESAMPLES)
        look = style.of(str(tuner))
        marks = [points.index(k) for k in checkpoints(budget)]
        axis.plot(points, np.median(curves, axis=0), markevery=marks, markersize=4.5, **look)
        axis.fill_between(points, low, high, color=look["color"], alpha=0.13, linewidth=0)
    axis.set_xscale("symlog", linthresh=1, linscale=0.5)
    axis.set_yscale("log")
    ticks = checkpoints(budget)
    axis.set_xticks(ticks, [str(k) for k in ticks])
    axis.set_xlim(-0.08, budget * 1.1)
    axis.minorticks_off()
    axis.set_xlabel("simulations used on the target")


def _distance_figure(experiment: Experiment, runs: pd.DataFrame, parameter: str) -> Figure:
    """Median error after few, some and all simulations, by how far the target lies outside the
    training range.
    """
    metric = _parameter_metric(runs)
    wide = runs[runs["range"] == "wide"]
    moments = [k for k in (3, 10) if k < experiment.budget] + [experiment.budget]
    distances = wide.groupby("target")["outside"].first()
    edges = np.linspace(0.0, float(distances.max()), 5)
    places = np.where(distances > 0, np.searchsorted(edges[1:-1], distances, side="left"), -1)
    bins = pd.Series(places, index=distances.index)
    counts = [int((bins == b).sum()) for b in range(-1, 4)]
    names = ["inside", *(f"{edges[b]:.2f}–{edges[b + 1]:.2f}" for b in range(4))]
    figure, axes = canvas(len(moments))
    style = Styles(experiment, runs, metric)
    for axis, k in zip(axes, moments, strict=True):
        for tuner, group in wide.groupby("tuner", sort=False):
            values = target_curves(group, metric, [k])[k].dropna().clip(lower=FLOOR)
            _distance_line(
                axis, values.to_numpy(), bins[values.index].to_numpy(), str(tuner), style
            )
        axis.set_xticks(
            range(5), [f"{n}\nn={c}" for n, c in zip(names, counts, strict=True)], fontsize=7
        )
        axis.set_yscale("log")
        axis.set_title(f"After {k} simulations", fontsize=10)
        axis.set_xlabel(
            "distance of the target from the training range,\nin widths of that range; n targets"
        )
        axis.set_ylabel(f"{_parameter_label(parameter)}, median")
    finish(figure, axes, style, experiment)
    return figure


def _distance_line(axis: Axes, values: Any, bins: Any, tuner: str, style: Styles) -> None:
    places, middle, low, high = [], [], [], []
    for b in range(-1, 4):
        part = values[bins == b]
        if len(part):
            below, above = interval(
                part[:, None], np.median, "distance", tuner, str(b), resamples=_RESAMPLES
            )
            places.append(b + 1 + style.offset(tuner))
            middle.append(np.median(part))
            low.append(np.median(part) - below[0] if len(part) > 1 else 0.0)
            high.append(above[0] - np.median(part) if len(part) > 1 else 0.0)
    bars = np.maximum([low, high], 0.0)
    axis.errorbar(
        places, middle, yerr=bars, markersize=4.5, elinewidth=0.8, capsize=1.5, **style.of(tuner)
    )


def _parameter_metric(runs: pd.DataFrame) -> str:
    return "param_abs_error" if "param_abs_error" in runs else "param_error"


def _parameter_label(parameter: str) -> str:
    return (
        f"absolute error of {parameter}" if parameter else "mean parameter error [training widths]"
    )
