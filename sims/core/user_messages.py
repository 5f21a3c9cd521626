"""Texts of messages and tables: lists of names, counts, units, aligned columns, maximum lengths."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

MAX_NAME_LENGTH = 120
"""Maximum number of characters of a name or label, which is used in file names."""
MAX_TITLE_LENGTH = 300
"""Maximum number of characters of a title."""
MAX_DESCRIPTION_LENGTH = 5000
"""Maximum number of characters of a description."""
MAX_MESSAGE_LENGTH = 4000
"""Maximum number of characters of a message, because it may quote a large part of a user's file."""
MAX_QUOTED_NAME_LENGTH = 60
"""Maximum number of characters of a name that a message quotes."""

SUPERSCRIPT_DIGITS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
"""Translation of digits and minus sign to superscripts."""
_PLURAL_STEM = re.compile("(?<=[^aeiou])y$")
_POWER_PATTERN = re.compile(r"(?:\^|\*\*)(-?\d+)")


def join_first_names(names: Iterable[str], max_count: int = 4) -> str:
    """Join the first of distinct names, and count the remaining ones: ``a, b and 3 more``.

    Args:
        names: Names, possibly repeated.
        max_count: Maximum number of names to write.
    """
    distinct_names = list(dict.fromkeys(names))
    unnamed_count = len(distinct_names) - max_count
    text = ", ".join(distinct_names[:max_count])
    return f"{text} and {unnamed_count} more" if unnamed_count > 0 else text


def format_count(count: int, noun: str) -> str:
    """Return a number with a noun in singular or plural, such as ``1 run`` or ``3 bodies``."""
    return f"{count} {noun if count == 1 else _PLURAL_STEM.sub('ie', noun) + 's'}"


def format_run_names(names: Sequence[str], max_count: int) -> str:
    """Return the first names of runs after the noun, such as ``runs a, b and 3 more``.

    Args:
        names: Names of the runs.
        max_count: Maximum number of names to write.
    """
    return f"run{'s' if len(names) > 1 else ''} {join_first_names(names, max_count)}"


def format_unit(unit: str) -> str:
    """Format a unit for print, such as ``kg·m²`` for ``kg*m^2``; empty for a pure number."""
    raised = _POWER_PATTERN.sub(lambda match: match[1].translate(SUPERSCRIPT_DIGITS), unit)
    return "" if raised == "1" else raised.replace("*", "·")


def append_unit(text: str, unit: str) -> str:
    """Append a unit to a number; a pure number has none.

    Args:
        text: the number.
        unit: its unit.
    """
    unit_text = format_unit(unit)
    return f"{text} {unit_text}" if unit_text else text


def truncate_text(text: str, max_length: int = MAX_QUOTED_NAME_LENGTH) -> str:
    """Truncate a text for a message.

    Args:
        text: Text.
        max_length: Maximum number of characters.
    """
    return text if len(text) <= max_length else f"{text[:max_length]}…"


def align_columns(rows: Sequence[Sequence[str]], left_columns: int) -> list[str]:
    """Align a table of texts for a terminal.

    Args:
        rows: cells of the table.
        left_columns: number of columns, from the first one, that are left-justified.

    Returns:
        One line per row.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if i < left_columns else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
