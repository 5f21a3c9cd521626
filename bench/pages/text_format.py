"""Format text, numbers and tables for people: for pages, terminals and spreadsheets.

Text and names from files and plugins are cleaned, and CSV text is safe to open in a spreadsheet.
"""

from __future__ import annotations

import csv
import io
import shlex
from collections.abc import Iterable, Sequence
from math import floor, isfinite, log10
from typing import TYPE_CHECKING

from markupsafe import Markup, escape

from sims.core import user_messages
from sims.core.user_messages import SUPERSCRIPT_DIGITS, align_columns

if TYPE_CHECKING:
    import pandas as pd

_MIN_EXPONENT = -300
"""Smallest exponent of ten of which the power is computed directly."""
_MIN_FIXED_POINT = 1e-3
"""Magnitude below which numbers are written with a power of ten."""
_MAX_FIXED_POINT = 1e5
"""Magnitude from which on numbers are written with a power of ten."""
_LOG_MAX_TWO_DIGIT_MANTISSA = log10(3.55)
"""Logarithm of the mantissa below which an interval is written with two digits.

This is the rule of the Particle Data Group.
"""
_MIN_WRITTEN_P_VALUE = 1e-12
"""Smallest p-value that is written as a number."""

MAX_DOCUMENT_LENGTH = 6000
"""Maximum number of characters of a text of several lines, unless its template asks for more."""

CELL_SEPARATOR = "¦"
"""Separator of the cells in a line of a table that a text template aligns."""


def sanitise(text: object, max_length: int = 400) -> str:
    """Clean text from a file or plugin for one line of output.

    Control characters are written as escapes, and long text is shortened.

    Args:
        text: Text or another value.
        max_length: Maximum length in characters.
    """
    plain = str(text)
    if not plain.isprintable():
        plain = "".join(_replace_unprintable(c) for c in plain)
    plain = plain.strip()
    return plain if len(plain) <= max_length else plain[: max_length - 1] + "…"


def joined(parts: Sequence[str], last: str = "and") -> str:
    """Join names as ``a``, ``a and b`` or ``a, b and c``.

    Args:
        parts: Names.
        last: Word before the last name.
    """
    if len(parts) < 2:
        return "".join(parts)
    return f"{', '.join(parts[:-1])} {last} {parts[-1]}"


def _replace_unprintable(character: str) -> str:
    """Return a character if it is printable, else a replacement that cannot change the output."""
    if character.isprintable():
        return character
    # A line break or tab becomes a space; an escape sequence or a change of direction is spelled
    # out.
    return " " if character.isspace() else ascii(character)[1:-1]


def format_number(value: float | None, digits: int = 3) -> str:
    """Format a number with significant digits; a dash if there is none.

    Args:
        value: Number; None, NaN and infinity become a dash.
        digits: Number of significant digits.
    """
    if value is None or not isfinite(value):
        return "–"
    if value == 0:
        return "0"
    # Rounded first: 0.0009996 is 0.001, which needs no power of ten.
    rounded = float(f"{value:.{digits - 1}e}")
    exponent = _get_exponent(abs(rounded))
    # Digits after the first one, less those before the decimal point.
    decimals = max(0, digits - 1 - floor(log10(abs(rounded))) + exponent)
    text = f"{_divide_by_power(rounded, exponent):.{decimals}f}"
    # Zeros before the decimal point are digits, trailing zeros after it are not needed.
    if "." in text:
        text = text.rstrip("0").rstrip(".")
    return _format_sign(text) + _format_power(exponent)


def format_significant(value: float | None, digits: int = 3) -> str:
    """Format a number for a terminal, such as ``2.2e-04``; a hyphen for None.

    Args:
        value: Number.
        digits: Number of significant digits.
    """
    return "-" if value is None else f"{value:.{digits}g}"


def format_estimate(value: float, low: float | None, high: float | None) -> str:
    """Format an estimate with interval, e.g. ``0.00333 (0.00330 to 0.00336)``.

    The last digit is the first one of the interval's half width, or the second if it begins with 1
    to 3.

    Args:
        value: Estimate.
        low: Lower end of the interval; None if unknown.
        high: Upper end of the interval; None if unknown.
    """
    if low is None or high is None or not (isfinite(low) and isfinite(high)) or high <= low:
        return f"{format_number(value)} (no interval)"
    # One power of ten for all three numbers makes them comparable at a glance.
    exponent = _get_exponent(max(abs(value), abs(low), abs(high)))
    # Logarithm of the half width as it is written; its fraction is that of the mantissa.
    half = log10((high - low) / 2) - exponent
    has_two_digits = half % 1 < _LOG_MAX_TWO_DIGIT_MANTISSA
    decimals = min(max(0, has_two_digits - floor(half)), 9)
    texts = []
    for x in (value, low, high):
        digits = f"{_divide_by_power(x, exponent):.{decimals}f}"
        texts.append(_format_sign(digits) + _format_power(exponent))
    middle, left, right = texts
    return f"{middle} ({left} to {right})"


def format_unit(unit: str) -> str:
    """Format a unit from a file, such as ``kg·m²``; empty for a pure number."""
    return user_messages.format_unit(sanitise(unit, 60))


def append_unit(text: str, unit: str) -> str:
    """Append a unit from a file to a number; a pure number has none."""
    return user_messages.append_unit(text, sanitise(unit, 60))


def format_percent(share: float | None) -> str:
    """Format a share as ``90 %``; with one decimal below 10 % and close to 100 %."""
    if share is None or not isfinite(share):
        return "–"
    size = abs(100 * share)
    # 99.6 % must not become 100 %, nor 0.4 % become 0 %.
    decimals = 1 if 0 < size < 9.95 or 99 < size < 99.95 else 0
    return _format_sign(f"{100 * share:.{decimals}f}") + " %"


def format_p_value(p: float | None) -> str:
    """Format a p-value, e.g. ``p = 0.03``."""
    if p is None or not isfinite(p):
        return "p unknown"
    # In such an extreme tail the exact number has no meaning.
    if p < _MIN_WRITTEN_P_VALUE:
        return f"p < {format_number(_MIN_WRITTEN_P_VALUE, 1)}"
    return f"p = {format_number(p, 2)}"


def _divide_by_power(value: float, exponent: int) -> float:
    """Return a number divided by a power of ten, which may be smaller than any float."""
    if exponent > _MIN_EXPONENT:
        return value / 10.0**exponent
    return value * 10.0**-_MIN_EXPONENT / 10.0 ** (exponent - _MIN_EXPONENT)


def _get_exponent(size: float) -> int:
    """Return the power of ten that a number is written with; 0 for none."""
    return 0 if size == 0 or _MIN_FIXED_POINT <= size < _MAX_FIXED_POINT else floor(log10(size))


def _format_power(exponent: int) -> str:
    return f"×10{str(exponent).translate(SUPERSCRIPT_DIGITS)}" if exponent else ""


def _format_sign(text: str) -> str:
    """Replace the hyphen by a true minus sign, and remove it from zero."""
    zero = not text.strip("-0.")
    return text.lstrip("-") if zero else text.replace("-", "−")


def format_csv(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Format a table as CSV that a spreadsheet can open safely.

    Args:
        head: Names of the columns.
        rows: Rows.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    # A spreadsheet would run text that begins like a formula, and names come from files.
    writer.writerows([_escape_formula(cell) for cell in row] for row in rows)
    return text.getvalue()


def _escape_formula(cell: object) -> object:
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(("=", "+", "-", "@")) else cell


def align_cells(text: str, left_columns: int) -> str:
    """Align the cells of a table for a terminal.

    Args:
        text: Lines whose cells are separated by `CELL_SEPARATOR`.
        left_columns: Number of columns, from the first one, that are left-justified.
    """
    rows = [line.split(CELL_SEPARATOR) for line in text.strip("\n").split("\n")]
    return "\n".join(align_columns(rows, left_columns)) + "\n"


def format_frame(frame: pd.DataFrame, spec: str) -> str:
    """Format a table of numbers for a terminal, without names of its axes.

    Args:
        frame: Table with the names of its rows as index.
        spec: Format of its numbers, such as ``.2g``.
    """
    unnamed: pd.DataFrame = frame.rename_axis(index=None, columns=None)
    text: str = unnamed.to_string(float_format=lambda value: f"{value:{spec}}")
    return text


def quote_words(words: Iterable[object]) -> Markup:
    """Format a command with its words quoted for a shell, as HTML.

    Line breaks and escape sequences in a path must not reach a terminal unchanged.
    """
    return escape(shlex.join(sanitise(word, 500) for word in words))


def format_document(text: str, max_length: int = MAX_DOCUMENT_LENGTH) -> Markup:
    """Format a text of several lines with its indentation, as HTML.

    Args:
        text: Text.
        max_length: Maximum number of characters.
    """
    shown = text if len(text) <= max_length else f"{text[:max_length]} …"
    lines = shown.strip("\n").replace("\t", "    ").split("\n")
    # `sanitise` removes leading spaces, so they are added again.
    indented = (" " * (len(line) - len(line.lstrip())) + sanitise(line, 1000) for line in lines)
    return escape("\n".join(indented))
