"""Drive and back-drive diagram as a figure, and the data sheet as one printed page."""

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
from bench.diagnosis.datasheet.drive_diagram import DriveDiagram
from bench.diagnosis.report.effect_and_unit_text import (
    append_unit,
    format_fitted_value,
    format_number,
    format_sentence,
    format_unit,
    sanitise,
)
from bench.figures import figure_output, style
from bench.figures.figure_settings import is_pdf_wanted
from bench.figures.style import POINTS, measure_text_width

if TYPE_CHECKING:
    from matplotlib.axes import Axes
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
    with style.apply_settings(STYLE):
        figure, axes = style.make_panel_grid(1, 1, (5.4, 4.6))
        draw_diagram(axes[0, 0], diagram)
        pdf = figure_output.render_pdf(figure) if is_pdf_wanted() else None
        return figure_output.FigureFiles(b"", figure_output.render_svg(figure), pdf)


def draw_diagram(axes: Axes, diagram: DriveDiagram) -> None:
    """Draw the diagram: where the joint moves, holds and slips, by load and motor force.

    The region above the forward boundary is forward motion, below the backward boundary back
    motion; in between the joint holds. The dotted diagonal is the force that balances the load.
    Marks show the break-away force and the load that moves the joint back.

    Args:
        axes: Axes to draw on.
        diagram: Diagram to draw.
    """
    load_range, unit = diagram.axis_limit, format_unit(diagram.unit)
    load = diagram.load
    forward, backward = (
        np.clip(boundary, -2 * load_range, 2 * load_range)
        for boundary in (diagram.forward, diagram.back)
    )
    axes.fill_between(load, forward, 2 * load_range, color=style.PALE_BLUE, linewidth=0)
    axes.fill_between(load, backward, forward, color=style.HELD_OUT_GREY, linewidth=0)
    axes.fill_between(load, -2 * load_range, backward, color=style.PALE_RUST, linewidth=0)
    axes.plot(load, forward, color=style.BLUE, linewidth=1.5)
    axes.plot(load, backward, color=style.VERMILION, linewidth=1.5, linestyle=(0, (5, 2)))
    axes.plot(load, load, color=style.CONNECTOR_GREY, linewidth=0.8, linestyle=":")
    axes.axhline(0.0, color=style.ZERO_LINE_GREY, linewidth=0.6)
    axes.axvline(0.0, color=style.ZERO_LINE_GREY, linewidth=0.6)
    for force, position, marker in (
        (diagram.breakaway, (0.0, diagram.breakaway), "o"),
        (diagram.backdrive, (diagram.backdrive, 0.0), "s"),
    ):
        if 0 < force <= load_range:
            axes.plot(
                *position, marker=marker, color=style.NEUTRAL_MARK, markersize=5, linestyle="none"
            )
            text = f" {format_number(force)} {unit}"
            axes.annotate(text, position, xytext=(4, 4), textcoords="offset points")
    text_style: dict[str, Any] = {"ha": "center", "va": "center", "color": style.CAPTION_GREY}
    # Places of the labels in the regions of the diagram, as shares of the range of its axes.
    axes.text(-0.55 * load_range, 0.75 * load_range, "moves forward", **text_style)
    axes.text(0.55 * load_range, -0.75 * load_range, "moves back", **text_style)
    axes.text(0.72 * load_range, 0.25 * load_range, "back-driven:\nthe load slips", **text_style)
    # The region in which the joint holds is labelled where it is wide enough.
    middle = 0.62 * load_range
    if np.interp(middle, load, forward - backward) > 0.15 * load_range:
        axes.text(middle, middle, "holds", **text_style)
    axes.set(
        xlim=(-load_range, load_range),
        ylim=(-load_range, load_range),
        xlabel=f"load [{unit}]",
        ylabel=f"force of the motor [{unit}]",
    )
    axes.set_title("Drive and back-drive, at rest", fontsize=9, loc="left")


def render_pdf(content: SheetContent) -> bytes:
    """Render the sheet as a PDF of one page."""
    with style.apply_settings(STYLE):
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
    """Draw name, title and verdict; return the height of the space below, as a share.

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
    """Draw the table of identified numbers; return the height of the space below, as a share.

    Args:
        figure: figure to draw on.
        content: content of the data sheet.
        top: height of the top of the table, as a share of the page.
    """
    heads = ("", "quantity", "value (95 %)", "another run", "evidence")
    table_cells = [
        (
            title(row, content.is_driven),
            sanitise(format_name(row), 60),
            sanitise(format_fitted_value(row.number), 70),
            format_prediction_interval(row),
            sanitise(format_evidence(row, is_short=True), 60),
        )
        for row in content.rows
        if row.number is not None
    ]
    is_cause = [row.state == "found" for row in content.rows if row.number is not None]
    size, columns = _choose_table_layout([heads, *table_cells])
    for x, text in zip(columns, heads, strict=True):
        figure.text(x, top, text, weight="bold", va="top", fontsize=size)
    for cells, is_found in zip(table_cells, is_cause, strict=True):
        # Lines of the table are a quarter wider apart than those of a text.
        top -= _LINE * 1.25
        for i, (x, text) in enumerate(zip(columns, cells, strict=True)):
            weight = "bold" if is_found and i == 1 else "normal"
            figure.text(x, top, text, va="top", weight=weight, fontsize=size)
    return top - _LINE * 1.5


def _choose_table_layout(rows: Sequence[Sequence[str]]) -> tuple[float, list[float]]:
    """Choose the font size of a table, and where its columns begin.

    The size is reduced until the table fits between the margins, but not below `_LEAST_SIZE`.

    Args:
        rows: cells of each row, with the headings as the first row.

    Returns:
        Font size in points, and left edges of the columns as shares of the page width.
    """
    size = _TABLE_SIZE
    while True:
        widths = [measure_text_width(column, size, "bold") for column in zip(*rows, strict=True)]
        # Space between two columns in inches, for this font size.
        gap = 0.14 * size / _TABLE_SIZE
        if (
            sum(widths) + gap * (len(widths) - 1) <= A4_INCHES[0] * (1 - 2 * _MARGIN)
            or size < _LEAST_SIZE
        ):
            break
        size -= 0.25
    column_positions = np.concatenate(
        [[0.0], np.cumsum(widths[:-1]) + gap * np.arange(1, len(widths))]
    )
    return size, (_MARGIN + column_positions / A4_INCHES[0]).tolist()


def _draw_effects_not_shown(
    figure: Figure, content: SheetContent, size: float, table_top: float = 0.0
) -> float:
    """Draw a table, in two columns, of the effects that the data do not show.

    Each row has the name of the effect and its detection limit, which may need several lines. The
    rows are split so that both columns are about equally high.

    Args:
        figure: Page to draw on.
        content: Content of the data sheet.
        size: Font size in points.
        table_top: Height of the first line, as a share of the page; 0 for a table that ends at the
            foot of the page.

    Returns:
        Height of the top of the table, as a share of the page.
    """
    lines_by_effect = []
    names = [format_short_name(row) for row in content.rows if row.number is None]
    name_length = min(max(map(len, names), default=0), _NAME_LETTERS)
    # A character of the monospaced font is 0.602 of its size wide.
    limit_offset = (0.602 * size / POINTS * name_length + 0.12) / A4_INCHES[0]
    letters = int((_HALF_WIDTH - limit_offset) * A4_INCHES[0] * POINTS / (_LETTER * size))
    for row in content.rows:
        if row.number is None:
            confounding = format_confounding(row)
            limit_text = format_detection_limit(row) + (
                f" (confounded with {confounding})" if confounding and row.detection_limit else ""
            )
            lines = textwrap.wrap(limit_text, letters)
            lines_by_effect.append((format_short_name(row), lines))
    line = _SMALL * 1.2 * size / _SMALL_SIZE
    heights = [len(lines) for _, lines in lines_by_effect]
    split_row = next(
        (i for i in range(len(lines_by_effect) + 1) if 2 * sum(heights[:i]) >= sum(heights)), 0
    )
    table_height = line * max(sum(heights[:split_row]), sum(heights[split_row:]))
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
            y -= line * len(lines)
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
