"""How figures of comparisons look: palette, markers, canvas, legend, and how they are saved.

Made for print: every tuner has its own marker and line style beside its colour, colours differ in
lightness.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bench.problem.experiment import Experiment

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Okabe and Ito's colours, safe for colour-blind readers, in an order that alternates dark and
# light.
_COLOURS = (
    "#000000",
    "#E69F00",
    "#0072B2",
    "#56B4E9",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#7F7F7F",
    "#5B3A8E",
    "#A6761D",
)


_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")


_LINES = (
    "-",
    "--",
    "-.",
    (0, (1, 1)),
    (0, (5, 1)),
    (0, (3, 1, 1, 1)),
    (0, (6, 1, 1, 1, 1, 1)),
    (0, (8, 2)),
)


FLOOR = 1e-9
"""Errors below this are drawn here: less than rounding in the observation."""


CAPTION = (
    "Line: median over targets of the recommendation's error (mean over seeds). Band or bar: 95 % bootstrap interval "
    f"of the median. Errors below {FLOOR:g} are drawn there."
)


TITLES = {
    "in": "Targets in the training range",
    "wide": "Targets anywhere in the bounds",
    "obs_error": "Runs tuned on",
    "heldout_error": "Held-out runs, open loop",
}


class Styles:
    """Colour, marker and line of each tuner: fixed by its place in the experiment, listed by its
    final error.
    """

    def __init__(self, experiment: Experiment, runs: pd.DataFrame, metric: str) -> None:
        present = set(runs["tuner"].unique())
        self._places = {e.label: i for i, e in enumerate(experiment.tuners) if e.label in present}
        last = (
            runs.drop_duplicates("run", keep="last").groupby("tuner")[metric].median()
        )  # rows stand in order of k
        self.order: Sequence[str] = sorted(
            self._places, key=lambda label: float(last.get(label, np.inf))
        )

    def of(self, tuner: str) -> dict[str, Any]:
        """Keyword arguments for plotting `tuner`."""
        i = self._places[tuner]
        return {
            "color": _COLOURS[i % len(_COLOURS)],
            "marker": _MARKERS[i % len(_MARKERS)],
            "linestyle": _LINES[i % len(_LINES)],
            "linewidth": 1.6,
            "label": tuner,
        }

    def offset(self, tuner: str) -> float:
        """A small shift along a category axis, so that error bars stand beside each other."""
        return (self._places[tuner] - (len(self._places) - 1) / 2) * 0.6 / max(len(self._places), 1)


def canvas(panels: int) -> tuple[Figure, list[Axes]]:
    """A figure with so many panels side by side, which share their vertical axis."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(
        1, panels, figsize=(1.2 + 4.3 * panels, 4.6), squeeze=False, sharey=True
    )
    for axis in axes[0]:
        axis.grid(visible=True, which="major", linewidth=0.4, alpha=0.5)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, list(axes[0])


def finish(
    figure: Figure,
    axes: list[Axes],
    style: Styles,
    experiment: Experiment,
    caption: str = CAPTION,
    heading: str = "best at the end first",
) -> None:
    """Legend, title and caption."""
    handles: dict[str, Any] = {}
    for axis in reversed(axes):  # a panel may lack a tuner that another has
        handles |= dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True))
    labels = [label for label in style.order if label in handles]
    figure.legend(
        [handles[label] for label in labels],
        labels,
        loc="outside right upper",
        title=heading,
        fontsize=9,
        title_fontsize=8,
        frameon=False,
        handlelength=3.2,
    )
    for axis in axes[1:]:
        if axis.get_ylabel() == axes[0].get_ylabel():
            axis.set_ylabel("")
    figure.suptitle(experiment.title or experiment.name, fontsize=11)
    figure.supxlabel(
        textwrap.fill(caption, int(17 * figure.get_figwidth())), fontsize=7.5, color="#444444"
    )


def save(folder: Path, name: str, figure: Figure) -> Path:
    """Write a figure as PNG and PDF below `folder`/figures and close it; returns the PNG."""
    from matplotlib import pyplot as plt

    target = folder / "figures"
    target.mkdir(exist_ok=True)
    figure.set_layout_engine("constrained")
    figure.savefig(target / f"{name}.png", dpi=160)
    figure.savefig(target / f"{name}.pdf", metadata={"CreationDate": None})
    plt.close(figure)
    return target / f"{name}.png"
