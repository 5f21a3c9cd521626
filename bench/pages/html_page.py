"""Self-contained HTML page: sections, tables and charts.

Styles, scripts, tables and figures are inside the file, and its Content-Security-Policy forbids
every request and every script but its own. The page is complete without JavaScript: figures are
static then, and tables show their first rows.
"""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.pages import html_elements
from bench.pages.chart import Chart, PrintedFigure
from bench.pages.data_grid import DataGrid
from bench.pages.html_elements import safe
from bench.pages.page_table import Table

if TYPE_CHECKING:
    import pandas as pd

_HERE = Path(__file__).parent
_LIBRARY = _HERE / "vendor" / "uplot"
_SCRIPTS = (
    "text_format", "table_data", "view_state", "ticks", "theme", "plot_drawing", "panel",
    "downloads", "figure", "data_grid", "page",
)  # fmt: skip
"""Scripts in the order of their dependencies: a later one may use earlier ones."""


class HtmlPage:
    """A page that is assembled part by part.

    Args:
        title: Title of the window.
        made: Text about its origin for the footer; safe HTML.
        style: CSS rules in addition to those of every page.
    """

    def __init__(self, title: str, made: str, style: str = "") -> None:
        self._title, self._made, self._own_style = title, made, style
        self._parts: list[str] = []
        self._sections: list[tuple[str, str]] = []
        self._tables: dict[str, str] = {}
        self._frames: dict[str, pd.DataFrame | Table] = {}
        self._charts: list[dict[str, Any]] = []
        self._grids: list[dict[str, Any]] = []

    def append(self, *parts: str) -> None:
        """Append safe HTML to the page."""
        self._parts += [part for part in parts if part]

    def add_section(self, name: str, head: str, *parts: str) -> None:
        """Append a section to the page, and a link to it in the navigation.

        Args:
            name: Name in the page's address: letters, digits and hyphens.
            head: Title of the section; safe HTML.
            parts: Content; safe HTML. A section without content is left out.
        """
        held = [part for part in parts if part]
        if held:
            self._sections.append((name, head))
            body = "\n".join([f'<h2 id="{name}-head">{head}</h2>', *held])
            self.append(f'<section id="{name}" aria-labelledby="{name}-head">\n{body}\n</section>')

    def add_table(self, name: str, frame: pd.DataFrame | Table, digits: int | None = None) -> None:
        """Store a table in the page for charts and grids, to be saved as NAME.csv.

        Args:
            name: Name of the table.
            frame: Its rows.
            digits: Significant digits of its numbers; None for all.
        """
        self._frames[name] = frame
        style = None if digits is None else f"%.{digits}g"
        self._tables[name] = frame.to_csv(index=False, float_format=style)

    def render_chart(self, chart: Chart) -> str:
        """Return a chart as HTML; its tables must be in the page."""
        self._charts.append(chart.build_spec())
        still = _render_static_figure(chart.static) if chart.static else ""
        caption = f"<figcaption>{chart.caption}</figcaption>"
        kind = "chart" if chart.static else "chart alive"
        return (
            f'<figure class="{kind}" id="{chart.name}" aria-labelledby="{chart.name}-title">\n'
            f'<h3 id="{chart.name}-title">{safe(chart.title)}</h3>\n'
            f'<div class="live"></div>\n{still}\n{caption}\n</figure>'
        )

    def render_figure(
        self,
        name: str,
        static: PrintedFigure,
        caption: str,
        tables: Sequence[str] = (),
        spots: Sequence[tuple[str, float, float]] = (),
    ) -> str:
        """Return a figure that is identical on screen and on paper, with its files for download.

        Args:
            name: Name in the page's address: letters, digits and hyphens.
            static: The figure.
            caption: Explanation of the figure; safe HTML.
            tables: Names of the page's tables with its numbers.
            spots: Names to highlight with their positions, as fractions of width and height from
                the top left.
        """
        of = f' data-tables="{safe(" ".join(tables))}"' if tables else ""
        return (
            f'<figure class="picture" id="{name}"{of}>\n{_render_static_figure(static, spots)}\n'
            f"<figcaption>{caption}</figcaption>\n</figure>"
        )

    def render_grid(self, grid: DataGrid) -> str:
        """Return a grid as HTML; its table must be in the page."""
        self._grids.append(grid.build_spec())
        shown = grid.to_html(self._frames[grid.table])
        head = f'<h3 id="{grid.name}-title">{safe(grid.title)}</h3>'
        return f'<div class="grid" id="{grid.name}">\n{head}\n{shown}\n</div>'

    def to_html(self) -> str:
        """Return the complete page as HTML."""
        data = {"tables": self._tables, "charts": self._charts, "grids": self._grids}
        library = (_LIBRARY / "uPlot.iife.min.js").read_text(encoding="utf-8")
        own = "\n".join(_script(name) for name in _SCRIPTS)
        script = f'{library}\n(() => {{\n"use strict";\n{own}\n}})();\n'
        styles = (_LIBRARY / "uPlot.min.css").read_text(encoding="utf-8"), _style()
        style = "\n".join([*styles, self._own_style])
        return "\n".join(
            [
                '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
                f'<meta http-equiv="Content-Security-Policy" content="{_policy(script)}">',
                '<meta name="viewport" content="width=device-width, initial-scale=1">',
                f"<title>{safe(self._title, 160)}</title>",
                f"<style>\n{style}</style>\n</head>\n<body>",
                '<a class="skip" href="#main">Skip to the results</a>',
                self._navigation(),
                '<main id="main">',
                *self._parts,
                "</main>\n"
                f'<footer class="soft">{html_elements.make_paragraph(self._made)}</footer>',
                f'<script type="application/json" id="data">{to_embeddable_json(data)}</script>',
                f"<script>{script}</script>\n</body>\n</html>\n",
            ]
        )

    def _navigation(self) -> str:
        links = [f'<a href="#{name}">{head}</a>' for name, head in self._sections]
        return f'<nav aria-label="sections">{" ".join(links)}</nav>'


def to_embeddable_json(value: object) -> str:
    """Convert a value to JSON that cannot end the script element that contains it.

    Raises:
        ValueError: A number is not finite, which JSON cannot represent.
    """
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    # "</script>" and "<!--" have a meaning in HTML even inside of JSON text.
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _policy(script: str) -> str:
    """Return the page's policy: run its single script, show embedded content, nothing else."""
    digest = b64encode(sha256(script.encode()).digest()).decode("ascii")
    return "; ".join(
        [
            "default-src 'none'",
            f"script-src 'sha256-{digest}'",
            # Styles cannot load anything that the other lines forbid.
            "style-src 'unsafe-inline'",
            "img-src data: blob:",
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )


def _render_static_figure(
    static: PrintedFigure, spots: Sequence[tuple[str, float, float]] = ()
) -> str:
    """Build the HTML of the printed figure, and of its PDF if there is one."""
    kind = "png" if static.image.startswith(b"\x89PNG") else "svg+xml"
    data = b64encode(static.image).decode("ascii")
    file = safe(static.file)
    image = (
        f'<img class="still" src="data:image/{kind};base64,{data}" data-file="{file}" '
        f'alt="{safe(static.alternative, 1000)}">'
    )
    link = ""
    if static.pdf is not None:
        pdf = b64encode(static.pdf).decode("ascii")
        link = f'<a href="data:application/pdf;base64,{pdf}" download="{file}.pdf">PDF</a>'
    for name, across, down in spots:
        style = f"left:{100 * across:.2f}%;top:{100 * down:.2f}%"
        image += f'<span class="spot" data-lights="{safe(name, 60)}" style="{style}"></span>'
    # The script adds its buttons to this paragraph, so it is needed without a PDF, too.
    return f'<div class="pictured">{image}</div>\n<p class="files">{link}</p>'


def _script(name: str) -> str:
    return (_HERE / "script" / f"{name}.js").read_text(encoding="utf-8")


def _style() -> str:
    return (_HERE / "page.css").read_text(encoding="utf-8")
