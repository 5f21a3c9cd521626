"""Data sheet as one printed page, and its drive and back-drive diagram as a figure."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.diagnosis.datasheet.datasheet_content import (
    SheetContent,
    format_confounding,
    format_detection_limit,
    format_evidence,
    format_name,
    format_prediction_interval,
    format_short_name,
    title,
)
from bench.diagnosis.datasheet.drive_diagram import DriveDiagram, draw_diagram
from bench.diagnosis.report.cause_and_value_text import (
    append_unit,
    format_fitted_value,
    format_number,
    format_sentence,
    sanitise,
)
from bench.figures import figure_layout, figure_output, style
from bench.figures.figure_settings import is_pdf_wanted
from bench.figures.label_text import POINTS, measure_text_width

if TYPE_CHECKING:
    from matplotlib.figure import Figure


A4_INCHES = (8.27, 11.69)
"""Width and height of an A4 page in inches."""
_MARGIN = 0.06
"""Margin, as a share of the page width."""
_LINE = 0.0118
"""Height of a line of the table, as a share of the page height."""
_SMALL = 0.0083
"""Height of a line of effects not shown, at font size `_SMALL_SIZE`, as a share of the page height.
"""
_SMALL_SIZE = 5.6
"""Font size of the effects not shown, in points."""
_NAME_LETTERS = 40
"""Maximum number of characters of a name in the list of effects not shown."""
_LETTER = 0.63
"""Mean width of a character, as a share of the font size."""
_TABLE_SIZE, _LEAST_SIZE = 7.5, 5.0
"""Maximum and minimum font size of the table, in points."""
_MAX_DIAGRAM_HEIGHT = 0.36
"""Maximum height of the diagram, as a share of the page height."""
_LETTERS = 110
"""Maximum number of characters of a line across the page."""
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "text.usetex": False,
    # Names come from files, where a dollar sign must not start mathematics.
    "text.parse_math": False,
    "pdf.fonttype": 42,
}
_NAME_TOP, _TITLE_TOP, _FOOT_TOP = 0.965, 0.938, 0.028
"""Heights of the name, the title and the foot of the page, as shares of the page."""
_TITLE_LINE, _TITLE_GAP = 0.014, 0.012
"""Height of a line of the title, and of the space below it, as shares of the page."""
_HALF_WIDTH = 0.45
"""Width of one of two columns, as a share of the page."""
_FOOT_HEIGHT = 0.045
"""Height of the foot of the page, which no table overlaps, as a share of the page."""


def render_diagram(diagram: DriveDiagram) -> figure_output.FigureFiles:
    """Render the diagram as SVG for the page, and as PDF if requested."""
    with figure_layout.apply_settings(STYLE):
        figure, axes = figure_layout.make_panel_grid(1, 1, (5.4, 4.6))
        draw_diagram(axes[0, 0], diagram)
        pdf = figure_output.render_pdf(figure) if is_pdf_wanted() else None
        return figure_output.FigureFiles(b"", figure_output.render_svg(figure), pdf)


def render_pdf(content: SheetContent) -> bytes:
    """Render the sheet as a PDF of one page."""
    with figure_layout.apply_settings(STYLE):
        return figure_output.render_pdf(draw_sheet(content))


def draw_sheet(content: SheetContent) -> Figure:
    """Draw the sheet as a figure of one page.

    From top to bottom, it has a heading, the table of numbers, the drive diagram or the reason why
    there is none, and the table of absent effects.

    Args:
        content: Content of the data sheet.
    """
    from bench.figures.notebook_figure import NotebookFigure

    figure = NotebookFigure(figsize=A4_INCHES, layout=None)
    top = _draw_heading(figure, content)
    top = _draw_number_table(figure, content, top)
    diagram = content.diagram
    if diagram is None:
        text = "\n".join(textwrap.wrap(content.explain_missing_diagram(), _LETTERS))
        figure.text(_MARGIN, top - 0.01, text, va="top", linespacing=1.4)
        # Without a diagram there is space for a table with a larger font.
        _draw_effects_not_shown(figure, content, size=_SMALL_SIZE + 1.4, table_top=top - 0.09)
        return figure
    # The table of absent effects ends at the foot; the diagram fills the space above it.
    table_top = _draw_effects_not_shown(figure, content, size=_SMALL_SIZE)
    # Positions are shares of the page; the labels of the axes need 0.09 of the width and the
    # height.
    height = min(_MAX_DIAGRAM_HEIGHT, top - table_top - 0.09)
    if height > 0.1:
        width = height * A4_INCHES[1] / A4_INCHES[0]
        draw_diagram(figure.add_axes((_MARGIN + 0.09, top - height - 0.03, width, height)), diagram)
        _draw_diagram_text(figure, diagram, _MARGIN + 0.13 + width, top - 0.05)
    return figure


def _draw_heading(figure: Figure, content: SheetContent) -> float:
    """Draw the name of the sheet, the title of the log and the verdict at the top of the page.

    Args:
        figure: the page.
        content: content of the sheet.

    Returns:
        Upper end of the free space, as a share of the page height.
    """
    figure.text(
        _MARGIN, _NAME_TOP, sanitise(content.name, 60), fontsize=17, weight="bold", va="top"
    )
    title = content.recording.title or content.recording.path.stem
    text = f"Data sheet from {sanitise(title, 90)}. {format_sentence(content.verdict.meaning)}"
    lines = textwrap.wrap(sanitise(text, 300), _LETTERS)[:3]
    figure.text(
        _MARGIN, _TITLE_TOP, "\n".join(lines), color=style.CAPTION_GREY, va="top", linespacing=1.3
    )
    return _TITLE_TOP - _TITLE_LINE * len(lines) - _TITLE_GAP


def _draw_number_table(figure: Figure, content: SheetContent, top: float) -> float:
    """Draw the table of identified numbers, with the names of diagnosed causes in bold.

    Args:
        figure: figure to draw on.
        content: content of the data sheet.
        top: height of the top of the table, as a share of the page.

    Returns:
        Upper end of the free space below, as a share of the page height.
    """
    heads = ("", "quantity", "value (95 %)", "another run", "evidence")
    table_cells: list[tuple[str, ...]] = []
    cell_weights: list[tuple[str, ...]] = []
    for row in content.rows:
        if row.number is None:
            continue
        table_cells.append(
            (
                title(row, content.is_driven),
                sanitise(format_name(row), 60),
                sanitise(format_fitted_value(row.number), 70),
                format_prediction_interval(row),
                sanitise(format_evidence(row, is_short=True), 60),
            )
        )
        name_weight = "bold" if row.state == "found" else "normal"
        cell_weights.append(("normal", name_weight, "normal", "normal", "normal"))
    size, columns = _choose_table_layout([heads, *table_cells])
    for x, text in zip(columns, heads, strict=True):
        figure.text(x, top, text, weight="bold", va="top", fontsize=size)
    for cells, weights in zip(table_cells, cell_weights, strict=True):
        # Lines of the table are a quarter wider apart than those of a text.
        top -= _LINE * 1.25
        # Each cell begins at the left edge of its column.
        for x, text, weight in zip(columns, cells, weights, strict=True):
            figure.text(x, top, text, va="top", weight=weight, fontsize=size)
    return top - _LINE * 1.5


def _choose_table_layout(rows: Sequence[Sequence[str]]) -> tuple[float, list[float]]:
    """Choose the font size of a table, and where its columns begin.

    The size is reduced in steps of 0.25 points until the table fits between the margins, or is
    below `_LEAST_SIZE`.

    Args:
        rows: cells of each row, with the headings as the first row.

    Returns:
        Font size in points, and left edges of the columns as shares of the page width.
    """
    page_width, _ = A4_INCHES
    size = _TABLE_SIZE
    while True:
        # Widths of the columns, and of the space between two of them, in inches.
        widths = [measure_text_width(column, size, "bold") for column in zip(*rows, strict=True)]
        gap = 0.14 * size / _TABLE_SIZE
        table_width = sum(widths) + gap * (len(widths) - 1)
        if table_width <= page_width * (1 - 2 * _MARGIN) or size < _LEAST_SIZE:
            break
        size -= 0.25
    left_edges = np.concatenate([[0.0], np.cumsum(widths[:-1]) + gap * np.arange(1, len(widths))])
    return size, (_MARGIN + left_edges / page_width).tolist()


def _draw_effects_not_shown(
    figure: Figure, content: SheetContent, size: float, table_top: float = 0.0
) -> float:
    """Draw a table, in two columns, of the effects that the data do not show.

    Each row has the name of the effect and its detection limit, which may need several lines. The
    rows are split so that both columns are about equally high. Heights are shares of the page.

    Args:
        figure: Page to draw on.
        content: Content of the data sheet.
        size: Font size in points.
        table_top: Height of the first line, as a share of the page; 0 for a table that ends at the
            foot of the page.

    Returns:
        Height of the top of the table with its heading, as a share of the page.
    """
    absent_rows = [row for row in content.rows if row.number is None]
    page_width, _ = A4_INCHES
    name_length = min(
        max((len(format_short_name(row)) for row in absent_rows), default=0), _NAME_LETTERS
    )
    # Distance of the limits from the names, as a share of the page width. A character of the
    # monospaced font is 0.602 of its size wide, and 0.12 inches are left free.
    limit_offset = (0.602 * size / POINTS * name_length + 0.12) / page_width
    # Maximum number of characters of a line of a limit.
    letters = int((_HALF_WIDTH - limit_offset) * page_width * POINTS / (_LETTER * size))
    lines_by_effect: list[tuple[str, list[str]]] = []
    for row in absent_rows:
        limit_text = format_detection_limit(row)
        confounding = format_confounding(row)
        if confounding and row.detection_limit:
            limit_text += f" (confounded with {confounding})"
        lines_by_effect.append((format_short_name(row), textwrap.wrap(limit_text, letters)))
    # The first column ends as soon as it has half of the lines.
    heights = [len(lines) for _, lines in lines_by_effect]
    split_row = next(
        (i for i in range(len(heights) + 1) if 2 * sum(heights[:i]) >= sum(heights)), 0
    )
    line_height = _SMALL * 1.2 * size / _SMALL_SIZE
    table_height = line_height * max(sum(heights[:split_row]), sum(heights[split_row:]))
    # A long table must not overlap the foot of the page.
    table_top = max(table_top, _FOOT_HEIGHT + table_height)
    for column, part in enumerate((lines_by_effect[:split_row], lines_by_effect[split_row:])):
        x, y = _MARGIN + _HALF_WIDTH * column, table_top
        for name, lines in part:
            figure.text(
                x, y, sanitise(name, name_length), va="top", fontsize=size, family="monospace"
            )
            limit_text = "\n".join(lines)
            figure.text(x + limit_offset, y, limit_text, va="top", fontsize=size, linespacing=1.25)
            y -= line_height * len(lines)
    heading = "Not detected in these data, with the detection limit (95 %)"
    figure.text(_MARGIN, table_top + 0.018, heading, weight="bold", va="top")
    text = "Limits and backlash are detectable from the given size on. Made by simgap datasheet."
    figure.text(_MARGIN, _FOOT_TOP, text, fontsize=6, color=style.CAPTION_GREY, va="top")
    return table_top + 0.02


def _draw_diagram_text(figure: Figure, diagram: DriveDiagram, x: float, y: float) -> None:
    """Draw the description of the diagram next to it.

    It has the break-away force, the load that moves the unpowered joint, and the friction laws.

    Args:
        figure: the page.
        diagram: the diagram.
        x: left edge of the text, as a share of the page width.
        y: upper edge of the text, as a share of the page height.
    """
    unit = diagram.unit
    lines = [
        f"starts to move without load at {append_unit(format_number(diagram.breakaway), unit)}"
    ]
    load = append_unit(format_number(diagram.backdrive), unit)
    is_backdrivable = np.isfinite(diagram.backdrive)
    lines.append(
        f"without power, a load of {load} back-drives it" if is_backdrivable else "self-locking"
    )
    laws = sanitise(", ".join(diagram.laws), 100)
    lines.append(f"laws: {laws or 'none, no friction at rest'}")
    if diagram.without:
        lines.append(
            f"not included, because they have an internal state: {', '.join(diagram.without)}"
        )
    text = "\n".join(part for line in lines for part in textwrap.wrap(line, 34))
    figure.text(x, y, text, va="top", linespacing=1.4, fontsize=7.5)
