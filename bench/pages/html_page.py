"""Self-contained HTML pages: Jinja2 templates with the tables, charts and grids of their script.

Styles, scripts, tables and figures are inside the file, and its Content-Security-Policy forbids
every request and every script but its own. The page is complete without JavaScript: figures are
static then, and tables show their first rows.
"""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup, escape

from bench.figures.figure_output import FigureFiles
from bench.pages.chart import Chart, Panel, PrintedFigure
from bench.pages.page_table import INITIAL_ROWS, DataGrid, GridColumn, Table, select_initial_rows
from bench.pages.template import load_template

if TYPE_CHECKING:
    import pandas as pd


_PAGES_FOLDER = Path(__file__).parent
_CHART_LIBRARY = _PAGES_FOLDER / "vendor" / "uplot"
_SCRIPTS = (
    "text_format", "table_data", "view_state", "ticks", "theme", "plot_drawing", "panel",
    "downloads", "figure", "data_grid", "page",
)  # fmt: skip
"""Scripts in the order of their dependencies: a later one may use earlier ones."""


class HtmlPage:
    """A page whose template asks it for sections, charts, figures and grids."""

    def __init__(self, figures: Mapping[str, FigureFiles] | None = None, style: str = "") -> None:
        """Start an empty page; rendering the template adds its sections, charts and grids.

        `_tables` has each table as CSV text for the browser, `_frames` the tables from which the
        rows of grids are selected, and `_parts` the macros of the template `parts.html`.

        Args:
            figures: Drawn figures by the name of their files.
            style: CSS rules in addition to those of every page.
        """
        self._own_style = style
        self._figures = figures or {}
        self._sections: list[tuple[str, str]] = []
        self._tables: dict[str, str] = {}
        self._frames: dict[str, pd.DataFrame | Table] = {}
        self._charts: list[dict[str, Any]] = []
        self._grids: list[dict[str, Any]] = []
        self._parts: Any = load_template(Path("parts.html")).module

    def add_table(self, name: str, frame: pd.DataFrame | Table, digits: int | None = None) -> None:
        """Store a table in the page for charts and grids, to be saved as NAME.csv.

        Args:
            name: Name of the table.
            frame: Its rows.
            digits: Significant digits of its numbers; None for all.
        """
        self._frames[name] = frame
        number_format = None if digits is None else f"%.{digits}g"
        self._tables[name] = frame.to_csv(index=False, float_format=number_format)

    def add_tables(
        self, tables: Mapping[str, pd.DataFrame | Table], digits: int | None = None
    ) -> None:
        """Add the tables that have rows; `digits` is that of `add_table`."""
        for name, frame in tables.items():
            if len(frame):
                self.add_table(name, frame, digits)

    def printed_figure(self, name: str, alternative: str) -> PrintedFigure | None:
        """Return a drawn figure; None if it was not drawn.

        Args:
            name: Name of its files without extension.
            alternative: Text description for readers who cannot see it.
        """
        files = self._figures.get(name)
        return files and PrintedFigure(files.svg or files.png, files.pdf, alternative, name)

    def section(self, name: str, heading: str, caller: Callable[[], Markup]) -> Markup:
        """Return a section, and add it to the navigation; empty without content.

        Args:
            name: Name in the page's address: letters, digits and hyphens.
            heading: Title of the section.
            caller: Content, as the body of a template's call block.
        """
        content = Markup(caller().strip())
        if not content:
            return content
        self._sections.append((name, heading))
        return Markup(self._parts.section(name, heading, content))

    def chart(
        self,
        name: str,
        title: str,
        panels: Sequence[Panel],
        static: PrintedFigure | None = None,
        *,
        caller: Callable[[], Markup],
        **options: Any,
    ) -> Markup:
        """Return a chart whose tables are in the page.

        Args:
            name: Name in the page's address and ids: letters, digits and hyphens.
            title: Title above the figure.
            panels: Panels; without any there is no chart.
            static: Printed version; None if there is none, then the figure needs the script.
            caller: Caption, as the body of a template's call block.
            **options: Further attributes of `Chart`.
        """
        if not panels:
            return Markup()
        chart = Chart(name, title, tuple(panels), static, **options)
        self._charts.append(chart.build_spec())
        return Markup(self._parts.chart(chart, Markup(caller().strip())))

    def figure(
        self,
        name: str,
        drawn_figure: PrintedFigure | None,
        tables: Sequence[str] = (),
        markers: Sequence[tuple[str, float, float]] = (),
        *,
        caller: Callable[[], Markup],
    ) -> Markup:
        """Return the HTML of a drawn figure, with its caption and its files for download.

        Page templates call it for each figure that they may show. It returns nothing if the figure
        was not drawn, for example because its data do not exist.

        Args:
            name: Name in the page's address: letters, digits and hyphens.
            drawn_figure: The figure; None if it was not drawn.
            tables: Names of the page's tables with its numbers.
            markers: Names to highlight with their positions, as fractions of width and height from
                the top left.
            caller: Returns the caption. Jinja requires this name: it passes the body of a
                template's call block as this function.
        """
        if drawn_figure is None:
            return Markup()
        caption = Markup(caller().strip())
        return Markup(self._parts.figure(name, drawn_figure, caption, tables, markers))

    def grid(
        self, name: str, title: str, table: str, columns: Sequence[Any], **options: Any
    ) -> Markup:
        """Return a grid whose table is in the page; empty if the table is not.

        Args:
            name: Name in the page's address and ids: letters, digits and hyphens.
            title: Title above the table.
            table: Name of the table in the page.
            columns: Displayed columns, each a name or the fields of a `GridColumn`.
            **options: Further attributes of `DataGrid`.
        """
        if table not in self._frames:
            return Markup()
        shown = (GridColumn(*([c] if isinstance(c, str) else c)) for c in columns)
        grid = DataGrid(name, title, table, tuple(shown), **options)
        self._grids.append(grid.build_spec())
        rows = select_initial_rows(grid, self._frames[table])
        return Markup(self._parts.grid(grid, rows[:INITIAL_ROWS], len(rows) - INITIAL_ROWS))

    def render(self, template: Path, **values: Any) -> str:
        """Return the complete page as HTML.

        Args:
            template: Template of the content. It sets `title`, the title of the window, and
                `footer`, the origin of the page.
            **values: Values of the template, in addition to `page`, which is this object.
        """
        content: Any = load_template(template).make_module({"page": self, **values})
        library = (_CHART_LIBRARY / "uPlot.iife.min.js").read_text(encoding="utf-8")
        own = "\n".join(_read(f"script/{name}.js") for name in _SCRIPTS)
        script = f'{library}\n(() => {{\n"use strict";\n{own}\n}})();\n'
        styles = (_CHART_LIBRARY / "uPlot.min.css").read_text(encoding="utf-8"), _read("page.css")
        embedded_data = {"tables": self._tables, "charts": self._charts, "grids": self._grids}
        return load_template(Path("page.html")).render(
            title=content.title,
            style=Markup("\n".join([*styles, self._own_style])),
            digest=b64encode(sha256(script.encode()).digest()).decode("ascii"),
            sections=self._sections,
            body=Markup(content),
            footer=content.footer,
            data=Markup(to_embeddable_json(embedded_data)),
            script=Markup(script),
        )


def to_embeddable_json(value: object) -> str:
    """Convert a value to JSON that cannot end the script element that contains it.

    Raises:
        ValueError: A number is not finite, which JSON cannot represent.
    """
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    # "</script>" and "<!--" have a meaning in HTML even inside of JSON text.
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def make_iframe(html: str) -> str:
    """Embed a page in another one as a sandboxed frame.

    Neither page's styles or scripts affect the other, and the frame's policy allows only its own
    script.
    """
    frame = Markup(
        '<iframe title="report" sandbox="allow-scripts allow-downloads" '
        'style="width: 100%; height: 46rem; border: 0" srcdoc="{}"></iframe>'
    )
    return str(frame.format(escape(html)))


def _read(name: str) -> str:
    return (_PAGES_FOLDER / name).read_text(encoding="utf-8")
