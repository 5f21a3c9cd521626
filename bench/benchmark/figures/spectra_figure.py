"""Draw what data identify: the spectrum of every target, and the parameters in each direction."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.problem.fisher_information import STIFF_SIGMA_THRESHOLD
from bench.benchmark.statistics.identifiability_table import IDENTIFIABILITY_COLUMNS
from bench.figures.style import (
    BLUE,
    CAPTION_GREY,
    VERMILION,
    add_caption,
    make_panel_grid,
    style_axis,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MIN_DRAWN_SIGMA = 1e-6
"""Standard deviation in training widths below which values are drawn at the edge."""
_MAX_DRAWN_SIGMA = 1e4
"""Standard deviation in training widths above which values are drawn at the edge."""
_MIN_LABELLED_SHARE = 0.05
"""Minimum share of a parameter in a direction that is written."""
_RANGE_LABELS = {
    "in": "true parameters in training range",
    "wide": "true parameters in bounds",
    "real": "recording, at nominal values",
}
_RANGE_MARKERS = (("o", BLUE), ("^", VERMILION))
"""Markers and colours of the ranges, in their order."""


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
    _draw_spectra(axes[0, 0], table, len(names))
    _draw_direction_shares(axes[0, 1], table, names)
    figure.suptitle(f"{experiment.title or experiment.name}: what the data identify", fontsize=11)
    is_real = set(table["range"]) == {"real"}
    evaluation_point = "the nominal parameters" if is_real else "each target's true parameters"
    caption = (
        f"From the Fisher information at {evaluation_point} (Cramér–Rao bound). "
        f"Stiff: 1 sigma below {STIFF_SIGMA_THRESHOLD:g} of the training width (dashed). "
        "Right: mean over targets of the squared component."
    )
    add_caption(figure, caption, letters=15)
    return figure


def _draw_spectra(axis: Axes, table: pd.DataFrame, directions: int) -> None:
    """Draw every target's smallest possible standard error (1 sigma) along each direction.

    A direction is a combination of parameters; stiff ones are determined by the data, sloppy ones
    are not. The ranges of targets are drawn side by side.
    """
    ranges = list(dict.fromkeys(table["range"]))
    for range_index, (kind, (marker, colour)) in enumerate(
        zip(ranges, _RANGE_MARKERS, strict=False)
    ):
        range_rows = table[table["range"] == kind]
        targets = range_rows["target"].nunique()
        # Markers of one direction lie side by side within 0.3, the ranges 0.4 apart.
        target_indices = range_rows.groupby("direction").cumcount()
        target_offsets = (
            (target_indices / (targets - 1) - 0.5) * 0.3 if targets > 1 else 0.0 * target_indices
        )
        x_values = (
            range_rows["direction"] + target_offsets + (range_index - 0.5 * (len(ranges) - 1)) * 0.4
        )
        axis.plot(
            x_values,
            # A direction without effect on the data has an infinite sigma and is drawn at the edge.
            range_rows["sigma"].clip(_MIN_DRAWN_SIGMA, _MAX_DRAWN_SIGMA),
            marker,
            color=colour,
            markersize=3.5,
            alpha=0.75,
            linestyle="none",
            label=_RANGE_LABELS.get(kind, kind) + ("" if kind == "real" else f" (n = {targets})"),
        )
    axis.axhline(STIFF_SIGMA_THRESHOLD, color=CAPTION_GREY, linewidth=0.8, linestyle="--")
    for name, text_offset in (("sloppy", 3), ("stiff", -9)):
        axis.annotate(
            name,
            (0.01, STIFF_SIGMA_THRESHOLD),
            (0, text_offset),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            fontsize=8,
        )
    axis.set_yscale("log")
    # Extra space for the legend.
    axis.set_ylim(bottom=axis.get_ylim()[0] / 10)
    axis.set_xticks(range(1, directions + 1))
    axis.set_xlabel("direction, the stiffest first")
    axis.set_ylabel("smallest possible 1 sigma of an estimate\n[training widths]")
    style_axis(axis)
    axis.legend(fontsize=7.5, frameon=False, loc="lower right")


def _draw_direction_shares(axis: Axes, table: pd.DataFrame, names: list[str]) -> None:
    """Draw the shares of the parameters in each direction, as a grid of numbers."""
    # A direction has length 1: its squared components are shares, independent of their signs.
    squares = table.set_index("direction")[names] ** 2
    shares = squares.groupby(level=0).mean().to_numpy().T
    axis.imshow(shares, cmap="Greys", vmin=0.0, vmax=1.0, aspect="auto")
    for row, column in np.argwhere(shares >= _MIN_LABELLED_SHARE):
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
