"""How much room texts take, and where long names are broken into lines."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence

POINTS = 72.0
"""Points in an inch."""


def break_name(name: str, longest: int) -> str:
    """Break a name into lines of at most `longest` characters, behind underscores and the like
    where possible, and never within the brackets of a unit.
    """
    parts = []
    for bracketed, free in re.findall(r"(\[[^\]]*\]\s*)|([^\[]+|\[)", name):
        # Not behind the point of a number.
        parts += [bracketed] if bracketed else re.split(r"(?<=[_\-/ ])|(?<=\.)(?!\d)", free)
    lines = [""]
    for part in parts:
        if lines[-1] and len(lines[-1]) + len(part.rstrip()) > longest:
            lines.append("")
        lines[-1] += part
    # A part may be too long by itself.
    return "\n".join(piece for line in lines for piece in textwrap.wrap(line, longest))


def brief(name: str, most: int) -> str:
    """Shorten the name of a quantity of a joint to the quantity, if it has more than `most`
    characters: ``velocity of elbow`` to ``velocity``, ``u.elbow`` to ``u``.
    """
    return name if len(name) <= most else re.split(r" of |\.", name, maxsplit=1)[0][:most]


def text_width(texts: Sequence[str], size: float, weight: str = "normal") -> float:
    """Return the width of the longest line of some texts, in inches.

    Args:
        texts: each of one or several lines.
        size: of the letters, in points.
        weight: ``normal`` or ``bold``.
    """
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(family="DejaVu Sans", weight=weight, size=size)
    lines = [line for text in texts for line in text.split("\n")]
    widths = [text_to_path.get_text_width_height_descent(line, font, False)[0] for line in lines]
    return float(max(widths, default=0.0)) / POINTS


def most_lines(texts: Sequence[str]) -> int:
    """Return the number of lines of the text that has most."""
    return max((text.count("\n") + 1 for text in texts), default=1)
