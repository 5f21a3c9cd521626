"""Draw what data identify: spectra, parameter directions, errors along them, and prediction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from bench.benchmark.figures.error_figures import draw_error_panel, shade_equal
from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.problem.fisher_information import STIFF_SIGMA_THRESHOLD
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics
from bench.benchmark.statistics.identifiability_table import IDENTIFIABILITY_COLUMNS
from bench.figures.style import (
    BLUE,
    CAPTION_GREY,
    MEDIAN_LINE_CAPTION,
    PANEL_TITLES,
    VERMILION,
    add_caption,
    finish_figure,
    make_panel_grid,
    style_axis,
    style_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bench.benchmark.storage.reference_results import ReferenceResult

_MIN_SHOWN_SIGMA = 1e-6
"""Standard deviation in training widths below which values are drawn at the edge."""
_MAX_SHOWN_SIGMA = 1e4
"""Standard deviation in training widths above which values are drawn at the edge."""
_LEAST_SHARE = 0.05
"""Minimum share of a parameter in a direction that is written."""
_WHERE = {
    "in": "truth in training range",
    "wide": "truth in bounds",
    "real": "recording, at nominal values",
}
_MARKS = (("o", BLUE), ("^", VERMILION))
"""Markers and colours of the ranges, in their order."""
METRIC_LABELS = {
    "stiff_error": "along stiff directions\n[training widths]",
    "sloppy_error": "along sloppy directions\n[training widths]",
    "heldout_error": "of prediction,\nRMSE of {channel}",
}
"""Axis labels by metric."""


def draw_spectra_figure(experiment: Experiment, table: pd.DataFrame) -> Figure:
    """Draw the standard deviations along all directions, and the parameters in each direction.

    Left: 1 sigma of every direction, one marker per target. Right: share of each parameter in each
    direction.

    Args:
        experiment: The experiment.
        table: Rows of identifiability.csv.
    """
    names = [c for c in table.columns if c not in IDENTIFIABILITY_COLUMNS]
    size = (4.8 + 0.8 * len(names), 2.2 + 0.4 * len(names))
    figure, axes = make_panel_grid(1, 2, size, width_ratios=[1, 1.25])
    _spectra(axes[0, 0], table, len(names))
    _directions(axes[0, 1], table, names)
    figure.suptitle(f"{experiment.title or experiment.name}: what the data can know", fontsize=11)
    real = set(table["range"]) == {"real"}
    where = "the nominal parameters" if real else "each target's truth"
    caption = (
        f"From the Fisher information at {where} (Cramér–Rao bound). "
        f"Stiff: 1 sigma below {STIFF_SIGMA_THRESHOLD:g} of the training width (dashed). "
        "Right: mean over targets of the squared component."
    )
    add_caption(figure, caption, letters=15)
    return figure


def _spectra(axis: Axes, table: pd.DataFrame, directions: int) -> None:
    """Draw every target's 1 sigma along each direction, the ranges side by side."""
    ranges = list(dict.fromkeys(table["range"]))
    for place, (kind, (marker, colour)) in enumerate(zip(ranges, _MARKS, strict=False)):
        part = table[table["range"] == kind]
        targets = part["target"].nunique()
        # Markers of one direction lie side by side within 0.3, the ranges 0.4 apart.
        places = part.groupby("direction").cumcount()
        within = (places / (targets - 1) - 0.5) * 0.3 if targets > 1 else 0.0 * places
        across = part["direction"] + within + (place - 0.5 * (len(ranges) - 1)) * 0.4
        axis.plot(
            across,
            # A direction without effect on the data has an infinite sigma and is drawn at the edge.
            part["sigma"].clip(_MIN_SHOWN_SIGMA, _MAX_SHOWN_SIGMA),
            marker,
            color=colour,
            markersize=3.5,
            alpha=0.75,
            linestyle="none",
            label=_WHERE.get(kind, kind) + ("" if kind == "real" else f" (n = {targets})"),
        )
    axis.axhline(STIFF_SIGMA_THRESHOLD, color=CAPTION_GREY, linewidth=0.8, linestyle="--")
    for name, above in (("sloppy", 3), ("stiff", -9)):
        axis.annotate(
            name,
            (0.01, STIFF_SIGMA_THRESHOLD),
            (0, above),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            fontsize=8,
        )
    axis.set_yscale("log")
    # Extra space for the legend.
    axis.set_ylim(bottom=axis.get_ylim()[0] / 10)
    axis.set_xticks(range(1, directions + 1))
    axis.set_xlabel("direction, the stiffest first")
    axis.set_ylabel("1 sigma that no estimate can beat\n[training widths]")
    style_axis(axis)
    axis.legend(fontsize=7.5, frameon=False, loc="lower right")


def _directions(axis: Axes, table: pd.DataFrame, names: list[str]) -> None:
    """Draw the shares of the parameters in each direction, as a grid of numbers."""
    # A direction has length 1: its squared components are shares, independent of their signs.
    squares = table.set_index("direction")[names] ** 2
    shares = squares.groupby(level=0).mean().to_numpy().T
    axis.imshow(shares, cmap="Greys", vmin=0.0, vmax=1.0, aspect="auto")
    for row, column in np.argwhere(shares >= _LEAST_SHARE):
        share = float(shares[row, column])
        axis.text(
            column,
            row,
            f"{share:.2f}".lstrip("0") if share < 0.995 else "1",
            ha="center",
            va="center",
            fontsize=8,
            color="white" if share > 0.55 else "black",
        )
    axis.set_xticks(range(len(names)), [str(i + 1) for i in range(len(names))])
    axis.set_yticks(range(len(names)), names, fontsize=8)
    axis.set_xlabel("direction")
    axis.set_title("share of each parameter", fontsize=9)


def list_directional_metrics(experiment: Experiment, runs: pd.DataFrame) -> list[str]:
    """List the metrics of `draw_directions_figure` that the runs have.

    A recording has none, since its held-out runs are drawn with its errors.

    Args:
        experiment: The experiment.
        runs: Its runs.
    """
    if "real" in experiment.ranges:
        return []
    return [m for m in METRIC_LABELS if m in runs and runs[m].notna().any()]


def draw_directions_figure(
    experiment: Experiment,
    statistics: ComparisonStatistics,
    channel: str,
    behind: Sequence[ReferenceResult] = (),
) -> Figure:
    """Draw errors along stiff and sloppy directions and of prediction, against simulations.

    Each column of panels is a range.

    Args:
        experiment: The experiment.
        statistics: Its statistics, with at least one metric of `list_directional_metrics`.
        channel: Error channel with unit, e.g. ``q [rad]``.
        behind: Reference results that are drawn in grey.
    """
    runs = statistics.all_runs
    metrics = list_directional_metrics(experiment, runs)
    ranges = [r for r in experiment.ranges if (runs["range"] == r).any()]
    size = (1.8 + 4.0 * len(ranges), 1.2 + 2.3 * len(metrics))
    figure, axes = make_panel_grid(len(metrics), len(ranges), size, sharey="row", sharex=True)
    drawn = [(metric, kind) for metric in metrics for kind in ranges]
    style = style_of(experiment, statistics, behind, drawn)
    for row, metric in zip(axes, metrics, strict=True):
        for axis, kind in zip(row, ranges, strict=True):
            part = runs[(runs["range"] == kind) & runs[metric].notna()]
            style_axis(axis)
            if part.empty:
                middle = {"ha": "center", "transform": axis.transAxes}
                axis.text(0.5, 0.5, "no target has any", fontsize=8, **middle)
                continue
            draw_error_panel(axis, statistics, metric, kind, style)
            axis.set_title(f"{PANEL_TITLES[kind]} ({part['target'].nunique()} targets)", fontsize=9)
            if axis is row[0]:
                what = METRIC_LABELS[metric].format(channel=channel)
                axis.set_ylabel(f"error {what}\nmedian", fontsize=9)
            # Rows share their horizontal axis, which is labelled below the last row only.
            if metric != metrics[-1]:
                axis.set_xlabel("")
    for row, metric in zip(axes, metrics, strict=True):
        for axis in row:
            shade_equal(axis, statistics.floor_of(metric))
    caption = f"{MEDIAN_LINE_CAPTION} A sloppy direction is one that the target's data do not fix."
    finish_figure(figure, [a for row in axes for a in row], style, experiment, caption)
    return figure
