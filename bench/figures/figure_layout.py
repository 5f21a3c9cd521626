"""Layout of figures: panels, titles, axes and captions, drawn by Matplotlib.

No figure is made by pyplot, so that a notebook's backend, settings and open figures are unchanged.
"""

from __future__ import annotations

import textwrap
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from bench.figures.style import CAPTION_GREY

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRUSTED_TUNERS_NOTE = (
    "trusted: the tuners ran without isolation and could have read the true parameters"
)
"""Warning for results whose tuners were not isolated."""


def make_panel_grid(
    rows: int,
    columns: int,
    size: tuple[float, float],
    layout: Any = "constrained",
    **options: Any,
) -> tuple[Figure, Any]:
    """Make a figure and its (rows, columns) panels without pyplot.

    Args:
        rows: Number of rows of panels.
        columns: Number of columns of panels.
        size: Width and height in inches.
        layout: Matplotlib's layout engine; None if the margins are set by hand.
        **options: Options of `matplotlib.figure.Figure.subplots`.
    """
    # Matplotlib takes most of a second to load, and most commands draw nothing.
    from bench.figures.notebook_figure import NotebookFigure

    figure = NotebookFigure(figsize=size, layout=layout)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


@contextmanager
def apply_settings(settings: Mapping[Any, Any]) -> Iterator[None]:
    """Apply settings of Matplotlib while figures are drawn or written; hide missing glyphs."""
    from matplotlib import rc_context

    with rc_context(dict(settings)), warnings.catch_warnings():
        # A title may be in any script; characters that the font lacks are drawn as boxes.
        warnings.filterwarnings("ignore", message="Glyph")
        yield


def set_title(axis: Axes, title: str) -> None:
    """Set a title above a panel that has no ticks there."""
    # Without a fixed position, every drawing measures all ticks for the title.
    axis.set_title(title, fontsize=10, y=1.0)


def style_axis(axis: Axes) -> None:
    """Draw a faint grid, and remove the frame at the top and right."""
    axis.grid(visible=True, which="major", linewidth=0.4, alpha=0.5)
    axis.spines[["top", "right"]].set_visible(False)


def add_caption(figure: Figure, caption: str, letters: int) -> None:
    """Add a caption below a figure, with `letters` characters per inch of its width."""
    lines = textwrap.fill(caption, int(letters * figure.get_figwidth()))
    figure.supxlabel(lines, fontsize=7.5, color=CAPTION_GREY)


def add_trust_note(figure: Figure, trusted: bool) -> Figure:
    """Mark a figure in its title and caption if its tuners were not isolated, and return it.

    Args:
        figure: figure of Matplotlib.
        trusted: whether the tuners ran without isolation.
    """
    if trusted:
        figure.suptitle(f"{figure.get_suptitle()} (trusted)", fontsize=11)
        add_caption(
            figure, f"{TRUSTED_TUNERS_NOTE.capitalize()}. {figure.get_supxlabel()}", letters=17
        )
    return figure


def finish_chart(
    figure: Figure,
    axis: Axes,
    title: str = "",
    caption: str = "",
    legend: Any = "outside right center",
) -> Figure:
    """Add the legend, title and caption to a figure of a chart, and return it.

    Args:
        figure: Figure of `draw_chart`.
        axis: Panel whose series are in the legend, if there are several.
        title: Title; empty for none.
        caption: Caption; empty for none.
        legend: Location of the legend.
    """
    handles, labels = axis.get_legend_handles_labels()
    if len(labels) > 1:
        # Handles of this length show the dashes of a line.
        figure.legend(handles, labels, loc=legend, fontsize=8, frameon=False, handlelength=3.2)
    if title:
        figure.suptitle(title, fontsize=11)
    if caption:
        add_caption(figure, caption, letters=16)
    return figure
