"""Convert values from the units of a file to SI units.

Angles have their own dimension here: with the SI definition, hertz would be accepted as radians per
second, and a plain number as an angle.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from sims.core.simulator import Array, InputError, make_read_only

_MAX_UNIT_LENGTH = 60
"""Maximum number of characters of a unit."""
_LINEARITY_TOLERANCE = 1e-9
"""Relative deviation from a linear conversion that is accepted as rounding error."""
# Allow names, 1 and small powers only, so that the parser of pint cannot be made to compute for
# long.
_TOKEN = re.compile(
    r"\s*(?:(?P<power>(?:\*\*|\^)\s*[+-]?\d{1,2}(?!\d)|⁻?[¹²³⁴])"
    r"|(?P<operator>[*/·⋅])|(?P<bracket>[()])"
    r"|(?P<name>[^\W\d][\w°%]*|[°%Ω℃]\w*|1(?![\d.])))\s*"
)


class UnitScale(NamedTuple):
    """Linear conversion of a unit: value * gain + offset."""

    gain: float
    offset: float


IDENTITY_SCALE = UnitScale(1.0, 0.0)
"""Identity conversion, which leaves values unchanged bit for bit."""


@lru_cache(maxsize=256)
def compute_unit_scale(unit: str, target: str) -> UnitScale:
    """Return the conversion from `unit` to `target`.

    The conversion is value * gain + offset; the offset is needed for temperatures.

    Args:
        unit: Unit of the values.
        target: Unit to convert them to.

    Raises:
        InputError: `unit` is not a unit or does not convert to `target`; the message names neither
            file nor channel, so that the caller can put them in front.
    """
    if unit == target:
        return IDENTITY_SCALE
    # Other texts could keep the parser busy for ever.
    if len(unit) > _MAX_UNIT_LENGTH or not _is_simple_unit(unit):
        raise InputError(
            f"expected a unit that converts to {target}, found {unit[:_MAX_UNIT_LENGTH]!r}"
        )
    registry = _get_unit_registry()
    try:
        parsed = registry.parse_units(unit or "1")
    except Exception:
        # The parser raises many kinds of errors.
        raise InputError(f"unknown unit {unit!r}; expected one that converts to {target}") from None
    try:
        # Three values determine gain and offset, and show whether the conversion is linear.
        value_at_zero, value_at_one, value_at_two = (
            float(registry.Quantity(v, parsed).to(target).magnitude) for v in (0.0, 1.0, 2.0)
        )
    except Exception:
        # The dimensions differ, or the unit is logarithmic.
        hint = "; standard gravity is g_0" if unit == "g" else ""
        raise InputError(
            f"expected a unit that converts to {target}, found {unit!r}{hint}"
        ) from None
    gain = value_at_one - value_at_zero
    if abs(value_at_two - value_at_one - gain) > _LINEARITY_TOLERANCE * abs(gain):
        raise InputError(f"expected a unit that converts to {target} in proportion, found {unit!r}")
    # A gain that differs from 1 by rounding is 1.
    return (
        IDENTITY_SCALE
        if value_at_zero == 0.0 and abs(gain - 1.0) < 1e-12
        else UnitScale(gain, value_at_zero)
    )


def convert_values(values: Array, scale: UnitScale, subject: str) -> Array:
    """Convert values to another unit.

    Shapes: T samples.

    Args:
        values: (T,) values, NaN where missing.
        scale: Conversion of their unit.
        subject: What the values are, such as file, run and column; error messages begin with it.

    Returns:
        (T,) converted values, read-only; `values` itself if nothing changes.

    Raises:
        InputError: A converted value is too large for a floating-point number.
    """
    if scale == IDENTITY_SCALE:
        return values
    # An overflow is reported below with the name of its column, which a warning would lack.
    with np.errstate(over="ignore"):
        result = values * scale.gain + scale.offset
    if np.isinf(result).any():
        raise InputError(f"{subject}: a value is too large to convert to SI units")
    return make_read_only(result)


def is_convertible(unit: str, target: str) -> bool:
    """Return whether a unit converts to another one.

    Args:
        unit: Name of the unit; an empty one does not convert.
        target: Name of the other unit.
    """
    try:
        compute_unit_scale(unit, target)
    except InputError:
        return False
    return bool(unit)


def is_unit(unit: str) -> bool:
    """Return whether `unit` can be converted, which means that pint knows every name in it.

    Args:
        unit: Text such as "N*m" or "rad/s".
    """
    if len(unit) > _MAX_UNIT_LENGTH or not _is_simple_unit(unit):
        return False
    try:
        _get_unit_registry().parse_units(unit)
    except Exception:
        # The parser raises many kinds of errors.
        return False
    return True


def _is_simple_unit(unit: str) -> bool:
    """Return whether a text is a simple unit, which can be given to pint's parser safely.

    A simple unit consists of names and 1, joined by * / or spaces, each with at most one small
    power. A text such as 9**9**9 would keep the parser busy for ever.

    Args:
        unit: text of any kind; an empty one is not simple.
    """
    # The beginning counts as an operator, since neither a power nor the end may follow it.
    position, previous_kind = 0, "operator"
    while position < len(unit):
        token = _TOKEN.match(unit, position)
        if token is None:
            return False
        kind = str(token.lastgroup)
        if kind == "power" and previous_kind in ("power", "operator"):
            return False
        position, previous_kind = token.end(), kind
    return previous_kind != "operator"


@lru_cache(maxsize=1)
def _get_unit_registry() -> Any:
    """Return pint's registry of units, in which an angle has its own dimension.

    pint treats an angle as a plain number; here rad is a dimension, so that rad/s is not confused
    with 1/s.
    """
    # Imported here: it takes a second, and most recordings are in SI units.
    import pint

    registry: Any = pint.UnitRegistry(on_redefinition="ignore")
    registry.define("radian = [angle] = rad")
    # In pint, Nm is the count of a yarn by default.
    registry.define("newton_meter = newton * meter = Nm")
    # Clear the cache, in which an angle is still a plain number.
    registry._build_cache()
    return registry
