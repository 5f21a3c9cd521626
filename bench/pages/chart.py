"""Charts as data: what the page's own script draws from a table that lies in the page.

A chart has panels, a panel has series, and a series names columns of a table (a CSV text in the
page): what is drawn, what is shown at the cursor and what can be saved as CSV are the same numbers.
In addition the page holds the same figure as matplotlib draws it: for print, without JavaScript,
and to be saved as SVG and PNG, and as PDF where one was asked for.
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
        holds: values that the range of the data is widened to.
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
        under: points beneath the lines, and not upon them.
    """

    name: str
    y: str
    look: Look
    where: Mapping[str, str] = field(default_factory=dict)
    low: str = ""
    high: str = ""
    draw: Draw = "line"
    shift: float = 0.0
    under: bool = False


@dataclass(frozen=True)
class Tell:
    """A line of what is said at the cursor: the number of a column, with its unit, and the same
    once more in another unit.

    Attributes:
        says: what it is.
        y: column of the panel's table.
        unit: of the column; empty for a pure number.
        look: beside it; None for none.
        times: factor to the other unit; 0 for none.
        also: the other unit.
    """

    says: str
    y: str
    unit: str = ""
    look: Look | None = None
    times: float = 0.0
    also: str = ""


@dataclass(frozen=True)
class Rule:
    """A line across a panel at a value of one axis, with a few words."""

    value: float
    says: str
    along: Literal["x", "y"] = "y"


@dataclass(frozen=True)
class Span:
    """A part of an axis: ground behind the curves, or a strip at their foot.

    Attributes:
        low: where it begins.
        high: where it ends.
        says: what it stands for.
        look: its colour; grey where None.
        foot: a strip at the foot of the panel, and not the whole height.
        along: which axis it is a part of.
    """

    low: float
    high: float
    says: str
    look: Look | None = None
    foot: bool = False
    along: Literal["x", "y"] = "x"


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
        spans: parts of its axes.
        tells: what is said at the cursor, of rows as those of the first series; the series
            themselves where empty.
        height: pixels; by its width where 0.
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
    tells: tuple[Tell, ...] = ()
    height: int = 0


@dataclass(frozen=True)
class Static:
    """The same figure as it is printed.

    Attributes:
        image: the bytes of an SVG or PNG file, which the page shows.
        pdf: the bytes of a PDF file; None where none was asked for.
        alternative: what it shows, for those who do not see it.
        file: name of its files without an ending.
    """

    image: bytes
    pdf: bytes | None
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
        static: the same as it is printed; None where there is none: the figure is then there with
            the script alone.
        beside: the facet whose panels stand side by side at first; of every other one panel shows.
        link: charts with the same text move their cursors and horizontal zoom together.
        columns: panels side by side where there is room; as many as fit where 0.
        along: zoom the horizontal axis alone; the vertical one follows what is in sight.
        toggles: facets whose panels are switched on and off one by one.
        off: values of toggles that are off at first.
        lights: the facet by which panels light up together with whatever in the page bears the same
            name.
        notes: what the legend says behind a name.
    """

    name: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    static: Static | None = None
    beside: str = ""
    link: str = ""
    columns: int = 0
    along: bool = False
    toggles: tuple[str, ...] = ()
    off: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    lights: str = ""
    notes: Mapping[str, str] = field(default_factory=dict)

    def spec(self) -> dict[str, Any]:
        """What the page's script is told, as JSON holds it."""
        return {
            "name": self.name,
            "title": self.title,
            "panels": [asdict(panel) for panel in self.panels],
            "beside": self.beside,
            "link": self.link,
            "columns": self.columns,
            "along": self.along,
            "toggles": self.toggles,
            "off": self.off,
            "lights": self.lights,
            "notes": dict(self.notes),
        }
