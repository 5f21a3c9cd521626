"""Format units for people."""

from __future__ import annotations

import re

SUPERSCRIPT_DIGITS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
"""Translation of digits and minus sign to superscripts."""
_POWER_PATTERN = re.compile(r"(?:\^|\*\*)(-?\d+)")


def format_unit(unit: str) -> str:
    """Format a unit for print, such as ``kg·m²`` for ``kg*m^2``; empty for a pure number."""
    raised = _POWER_PATTERN.sub(lambda match: match[1].translate(SUPERSCRIPT_DIGITS), unit)
    return "" if raised == "1" else raised.replace("*", "·")


def append_unit(text: str, unit: str) -> str:
    """Append a unit to a number; a pure number has none."""
    unit_text = format_unit(unit)
    return f"{text} {unit_text}" if unit_text else text
