"""Declarative chart specification: what the page's script draws from a table in the page.

A chart has panels, a panel has series, and a series names columns of a table (CSV text in the
page): the drawing, the values at the cursor and the saved CSV contain the same numbers. In
addition, the page contains the same figure drawn by Matplotlib: for print, for use without
JavaScript, and to be saved as SVG and PNG, and as PDF if requested.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

from bench.figures.style import MarkStyle, compute_category_offset

Scale = Literal["linear", "log", "symlog"]
"""Scale of an axis; symlog is linear from 0 to 1 and logarithmic above."""
SeriesKind = Literal["line", "steps", "points", "bars"]


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
            shift=compute_category_offset(index, len(styles)) if is_shifted else 0.0,
            **options,
        )
        for index, (name, look) in enumerate(styles.items())
    )


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
