"""The drive and back-drive diagram as a picture, and the sheet as one page for print."""

from __future__ import annotations

import textwrap
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.figures import style
from bench.figures.formats import is_pdf_wanted
from bench.gap.report.words import clean, estimated, number, pretty, sentence, with_unit
from bench.gap.sheet.diagram import Diagram
from bench.gap.sheet.facts import Facts
from bench.gap.sheet.words import TITLES, another, beside, called, evidence, reached, short

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

A4 = (8.27, 11.69)
"""Inches."""
_MARGIN = 0.06
"""Of the page, as a share of its width."""
_LINE = 0.0118
"""Height of a line of the table, as a share of the page."""
_SMALL = 0.0083
"""The same of what is not shown."""
_ROOM = 0.36
"""Height of the diagram at most, as a share of the page."""
_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "text.usetex": False,
    # Names come from files: a dollar sign in one is a dollar sign.
    "text.parse_math": False,
    "pdf.fonttype": 42,
}


def picture(diagram: Diagram) -> tuple[bytes, bytes | None]:
    """Render the diagram as SVG for the page, and as PDF where one is asked for."""
    with _styled():
        figure, axes = style.blank(1, 1, (5.4, 4.6))
        draw(axes[0, 0], diagram)
        return style.svg(figure), style.pdf(figure) if is_pdf_wanted() else None


def draw(axes: Axes, diagram: Diagram) -> None:
    """The diagram on axes: by load and motor force, where the joint moves, holds and slips."""
    reach, unit = diagram.reach, pretty(diagram.unit)
    load = diagram.load
    ahead, back = (np.clip(side, -2 * reach, 2 * reach) for side in (diagram.forward, diagram.back))
    axes.fill_between(load, ahead, 2 * reach, color=style.PALE_BLUE, linewidth=0)
    axes.fill_between(load, back, ahead, color=style.GROUND, linewidth=0)
    axes.fill_between(load, -2 * reach, back, color=style.PALE_RUST, linewidth=0)
    axes.plot(load, ahead, color=style.BLUE, linewidth=1.5)
    axes.plot(load, back, color=style.VERMILION, linewidth=1.5, linestyle=(0, (5, 2)))
    axes.plot(load, load, color=style.JOIN, linewidth=0.8, linestyle=":")
    axes.axhline(0.0, color=style.ZERO, linewidth=0.6)
    axes.axvline(0.0, color=style.ZERO, linewidth=0.6)
    for force, at, marker in (
        (diagram.breakaway, (0.0, diagram.breakaway), "o"),
        (diagram.backdrive, (diagram.backdrive, 0.0), "s"),
    ):
        if 0 < force <= reach:
            axes.plot(*at, marker=marker, color=style.INK, markersize=5, linestyle="none")
            text = f" {number(force)} {unit}"
            axes.annotate(text, at, xytext=(4, 4), textcoords="offset points")
    said: dict[str, Any] = {"ha": "center", "va": "center", "color": style.SOFT}
    axes.text(-0.55 * reach, 0.75 * reach, "moves forward", **said)
    axes.text(0.55 * reach, -0.75 * reach, "moves back", **said)
    axes.text(0.72 * reach, 0.25 * reach, "back-driven:\nthe load slips", **said)
    middle = 0.62 * reach
    if np.interp(middle, load, ahead - back) > 0.15 * reach:
        axes.text(middle, middle, "holds", **said)
    axes.set(
        xlim=(-reach, reach),
        ylim=(-reach, reach),
        xlabel=f"what it works against [{unit}]",
        ylabel=f"force of the motor [{unit}]",
    )
    axes.set_title("Drive and back-drive, at rest", fontsize=9, loc="left")


def printed(facts: Facts, diagram: Diagram) -> bytes:
    """The sheet as a PDF of one page."""
    with _styled():
        return style.pdf(paper(facts, diagram))


def paper(facts: Facts, diagram: Diagram) -> Figure:
    """The page."""
    from bench.figures.picture import Picture

    figure = Picture(figsize=A4, layout=None)
    top = _heading(figure, facts)
    top = _shown(figure, facts, top)
    below = _not_shown(figure, facts)
    height = min(_ROOM, top - below - 0.09)
    if height > 0.1:
        width = height * A4[1] / A4[0]
        draw(figure.add_axes((_MARGIN + 0.09, top - height - 0.03, width, height)), diagram)
        _beside(figure, diagram, _MARGIN + 0.13 + width, top - 0.05)
    return figure


def _heading(figure: Figure, facts: Facts) -> float:
    """Name, title and verdict; what is left below, as a share of the height."""
    figure.text(_MARGIN, 0.965, clean(facts.name, 60), fontsize=17, weight="bold", va="top")
    title = facts.recording.title or facts.recording.path.stem
    said = f"Data sheet from {clean(title, 90)}. {sentence(facts.verdict.says)}"
    lines = textwrap.wrap(clean(said, 300), 110)[:3]
    figure.text(_MARGIN, 0.938, "\n".join(lines), color=style.SOFT, va="top", linespacing=1.3)
    return 0.938 - 0.014 * len(lines) - 0.012


def _shown(figure: Figure, facts: Facts, top: float) -> float:
    """The table of what is shown; what is left below."""
    columns = (_MARGIN, 0.135, 0.405, 0.685, 0.785)
    heads = ("", "quantity", "value (95 %)", "another run", "evidence")
    for x, text in zip(columns, heads, strict=True):
        figure.text(x, top, text, weight="bold", va="top")
    for row in facts.rows:
        if row.number is None:
            continue
        top -= _LINE * 1.25
        cells = [
            TITLES[row.part],
            clean(called(row), 44),
            clean(estimated(row.number), 54),
            another(row),
            clean(evidence(row, short=True), 30),
        ]
        for x, text in zip(columns, cells, strict=True):
            weight = "bold" if row.state == "found" and x == columns[1] else "normal"
            figure.text(x, top, text, va="top", weight=weight, fontsize=7.5)
    return top - _LINE * 1.5


def _not_shown(figure: Figure, facts: Facts) -> float:
    """Two columns of what is not shown, from the foot up; where they begin."""
    rows = [row for row in facts.rows if row.number is None]
    half = -(-len(rows) // 2)
    begins = 0.045 + _SMALL * 1.2 * half
    for i, row in enumerate(rows):
        x = _MARGIN + 0.45 * (i // half)
        y = begins - _SMALL * 1.2 * (i % half)
        mixed = beside(row)
        said = reached(row) + (f" (mixed up with {mixed})" if mixed and row.reach else "")
        figure.text(x, y, clean(short(row), 34), va="top", fontsize=5.6, family="monospace")
        figure.text(x + 0.18, y, clean(said, 52), va="top", fontsize=5.6)
    title = "Not shown by these data, and how small a number they would have shown (95 %)"
    figure.text(_MARGIN, begins + 0.018, title, weight="bold", va="top")
    text = "Limits and gaps show from the size given on. Made by simgap datasheet."
    figure.text(_MARGIN, 0.028, text, fontsize=6, color=style.SOFT, va="top")
    return begins + 0.02


def _beside(figure: Figure, diagram: Diagram, x: float, y: float) -> None:
    """What the diagram says, in words."""
    unit = diagram.unit
    lines = [f"starts without a load at {with_unit(number(diagram.breakaway), unit)}"]
    load = with_unit(number(diagram.backdrive), unit)
    turned = np.isfinite(diagram.backdrive)
    lines.append(f"without power a load of {load} turns it" if turned else "locks itself")
    laws = clean(", ".join(diagram.laws), 100)
    lines.append(f"laws: {laws or 'none, no friction at rest'}")
    if diagram.without:
        lines.append(f"not in it, with a state of its own: {', '.join(diagram.without)}")
    text = "\n".join(part for line in lines for part in textwrap.wrap(line, 34))
    figure.text(x, y, text, va="top", linespacing=1.4, fontsize=7.5)


@contextmanager
def _styled() -> Iterator[None]:
    from matplotlib import rc_context

    with rc_context(_STYLE), warnings.catch_warnings():
        # A title may be in any script; what the font lacks is drawn as a box.
        warnings.filterwarnings("ignore", message="Glyph")
        yield
