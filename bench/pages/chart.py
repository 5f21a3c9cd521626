"""Charts of pages: their declarative specification, and the same charts drawn by Matplotlib.

A chart has panels, a panel has series, and a series names columns of a table (CSV text in the
page): the page's script draws it, so that the drawing, the values at the cursor and the saved CSV
contain the same numbers. In addition, the page contains the same figure drawn by Matplotlib: for
print, for use without JavaScript, and to be saved as SVG and PNG, and as PDF if requested. Of a
chart's facets, this printed figure has what the page shows at first.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from bench.figures.figure_layout import make_panel_grid, set_title, style_axis
from bench.figures.label_text import break_name
from bench.figures.style import CAPTION_GREY, NOISE_BAND_GREY, MarkStyle
from sims.core.simulator import Array

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bench.pages.page_table import Table

Scale = Literal["linear", "log", "symlog"]
"""Scale of an axis; symlog is linear from 0 to 1 and logarithmic above."""
SeriesKind = Literal["line", "steps", "points", "bars"]
Tables = Mapping[str, "pd.DataFrame | Table"]
"""Tables by name, from which the panels of a chart are drawn."""
PANEL_SIZE = (4.3, 4.0)
"""Width and height of a printed panel in inches."""
_FOOT_SHARE = 0.035
"""Height of a strip at the bottom of a panel, as a share of the panel."""
_FOOT_MARGIN = 0.12
"""Margin above and below the series that keeps them off a strip and its name, as their share."""
_MIN_NAMED_DECADES = 1.5
"""Minimum width of a strip that has its name, in decades of a logarithmic axis."""
_NAME_LINE = 34
"""Maximum line length of a category's name in print, in characters."""
_MARKED_POINTS = 11
"""Approximate number of markers on a line whose axis has no ticks of its own."""


@dataclass(frozen=True)
class Axis:
    """One axis of a panel.

    Attributes:
        label: Label with unit, e.g. ``speed [m/s]``.
        scale: Initial scale, which a reader may change unless the axis has categories.
        scales: Scales from which a reader may choose.
        ticks: Tick positions; empty for automatic ones.
        names: Names of categories at 0, 1, 2, ...; empty for numbers.
        ends: Initial range; None for the range of the data.
        holds: Values that the range of the data is extended to include.
    """

    label: str
    scale: Scale = "linear"
    scales: tuple[Scale, ...] = ("linear", "log")
    ticks: tuple[float, ...] = ()
    names: tuple[str, ...] = ()
    ends: tuple[float, float] | None = None
    holds: tuple[float, ...] = ()


@dataclass(frozen=True)
class Series:
    """One line, staircase, set of points or row of bars.

    Attributes:
        name: Name in the legend; all series of one name on the page are switched on and off
            together.
        y: Column of the table.
        look: Colour, dashes and marker.
        where: Texts by column that select the rows.
        low: Column of the interval's lower end; empty for none.
        high: Column of the interval's upper end; empty for none.
        draw: Kind of drawing.
        shift: Shift along a category axis that places marks of several series side by side.
        under: Whether points are drawn below the lines instead of above.
    """

    name: str
    y: str
    look: MarkStyle
    where: Mapping[str, str] = field(default_factory=dict)
    low: str = ""
    high: str = ""
    draw: SeriesKind = "line"
    shift: float = 0.0
    under: bool = False


def make_method_series(
    styles: Mapping[str, MarkStyle],
    column: str,
    y: str,
    *,
    is_shifted: bool = False,
    where: Mapping[str, str] | None = None,
    **options: Any,
) -> tuple[Series, ...]:
    """Make a series for each of the compared methods.

    Args:
        styles: Methods in the order of the legend, each with its style.
        column: Column with the names of the methods.
        y: Column that is drawn.
        is_shifted: Whether marks of several methods in one category lie side by side.
        where: Texts by column that select the rows of all series.
        **options: Further attributes of `Series`.
    """
    return tuple(
        Series(
            name,
            y,
            look,
            {column: name, **(where or {})},
            shift=_compute_category_offset(index, len(styles)) if is_shifted else 0.0,
            **options,
        )
        for index, (name, look) in enumerate(styles.items())
    )


def _compute_category_offset(place: int, count: int) -> float:
    """Compute a small shift along a category axis that places points side by side.

    The points of one category are spread over 0.6 of its width.

    Args:
        place: place of the point among those of the category.
        count: number of these points.
    """
    return (place - (count - 1) / 2) * 0.6 / count


@dataclass(frozen=True)
class TooltipLine:
    """A line of the text at the cursor: the value of a column, optionally also in another unit.

    Attributes:
        says: Description of the value.
        y: Column of the panel's table.
        unit: Unit of the column; empty for a pure number.
        look: Style of the mark next to it; None for no mark.
        times: Conversion factor to the other unit; 0 for no other unit.
        also: The other unit.
    """

    says: str
    y: str
    unit: str = ""
    look: MarkStyle | None = None
    times: float = 0.0
    also: str = ""


@dataclass(frozen=True)
class ReferenceLine:
    """A line across a panel at a value of one axis, with a short text."""

    value: float
    says: str
    along: Literal["x", "y"] = "y"


@dataclass(frozen=True)
class AxisSpan:
    """A part of an axis: a background behind the curves, or a strip below them.

    Attributes:
        low: Lower end.
        high: Upper end.
        says: Description.
        look: Style that gives its colour; None for grey.
        foot: Whether to draw a strip at the bottom of the panel instead of the whole height.
        along: Axis that it is a part of.
    """

    low: float
    high: float
    says: str
    look: MarkStyle | None = None
    foot: bool = False
    along: Literal["x", "y"] = "x"


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    Attributes:
        title: Title above the panel.
        table: Name of the table in the page.
        x: Column of the horizontal coordinate.
        series: Series in the order of the legend.
        across: Horizontal axis.
        up: Vertical axis.
        facets: Values that distinguish it from other panels, e.g. ``{"targets": "in the training
            range"}``; a reader chooses among them.
        rules: Lines across the panel.
        spans: Parts of its axes.
        tells: Lines of the text at the cursor, for rows of the first series; empty for the series
            themselves.
        height: Height in pixels; 0 to derive it from the width.
    """

    title: str
    table: str
    x: str
    series: tuple[Series, ...]
    across: Axis
    up: Axis
    facets: Mapping[str, str] = field(default_factory=dict)
    rules: tuple[ReferenceLine, ...] = ()
    spans: tuple[AxisSpan, ...] = ()
    tells: tuple[TooltipLine, ...] = ()
    height: int = 0


@dataclass(frozen=True)
class PrintedFigure:
    """A printed version of a figure.

    Attributes:
        image: Bytes of an SVG or PNG file, which the page shows.
        pdf: Bytes of a PDF file; None if not requested.
        alternative: Text description for readers who cannot see the figure.
        file: Name of its files without extension.
    """

    image: bytes
    pdf: bytes | None
    alternative: str
    file: str

    @property
    def kind(self) -> str:
        """Subtype of the image's media type."""
        return "png" if self.image.startswith(b"\x89PNG") else "svg+xml"


@dataclass(frozen=True)
class Chart:
    """A figure of the page.

    Attributes:
        name: Name in the page's address and ids: letters, digits and hyphens.
        title: Title above the figure.
        panels: Panels; those side by side share axes with the same label.
        static: Printed version; None if there is none, then the figure needs the script.
        side_by_side: Facet whose panels are initially side by side; of every other facet one panel
            is shown.
        link: Charts with the same text share their cursors and horizontal zoom.
        columns: Number of panels side by side if there is space; 0 for as many as fit.
        along: Whether to zoom the horizontal axis only; the vertical axis follows the visible data.
        toggles: Facets whose panels are switched on and off one by one.
        off: Values of toggles that are initially off.
        lights: Facet by which panels are highlighted together with everything of the same name on
            the page.
        notes: Texts after names in the legend.
    """

    name: str
    title: str
    panels: tuple[Panel, ...]
    static: PrintedFigure | None = None
    side_by_side: str = ""
    link: str = ""
    columns: int = 0
    along: bool = False
    toggles: tuple[str, ...] = ()
    off: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    lights: str = ""
    notes: Mapping[str, str] = field(default_factory=dict)

    def build_spec(self) -> dict[str, Any]:
        """Build the chart's JSON specification for the page's script."""
        spec = {attribute.name: getattr(self, attribute.name) for attribute in fields(self)}
        del spec["static"]
        return spec | {"panels": [asdict(panel) for panel in self.panels]}


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
