"""Texts and numbers as a person reads them, in pages, figures and on the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from math import floor, isfinite, log10

RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
"""Digits and the sign as they stand in a power."""
_SMALL = 1e-3
"""Magnitude below which numbers are written with a power of ten."""
_LARGE = 1e5
"""Magnitude from which on numbers are written with a power of ten."""
_FEW = log10(3.55)
"""Mantissa of an interval below which it is written with two digits (Particle Data Group's rule).
"""
_LEAST = 1e-12
"""Probabilities below this are all the same."""


def clean(text: object, most: int = 400) -> str:
    """Text from a file or plugin on one line: what a terminal would obey is spelled out, what is
    too long cut.
    """
    plain = "".join(_harmless(c) for c in str(text)).strip()
    return plain if len(plain) <= most else plain[: most - 1] + "…"


def joined(parts: Sequence[str], last: str = "and") -> str:
    """Join names as ``a``, ``a and b`` or ``a, b and c``."""
    if len(parts) < 2:
        return "".join(parts)
    return f"{', '.join(parts[:-1])} {last} {parts[-1]}"


def _harmless(character: str) -> str:
    if character.isprintable():
        return character
    # A line break or tab is a space; an escape sequence or a change of direction is spelled out.
    return " " if character.isspace() else ascii(character)[1:-1]


def number(value: float | None, digits: int = 3) -> str:
    """With so many significant digits; a dash where there is none."""
    if value is None or not isfinite(value):
        return "–"
    if value == 0:
        return "0"
    # Rounded first: 0.0009996 is 0.001, which needs no power of ten.
    rounded = float(f"{value:.{digits - 1}e}")
    exponent = _exponent(abs(rounded))
    decimals = max(0, digits - 1 - floor(log10(abs(rounded))) + exponent)
    text = f"{rounded / 10.0**exponent:.{decimals}f}"
    # Zeros before the decimal point are digits, those behind it are none.
    if "." in text:
        text = text.rstrip("0").rstrip(".")
    return _signed(text) + _power(exponent)


def estimate(value: float, low: float | None, high: float | None) -> str:
    """``0.00333 (0.00330 to 0.00336)``: one digit of the interval's half width, two where it begins
    with 1 to 3.
    """
    if low is None or high is None or not (isfinite(low) and isfinite(high)) or high <= low:
        return f"{number(value)} (no interval)"
    # One power of ten for all three, or they could not be compared at a glance.
    exponent = _exponent(max(abs(value), abs(low), abs(high)))
    half = log10((high - low) / 2) - exponent
    decimals = min(max(0, (half % 1 < _FEW) - floor(half)), 9)
    texts = []
    for x in (value, low, high):
        digits = f"{x / 10.0**exponent:.{decimals}f}"
        texts.append(_signed(digits) + _power(exponent))
    middle, left, right = texts
    return f"{middle} ({left} to {right})"


def percent(share: float | None) -> str:
    """A share as ``90 %``; below 10 % and close to 100 % with one decimal."""
    if share is None or not isfinite(share):
        return "–"
    size = abs(100 * share)
    # 99.6 % is not all, and 0.4 % is not nothing.
    decimals = 1 if 0 < size < 9.95 or 99 < size < 99.95 else 0
    return _signed(f"{100 * share:.{decimals}f}") + " %"


def probability(p: float | None) -> str:
    """``p = 0.03``."""
    if p is None or not isfinite(p):
        return "p unknown"
    # Of a tail so far out the number itself means nothing.
    return f"p < {number(_LEAST, 1)}" if p < _LEAST else f"p = {number(p, 2)}"


def _exponent(size: float) -> int:
    """The power of ten that a number is written with; 0 for none."""
    return 0 if size == 0 or _SMALL <= size < _LARGE else floor(log10(size))


def _power(exponent: int) -> str:
    return f"×10{str(exponent).translate(RAISED)}" if exponent else ""


def _signed(text: str) -> str:
    """With a true minus sign, and none before a zero."""
    zero = not text.strip("-0.")
    return text.lstrip("-") if zero else text.replace("-", "−")
