"""Texts of labels in figures: line breaks, short forms, and their size."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence

POINTS = 72.0
"""Number of points in an inch."""


def break_name(name: str, longest: int) -> str:
    """Break a name into lines of at most `longest` characters.

    Lines end after underscores and similar characters if possible, and never within the brackets of
    a unit.

    Args:
        name: Name to break.
        longest: Maximum length of a line.
    """
    # Parts that are not broken: a unit in brackets, or free text up to a separator.
    parts = []
    for bracketed, free in re.findall(r"(\[[^\]]*\]\s*)|([^\[]+|\[)", name):
        # A point is a separator unless it is a decimal point.
        parts += [bracketed] if bracketed else re.split(r"(?<=[_\-/ ])|(?<=\.)(?!\d)", free)
    lines = [""]
    for part in parts:
        if lines[-1] and len(lines[-1]) + len(part.rstrip()) > longest:
            lines.append("")
        lines[-1] += part
    # A part may be too long even for a line of its own.
    return "\n".join(
        wrapped_line for line in lines for wrapped_line in textwrap.wrap(line, longest)
    )


def shorten_name(name: str, max_length: int) -> str:
    """Shorten a long name of a joint's quantity to the quantity.

    Names with more than `max_length` characters are shortened, such as ``velocity of elbow`` to
    ``velocity`` and ``u.elbow`` to ``u``.

    Args:
        name: Name to shorten.
        max_length: Maximum length.
    """
    if len(name) <= max_length:
        return name
    quantity, *_ = re.split(r" of |\.", name, maxsplit=1)
    return quantity[:max_length]


def measure_text_width(texts: Sequence[str], size: float, weight: str = "normal") -> float:
    """Return the width of the longest line of some texts, in inches.

    Args:
        texts: Texts of one or several lines.
        size: Size of the letters in points.
        weight: ``normal`` or ``bold``.
    """
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(family="DejaVu Sans", weight=weight, size=size)
    widths = []
    for line in "\n".join(texts).split("\n"):
        width, _, _ = text_to_path.get_text_width_height_descent(line, font, False)
        widths.append(width)
    return float(max(widths)) / POINTS


def count_max_lines(texts: Sequence[str]) -> int:
    """Return the maximum number of lines of the texts."""
    return max((text.count("\n") + 1 for text in texts), default=1)
