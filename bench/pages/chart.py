"""Charts as data: what the page's own script draws from a table that lies in the page.

A chart has panels, a panel has series, and a series names columns of a table (a CSV text in the
page): what is drawn, what is shown at the cursor and what can be saved as CSV are the same numbers.
Beside it stands the same figure as matplotlib draws it: for print, without JavaScript, and as SVG,
PNG and PDF to take away.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from bench.figures.style import Look

Scale = Literal["linear", "log", "symlog"]
"""Of an axis; symlog is linear from 0 to 1 and logarithmic beyond."""
Draw = Literal["line", "steps", "points", "bars"]


@dataclass(frozen=True)
class Axis:
    """One axis of a panel.

    Attributes:
        label: with its unit, e.g. ``speed [m/s]``.
        scale: at first; a reader may change it, but for categories.
        scales: that a reader may choose from.
        ticks: where there are ticks, if somewhere in particular.
        names: of categories at 0, 1, 2, ...; empty for numbers.
        ends: the range shown at first; that of the data where None.
    """

    label: str
    scale: Scale = "linear"
    scales: tuple[Scale, ...] = ("linear", "log")
    ticks: tuple[float, ...] = ()
    names: tuple[str, ...] = ()
    ends: tuple[float, float] | None = None


@dataclass(frozen=True)
class Series:
    """One line, staircase, cloud or row of bars.

    Attributes:
        name: in the legend; series of one name are switched on and off together, in the whole page.
        y: column of the table.
        look: colour, dashes and marker.
        where: only rows with these texts in these columns.
        low: column of the interval's lower end; empty for none.
        high: column of its upper end.
        draw: how.
        shift: along a category axis, so that marks of several series stand side by side.
    """

    name: str
    y: str
    look: Look
    where: Mapping[str, str] = field(default_factory=dict)
    low: str = ""
    high: str = ""
    draw: Draw = "line"
    shift: float = 0.0


@dataclass(frozen=True)
class Rule:
    """A line across a panel at a value of one axis, with a few words."""

    value: float
    says: str
    along: Literal["x", "y"] = "y"


@dataclass(frozen=True)
class Span:
    """A part of the horizontal axis: ground behind the curves, or a strip at their foot.

    Attributes:
        low: where it begins.
        high: where it ends.
        says: what it stands for.
        look: its colour; grey where None.
        foot: a strip at the foot of the panel, and not the whole height.
    """

    low: float
    high: float
    says: str
    look: Look | None = None
    foot: bool = False


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    Attributes:
        title: above it.
        table: name of the table in the page that it draws.
        x: column of the table.
        series: in the order of the legend.
        across: horizontal axis.
        up: vertical axis.
        facets: what tells it from the other panels, e.g. ``{"targets": "in the training range"}``;
            a reader chooses among values.
        rules: lines across it.
        spans: parts of the horizontal axis.
    """

    title: str
    table: str
    x: str
    series: tuple[Series, ...]
    across: Axis
    up: Axis
    facets: Mapping[str, str] = field(default_factory=dict)
    rules: tuple[Rule, ...] = ()
    spans: tuple[Span, ...] = ()


@dataclass(frozen=True)
class Static:
    """The same figure as it is printed.

    Attributes:
        svg: the bytes of an SVG file.
        pdf: the bytes of a PDF file.
        alternative: what it shows, for those who do not see it.
        file: name of its files without an ending.
    """

    svg: bytes
    pdf: bytes
    alternative: str
    file: str


@dataclass(frozen=True)
class Chart:
    """A figure of the page.

    Attributes:
        name: in the page's address and ids: letters, digits and hyphens.
        title: above it.
        caption: how to read it; safe HTML.
        panels: of which those side by side share their axes where these have the same label.
        static: the same as it is printed; None where there is none.
        beside: the facet whose panels stand side by side at first; of every other one panel shows.
        link: charts with the same text move their cursors and horizontal zoom together.
    """

    name: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    static: Static | None = None
    beside: str = ""
    link: str = ""

    def spec(self) -> dict[str, Any]:
        """What the page's script is told, as JSON holds it."""
        return {
            "name": self.name,
            "title": self.title,
            "panels": [asdict(panel) for panel in self.panels],
            "beside": self.beside,
            "link": self.link,
        }
