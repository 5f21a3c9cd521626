"""Conversion between units, so that a recording may state its own.

An angle is a dimension of its own here: by the letter of the SI, hertz would pass for radians per
second, and a plain number for an angle.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any, NamedTuple

from sims.base import InputError

_LONGEST = 60
"""Characters of a unit."""
_ROUNDING = 1e-9
"""Share of the gain by which a conversion in proportion may miss being one."""
# All that a unit needs, and nothing that could make the parser behind compute for long: names, 1,
# small powers.
_TOKEN = re.compile(
    r"\s*(?:(?P<power>(?:\*\*|\^)\s*[+-]?\d{1,2}(?!\d)|⁻?[¹²³⁴])"
    r"|(?P<operator>[*/·⋅])|(?P<bracket>[()])"
    r"|(?P<name>[^\W\d][\w°%]*|[°%Ω℃]\w*|1(?![\d.])))\s*"
)


class Scale(NamedTuple):
    """How a unit becomes another: value * gain + offset."""

    gain: float
    offset: float


SAME = Scale(1.0, 0.0)
"""Nothing to convert, so that values stay as they are, bit for bit."""


@lru_cache(maxsize=256)
def scale(unit: str, target: str) -> Scale:
    """How values in `unit` become values in `target`.

    Raises:
        InputError: `unit` is no unit, or does not convert to `target`; the message begins with what
            is wrong with it and names neither file nor channel.
    """
    if unit == target:
        return SAME
    if len(unit) > _LONGEST or not _plain(unit):
        raise InputError(f"expected a unit that converts to {target}, found {unit[:_LONGEST]!r}")
    registry = _registry()
    try:
        parsed = registry.parse_units(unit or "1")
    except Exception:
        # the parser raises whatever it trips over
        raise InputError(f"unknown unit {unit!r}; expected one that converts to {target}") from None
    try:
        # three values tell gain and offset, and whether that is all there is to it
        zero, one, two = (
            float(registry.Quantity(v, parsed).to(target).magnitude) for v in (0.0, 1.0, 2.0)
        )
    except Exception:
        # dimensions differ, or the unit is logarithmic
        hint = "; standard gravity is g_0" if unit == "g" else ""
        raise InputError(
            f"expected a unit that converts to {target}, found {unit!r}{hint}"
        ) from None
    gain = one - zero
    if abs(two - one - gain) > _ROUNDING * abs(gain):
        raise InputError(f"expected a unit that converts to {target} in proportion, found {unit!r}")
    # what differs from 1 by rounding is 1
    return SAME if zero == 0.0 and abs(gain - 1.0) < 1e-12 else Scale(gain, zero)


def is_unit(unit: str) -> bool:
    """Return whether `unit` can be converted: pint knows every name in it."""
    if len(unit) > _LONGEST or not _plain(unit):
        return False
    try:
        _registry().parse_units(unit)
    except Exception:
        # the parser raises whatever it trips over
        return False
    return True


def _plain(unit: str) -> bool:
    """Whether the text is names and 1, joined by * / or spaces, each perhaps to one small power."""
    place, before = 0, "operator"
    while place < len(unit):
        token = _TOKEN.match(unit, place)
        if token is None or (token.lastgroup == "power" and before in ("power", "operator")):
            return False
        place, before = token.end(), str(token.lastgroup)
    return before != "operator"


@lru_cache(maxsize=1)
def _registry() -> Any:
    # here, since it takes a second, and most recordings are in SI
    import pint

    registry: Any = pint.UnitRegistry(on_redefinition="ignore")
    registry.define("radian = [angle] = rad")
    # it means the count of a yarn otherwise
    registry.define("newton_meter = newton * meter = Nm")
    # forgets that an angle was a plain number
    registry._build_cache()
    return registry
