"""Tables and figures of what data identify: spectra, directions, errors along them, and prediction."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from bench.analysis.spectra import COLUMNS
from bench.figures.errors import samples_panel
from bench.figures.style import CAPTION, TITLES, Styles, finish, save
from bench.problem.experiment import Experiment
from bench.problem.identifiability import STIFF

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FLOOR, _CEILING = (
    1e-6,
    1e4,
)  # 1 sigma in training ranges, beyond which a figure shows no difference
_WHERE = {"in": "truth in training range", "wide": "truth in bounds"}
_ROWS = {
    "stiff_error": "along stiff directions\n[training widths]",
    "sloppy_error": "along sloppy directions\n[training widths]",
    "heldout_error": "of prediction,\nRMSE of {channel}",
}


def identifiability_figures(
    folder: Path, experiment: Experiment, runs: pd.DataFrame, channel: str
) -> list[Path]:
    """Draw what there is: the spectra of identifiability.csv, and the errors along directions and
    of prediction.

    Args:
        folder: the comparison's.
        experiment: what was compared.
        runs: rows of runs.parquet.
        channel: the error channel with its unit, e.g. ``q [rad]``.
    """
    table = folder / "identifiability.csv"
    made = [spectra_figure(folder, experiment, pd.read_csv(table))] if table.is_file() else []
    return made + errors_figure(folder, experiment, runs, channel)


def spectra_figure(folder: Path, experiment: Experiment, table: pd.DataFrame) -> Path:
    """Left: 1 sigma of every direction, a mark a target. Right: which parameters make up each
    direction.
    """
    from matplotlib import pyplot as plt

    names = [c for c in table.columns if c not in COLUMNS]
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(4.8 + 0.8 * len(names), 2.2 + 0.4 * len(names)), width_ratios=[1, 1.25]
    )
    _spectra(left, table, len(names))
    _directions(right, table, names)
    figure.suptitle(f"{experiment.title or experiment.name}: what the data can know", fontsize=11)
    caption = (
        "From the Fisher information at each target's truth (Cramér–Rao bound). "
        f"Stiff: 1 sigma below {STIFF:g} of the training width (dashed). Right: mean over targets of the squared "
        "component."
    )
    figure.supxlabel(
        textwrap.fill(caption, int(15 * figure.get_figwidth())), fontsize=7.5, color="#444444"
    )
    return save(folder, "identifiability", figure)


def _spectra(axis: Axes, table: pd.DataFrame, dim: int) -> None:
    """Every target's 1 sigma along each direction, the ranges beside each other."""
    ranges = list(dict.fromkeys(table["range"]))
    for place, (kind, look) in enumerate(
        zip(ranges, (("o", "#0072B2"), ("^", "#D55E00")), strict=False)
    ):
        part = table[table["range"] == kind]
        spread = (
            part.groupby("direction").cumcount() / max(part["target"].nunique() - 1, 1) - 0.5
        ) * 0.3
        sigma = part["sigma"].clip(_FLOOR, _CEILING)
        label = f"{_WHERE.get(kind, kind)} (n = {part['target'].nunique()})"
        across = part["direction"] + spread + (place - 0.5 * (len(ranges) - 1)) * 0.4
        axis.plot(
            across,
            sigma,
            look[0],
            color=look[1],
            markersize=3.5,
            alpha=0.75,
            linestyle="none",
            label=label,
        )
    axis.axhline(STIFF, color="#444444", linewidth=0.8, linestyle="--")
    for name, above in (("sloppy", 3), ("stiff", -9)):
        axis.annotate(
            name,
            (0.01, STIFF),
            (0, above),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            fontsize=8,
        )
    axis.set_yscale("log")
    axis.set_ylim(bottom=axis.get_ylim()[0] / 10)  # room for the legend
    axis.set_xticks(range(1, dim + 1))
    axis.set_xlabel("direction, the stiffest first")
    axis.set_ylabel("1 sigma that no estimate can beat\n[training widths]")
    axis.grid(visible=True, which="major", linewidth=0.4, alpha=0.5)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(fontsize=7.5, frameon=False, loc="lower right")


def _directions(axis: Axes, table: pd.DataFrame, names: list[str]) -> None:
    """Shares of the parameters in each direction, as a grid of numbers."""
    shares = (table.set_index("direction")[names] ** 2).groupby(level=0).mean().to_numpy().T
    axis.imshow(shares, cmap="Greys", vmin=0.0, vmax=1.0, aspect="auto")
    for row, column in np.argwhere(shares >= 0.05):
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


def errors_figure(
    folder: Path, experiment: Experiment, runs: pd.DataFrame, channel: str
) -> list[Path]:
    """Errors along stiff and along sloppy directions, and of prediction, against simulations; a
    column a range.

    Nothing where the runs have none of them, or are those of a recording, which has a figure of its
    own.
    """
    from matplotlib import pyplot as plt

    present = [m for m in _ROWS if m in runs and runs[m].notna().any()]
    if not present or "real" in experiment.ranges:
        return []
    ranges = [r for r in experiment.ranges if (runs["range"] == r).any()]
    figure, axes = plt.subplots(
        len(present),
        len(ranges),
        figsize=(1.8 + 4.0 * len(ranges), 1.2 + 2.3 * len(present)),
        squeeze=False,
        sharey="row",
        sharex=True,
    )
    style = Styles(experiment, runs, present[0])
    for row, metric in zip(axes, present, strict=True):
        for axis, kind in zip(row, ranges, strict=True):
            part = runs[(runs["range"] == kind) & runs[metric].notna()]
            axis.grid(visible=True, which="major", linewidth=0.4, alpha=0.5)
            axis.spines[["top", "right"]].set_visible(False)
            if part.empty:
                axis.text(
                    0.5, 0.5, "no target has any", ha="center", transform=axis.transAxes, fontsize=8
                )
                continue
            samples_panel(axis, part, metric, experiment.budget, style)
            axis.set_title(f"{TITLES[kind]} ({part['target'].nunique()} targets)", fontsize=9)
            axis.set_ylabel(
                "error " + _ROWS[metric].format(channel=channel) + "\nmedian"
                if axis is row[0]
                else "",
                fontsize=9,
            )
            if metric != present[-1]:
                axis.set_xlabel("")
    finish(
        figure,
        [a for row in axes for a in row],
        style,
        experiment,
        CAPTION + " A sloppy direction is one that the target's data do not fix.",
    )
    return [save(folder, "stiff-sloppy-prediction", figure)]
