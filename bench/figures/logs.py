"""Figures of many logs that are explained each by itself: a row a log."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.figures.style import BLUE, SOFT, VERMILION, below, blank, plain, titled

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NAMED = 40
"""Logs that stand with their names; more have their number."""
PANELS = 4
"""Numbers that are drawn side by side."""


def held_out(logs: pd.DataFrame) -> Figure:
    """The error on held-out runs before and after, in noise floors.

    Args:
        logs: a row a log: number, log, before, after; NaN where there is none.
    """
    figure, ((panel,),) = blank(1, 1, (7.5, _height(logs)))
    rows = logs["number"].to_numpy()
    before, after = logs["before"].to_numpy(), logs["after"].to_numpy()
    panel.hlines(rows, after, before, color=SOFT, linewidth=0.8)
    # Hollow before, filled after: told apart in grey too.
    hollow = {"color": VERMILION, "marker": "s", "markerfacecolor": "white"}
    panel.plot(before, rows, linestyle="", label="before: tuned simulation", **hollow)
    panel.plot(
        after, rows, linestyle="", color=BLUE, marker="o", label="after: with what was found"
    )
    panel.axvline(1.0, color=SOFT, linestyle=":", linewidth=1.0)
    panel.set_xscale("log")
    panel.set_xlabel("error on held-out runs [noise floors]")
    _rows(panel, logs)
    figure.legend(loc="outside upper center", ncols=2, fontsize=8, frameon=False)
    below(figure, "Dotted: the noise floor, the best that any model can reach.", letters=17)
    return figure


def numbers(logs: pd.DataFrame, found: pd.DataFrame) -> Figure:
    """Each number of each cause over the logs, with its 95 % interval.

    Args:
        logs: a row a log: number, log.
        found: a row a number of a log: number, what, value, low, high; the commonest first, of
            which `PANELS` are drawn.
    """
    names = list(dict.fromkeys(found["what"]))[:PANELS]
    width = max(7.5, 2.2 + 2.6 * len(names))
    figure, (panels,) = blank(1, len(names), (width, _height(logs)), sharey=True)
    for panel, name in zip(panels, names, strict=True):
        mine = found[found["what"] == name]
        value, low, high = (mine[key].to_numpy(float) for key in ("value", "low", "high"))
        lengths = np.maximum(np.nan_to_num([value - low, high - value]), 0.0)
        options = {"color": BLUE, "linestyle": "", "marker": "o", "markersize": 4, "capsize": 2}
        panel.errorbar(value, mine["number"], xerr=lengths, **options)
        titled(panel, name.replace(": ", ":\n"))
        panel.tick_params(axis="x", labelsize=8)
        _rows(panel, logs)
    below(figure, "Point: what a log gives by itself. Bar: its 95 % interval.", letters=17)
    return figure


def _height(logs: pd.DataFrame) -> float:
    return 1.6 + min(0.24 * len(logs), 9.0)


def _rows(panel: Axes, logs: pd.DataFrame) -> None:
    """The logs from above down, by name where there is room."""
    plain(panel)
    panel.set_ylim(logs["number"].max() + 0.6, logs["number"].min() - 0.6)
    if len(logs) <= NAMED:
        panel.set_yticks(logs["number"], [_short(name) for name in logs["log"]], fontsize=8)
    else:
        panel.set_ylabel("log, by its number")


def _short(name: str) -> str:
    # Dollars would be mathematics to whoever draws the text.
    plain_name = str(name).replace("$", r"\$")
    return plain_name if len(plain_name) <= 28 else f"…{plain_name[-27:]}"
