"""Draw a chart of a page with Matplotlib: the same panels, series and tables, for print.

Of a chart's facets, the printed figure has what the page shows at first.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.figures.label_text import break_name
from bench.figures.style import (
    CAPTION_GREY,
    NOISE_BAND_GREY,
    add_caption,
    make_panel_grid,
    set_title,
    style_axis,
)
from bench.pages.chart import Axis, AxisSpan, Panel, ReferenceLine, Series
from sims.core.simulator import Array

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bench.pages.page_table import Table

Tables = Mapping[str, "pd.DataFrame | Table"]
PANEL_SIZE = (4.3, 4.0)
"""Width and height of a panel in inches."""
_FOOT_SHARE = 0.035
"""Height of a strip at the bottom of a panel, as a share of the panel."""
_FOOT_MARGIN = 0.12
"""Margin above and below the series that keeps them off a strip and its name, as their share."""
_MIN_NAMED_DECADES = 1.5
"""Minimum width of a strip that has its name, in decades of a logarithmic axis."""
_NAME_LINE = 34
"""Maximum line length of a category's name, in characters."""
_MARKED_POINTS = 11
"""Approximate number of markers on a line whose axis has no ticks of its own."""


def select_first_panels(panels: Iterable[Panel], shown: Collection[str]) -> list[Panel]:
    """Select the panels of a printed figure, which cannot be switched as on a page.

    A facet is a property that distinguishes panels, such as the range of targets.

    Args:
        panels: Panels of the chart.
        shown: Facets of which all panels are shown; of every other facet the first value is shown.
    """
    panels = [panel for panel in panels if panel.series]
    if not panels:
        return []
    first = panels[0].facets
    return [
        panel
        for panel in panels
        if all(
            value == first.get(name) for name, value in panel.facets.items() if name not in shown
        )
    ]


def draw_chart(
    panels: Sequence[Panel],
    tables: Tables,
    columns: int = 0,
    size: tuple[float, float] | None = None,
    horizontal: bool = False,
) -> tuple[Figure, list[Axes]]:
    """Draw panels side by side, or in rows.

    Args:
        panels: Panels of the chart.
        tables: Tables of the panels, by name.
        columns: Number of panels in a row; 0 for all.
        size: Width and height of a panel in inches; None for `PANEL_SIZE`.
        horizontal: Whether to draw categories from top to bottom, and values from left to right.

    Returns:
        The figure without title, legend and caption, and its axes in the order of the panels.
    """
    # Without a panel, such as costs of tuners that never reach the error, the figure is empty.
    columns = columns or max(len(panels), 1)
    row_count = max(-(-len(panels) // columns), 1)  # rounded up
    width, height = size or PANEL_SIZE
    # Axes are shared if all panels declare the same ones.
    shared = all(
        panel.up == panels[0].up and (not horizontal or panel.across == panels[0].across)
        for panel in panels
    )
    figure, grid = make_panel_grid(
        row_count,
        columns,
        # Width and height in inches: margins and panels.
        (1.2 + width * columns, 0.6 + height * row_count),
        # Panels of one row share their vertical axis, unless all panels do.
        sharey=shared or ("row" if row_count > 1 and not horizontal else False),
        sharex=row_count > 1 and not horizontal,
    )
    axes = list(grid.flat)
    for axis in axes[len(panels) :]:
        axis.set_axis_off()
    for axis, panel in zip(axes, panels, strict=False):
        _draw_panel(axis, panel, tables[panel.table], horizontal)
    for i, axis in enumerate(axes[: len(panels)]):
        # Panels that share an axis have its label once.
        below = axes[i + columns] if i + columns < len(panels) else None
        if below is not None and axis.get_xlabel() == below.get_xlabel():
            axis.set_xlabel("")
        if i % columns and axis.get_ylabel() == axes[i - 1].get_ylabel():
            axis.set_ylabel("")
    for axis, panel in zip(axes, panels, strict=False):
        _draw_rules(axis, panel.rules, horizontal)
    return figure, axes[: len(panels)]


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


def _draw_panel(axis: Axes, panel: Panel, table: pd.DataFrame | Table, horizontal: bool) -> None:
    """Draw a panel of a chart: background spans, series, axes and title.

    Args:
        axis: axes of the figure.
        panel: the panel.
        table: values of the series.
        horizontal: exchange the axes, so that x runs upwards.
    """
    style_axis(axis)
    for span in panel.spans:
        _draw_span(axis, span)
    # A strip at the bottom needs space below the series.
    if any(span.foot for span in panel.spans):
        axis.margins(y=_FOOT_MARGIN)
    for series in panel.series:
        _draw_series(axis, panel, series, read_series(table, panel.x, series), horizontal)
    across, up = (panel.up, panel.across) if horizontal else (panel.across, panel.up)
    _format_axis(axis, across, "x")
    _format_axis(axis, up, "y", reverse=horizontal)
    set_title(axis, _escape_math(panel.title))


def _escape_math(text: str) -> str:
    """Escape dollar signs, which Matplotlib would read as mathematics."""
    return text.replace("$", r"\$")


def read_series(table: pd.DataFrame | Table, x: str, series: Series) -> dict[str, Array]:
    """Read the numbers of a series from its table.

    Args:
        table: Table of the panel.
        x: Column of the horizontal coordinate.
        series: The series.

    Returns:
        Columns ``x``, ``y``, and ``low`` and ``high`` if the series has an interval; NaN for
        missing values.
    """
    is_wanted = np.ones(len(table), dtype=bool)
    for name, text in series.where.items():
        is_wanted &= np.array([str(value) == text for value in table[name]], dtype=bool)
    names = {"x": x, "y": series.y}
    if series.low:
        names |= {"low": series.low, "high": series.high}
    return {key: _to_numbers(table[name])[is_wanted] for key, name in names.items()}


def _to_numbers(values: Iterable[Any]) -> Array:
    return np.array([np.nan if v is None or v == "" else float(v) for v in values], dtype=float)


def _draw_series(
    axis: Axes, panel: Panel, series: Series, values: Mapping[str, Array], horizontal: bool
) -> None:
    """Draw a series of N values as points with error bars, or as a line with a band.

    `ends` (2, N) has the lengths of the error bars below and above the points.

    Args:
        axis: axes of the figure.
        panel: panel of the series.
        series: the series with its style.
        values: arrays x and y (N,), and low and high (N,) if the series has an interval.
        horizontal: exchange the axes; only for points.
    """
    x, y = values["x"] + series.shift, values["y"]
    ends = None
    if "low" in values:
        # By rounding, a percentile interval may not contain the median; lengths must not be
        # negative. A single target has no interval.
        lengths = np.array([y - values["low"], values["high"] - y])
        ends = np.maximum(np.nan_to_num(lengths), 0.0)
    look: dict[str, Any] = {"color": series.look.colour, "label": series.name, "markersize": 4.5}
    if series.draw == "points":
        look |= {"marker": series.look.marker or "o", "linestyle": "none"}
        if horizontal:
            axis.errorbar(y, x, xerr=ends, elinewidth=0.8, capsize=1.5, **look)
        else:
            axis.errorbar(x, y, yerr=ends, elinewidth=0.8, capsize=1.5, **look)
        return
    # Markers only where tables have numbers; the line goes through all points. Matplotlib takes the
    # indices of the marked points, or a number n for every n-th point.
    ticks = panel.across.ticks
    marked = (
        np.flatnonzero(np.isin(x, ticks)).tolist() if ticks else max(1, len(x) // _MARKED_POINTS)
    )
    look |= {
        "marker": series.look.marker or None,
        "markevery": marked,
        "linestyle": (0, series.look.dashes) if series.look.dashes else "-",
        "linewidth": 1.6,
        "drawstyle": "steps-post" if series.draw == "steps" else "default",
        "zorder": 1.5 if series.under else 2.0,
    }
    axis.plot(x, y, **look)
    if "low" in values:
        band: dict[str, Any] = {"color": series.look.colour, "alpha": 0.13, "linewidth": 0}
        axis.fill_between(x, values["low"], values["high"], **band)


def _format_axis(axis: Axes, spec: Axis, which: str, reverse: bool = False) -> None:
    """Set label, scale, ticks and limits of one axis of a panel.

    Args:
        axis: axes of the panel.
        spec: label, scale and limits.
        which: ``x`` or ``y``.
        reverse: whether the first category is at the top.
    """
    axis.set(**{f"{which}label": _escape_math(spec.label)})
    set_ticks = axis.set_xticks if which == "x" else axis.set_yticks
    if spec.names:
        names = [
            "\n".join(_escape_math(break_name(line, _NAME_LINE)) for line in name.split("\n"))
            for name in spec.names
        ]
        set_ticks(range(len(names)), names, fontsize=8)
        ends = (-0.5, len(spec.names) - 0.5)
        axis.set(**{f"{which}lim": ends[::-1] if reverse else ends})
        return
    options = {"linthresh": 1, "linscale": 0.5} if spec.scale == "symlog" else {}
    (axis.set_xscale if which == "x" else axis.set_yscale)(spec.scale, **options)
    if spec.ticks:
        set_ticks(spec.ticks, [f"{tick:g}" for tick in spec.ticks])
        axis.minorticks_off()
    if spec.ends:
        axis.set(**{f"{which}lim": spec.ends})
    for value in spec.holds:
        # An invisible line extends the limits to this value.
        (axis.axvline if which == "x" else axis.axhline)(value, linewidth=0)


def _draw_span(axis: Axes, span: AxisSpan) -> None:
    """Draw a grey or coloured interval of an axis behind the series.

    A span with `foot` is a strip at the bottom of the panel, with its name above it if it is wide
    enough on the logarithmic axis.
    """
    colour = span.look.colour if span.look else NOISE_BAND_GREY
    if not span.foot:
        draw = axis.axvspan if span.along == "x" else axis.axhspan
        draw(span.low, span.high, color=colour, linewidth=0, zorder=0)
        return
    axis.axvspan(span.low, span.high, ymin=0.0, ymax=_FOOT_SHARE, color=colour, linewidth=0)
    if np.log10(span.high / span.low) > _MIN_NAMED_DECADES:
        # The geometric mean is the middle on a logarithmic axis.
        middle = (np.sqrt(span.low * span.high), _FOOT_SHARE + 0.01)
        position = ("data", "axes fraction")
        axis.annotate(span.says, middle, xycoords=position, ha="center", fontsize=7.5)


def _draw_rules(axis: Axes, rules: Sequence[ReferenceLine], horizontal: bool) -> None:
    """Draw dashed lines with their texts, unless they are outside the panel.

    Args:
        axis: axes of the panel.
        rules: the lines, each at a value of the x or of the y axis.
        horizontal: whether the axes of the panel are exchanged.
    """
    line: dict[str, Any] = {"color": CAPTION_GREY, "linewidth": 0.8, "linestyle": (0, (2, 2))}
    text: dict[str, Any] = {"textcoords": "offset points", "fontsize": 7.5}
    for rule in rules:
        # A line at a value of the x axis is vertical, unless the axes are exchanged.
        is_vertical = (rule.along == "x") != horizontal
        low, high = sorted(axis.get_xlim() if is_vertical else axis.get_ylim())
        if not low <= rule.value <= high:
            continue
        if is_vertical:
            axis.axvline(rule.value, **line)
            position: dict[str, Any] = {
                "xy": (rule.value, 0),
                "xycoords": ("data", "axes fraction"),
            }
            # The text is written up the line. In a horizontal figure it would cross the rows, so
            # that only its beginning up to the colon is written.
            says = rule.says.partition(":")[0] if horizontal else rule.says
            axis.annotate(says, xytext=(-9, 4), rotation=90, **position, **text)
        else:
            axis.axhline(rule.value, **line)
            position = {"xy": (0, rule.value), "xycoords": ("axes fraction", "data")}
            axis.annotate(rule.says, xytext=(4, -10), **position, **text)
