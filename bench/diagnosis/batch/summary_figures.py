"""Draw figures of many logs that are explained separately, one row per log."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.figures.style import (
    BLUE,
    CAPTION_GREY,
    VERMILION,
    add_caption,
    make_panel_grid,
    style_axis,
)
from bench.figures.text_layout import break_name, most_lines

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_NAMED_LOGS = 40
"""Maximum number of logs that are labelled with names; more are labelled with numbers."""
MAX_PANELS = 4
"""Maximum number of panels side by side."""
_NAME_LINE = 34
"""Maximum line length of a log's name, in characters."""
_TITLE_LINE = 34
"""Maximum line length of a panel's title, in characters."""
_PANEL = 2.8
"""Width of a panel in inches, enough for such a title."""
_LINE = 0.15
"""Height of a line in inches."""


def draw_held_out_figure(logs: pd.DataFrame) -> Figure:
    """Draw the error on held-out runs before and after, in units of the noise floor.

    Args:
        logs: One row per log: number, log, before, after; NaN where there is none.
    """
    from matplotlib.ticker import LogLocator, NullFormatter

    figure, ((panel,),) = make_panel_grid(1, 1, (7.5, _height(logs)))
    rows = logs["number"].to_numpy()
    before, after = logs["before"].to_numpy(), logs["after"].to_numpy()
    panel.hlines(rows, after, before, color=CAPTION_GREY, linewidth=0.8)
    # Hollow before, filled after: distinguishable in greyscale, too.
    hollow = {"color": VERMILION, "marker": "s", "markerfacecolor": "white"}
    panel.plot(before, rows, linestyle="", label="before: tuned simulation", **hollow)
    panel.plot(
        after, rows, linestyle="", color=BLUE, marker="o", label="after: with what was found"
    )
    panel.axvline(1.0, color=CAPTION_GREY, linestyle=":", linewidth=1.0)
    panel.set_xscale("log")
    panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    panel.xaxis.set_major_formatter("{x:g}")
    panel.xaxis.set_minor_formatter(NullFormatter())
    panel.set_xlabel("error on held-out runs [noise floors]")
    _rows(panel, logs)
    figure.legend(loc="outside upper center", ncols=2, fontsize=8, frameon=False)
    add_caption(figure, "Dotted: the noise floor, the best that any model can reach.", letters=17)
    return figure


def draw_numbers_figure(logs: pd.DataFrame, found: pd.DataFrame) -> Figure:
    """Draw each coefficient of each cause over the logs, with its 95 % interval.

    Args:
        logs: One row per log: number, log.
        found: One row per coefficient and log: number, what, value, low, high; the most common
            first, of which `MAX_PANELS` are drawn.
    """
    names = list(dict.fromkeys(found["what"]))[:MAX_PANELS]
    titles = [
        "\n".join(break_name(part, _TITLE_LINE) for part in name.rsplit(": ", 1)) for name in names
    ]
    height = _height(logs) + _LINE * most_lines(titles)
    figure, (panels,) = make_panel_grid(
        1, len(names), (max(7.5, 2.6 + _PANEL * len(names)), height), sharey=True
    )
    for panel, name, title in zip(panels, names, titles, strict=True):
        mine = found[found["what"] == name]
        value, low, high = (mine[key].to_numpy(float) for key in ("value", "low", "high"))
        lengths = np.maximum(np.nan_to_num([value - low, high - value]), 0.0)
        options = {"color": BLUE, "linestyle": "", "marker": "o", "markersize": 4, "capsize": 2}
        panel.errorbar(value, mine["number"], xerr=lengths, **options)
        panel.set_title(title, fontsize=8.5, y=1.0, loc="left", parse_math=False)
        panel.tick_params(axis="x", labelsize=8)
        panel.locator_params(axis="x", nbins=4)
        _rows(panel, logs)
    add_caption(figure, "Point: what a log gives by itself. Bar: its 95 % interval.", letters=17)
    return figure


def _names(logs: pd.DataFrame) -> list[str]:
    """Return the names of the logs, broken into lines."""
    # Matplotlib would read dollar signs as mathematics.
    return [break_name(str(name), _NAME_LINE).replace("$", r"\$") for name in logs["log"]]


def _height(logs: pd.DataFrame) -> float:
    lines = most_lines(_names(logs)) if len(logs) <= MAX_NAMED_LOGS else 1
    return 1.6 + min((0.09 + _LINE * lines) * len(logs), 9.0 * lines)


def _rows(panel: Axes, logs: pd.DataFrame) -> None:
    """Set the vertical axis to the logs from top to bottom, with names if there is space."""
    style_axis(panel)
    panel.set_ylim(logs["number"].max() + 0.6, logs["number"].min() - 0.6)
    if len(logs) <= MAX_NAMED_LOGS:
        panel.set_yticks(logs["number"], _names(logs), fontsize=8)
    else:
        panel.set_ylabel("log, by its number")
