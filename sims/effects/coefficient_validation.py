"""Check the effects and coefficients that a user states: their types, numbers and sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sims.core.effect import Effect
from sims.core.number_limits import is_plausible_number
from sims.core.simulator import InputError
from sims.core.system import System
from sims.core.toml_validation import format_value

MAX_COEFFICIENT_FACTOR = 1e6
"""Factor of its largest plausible value above which a coefficient is refused as a mistake."""


def check_effect_types(effects: object, fixed: object) -> None:
    """Check the types of effects and fixed coefficients, which may come from an experiment's file.

    Args:
        effects: Effects to be fitted: a list of names or effect classes.
        fixed: Coefficients of known effects by name, or None; numbers are not checked here.

    Raises:
        InputError: A type is wrong.
    """
    if not isinstance(effects, list | tuple) or not all(map(_is_effect_reference, effects)):
        raise InputError(f"effects: expected a list of names, found {format_value(effects)}")
    if fixed is not None and not isinstance(fixed, Mapping):
        expected = "a table of coefficients by effect"
        raise InputError(f"fixed: expected {expected}, found {format_value(fixed)}")


def _is_effect_reference(value: object) -> bool:
    return isinstance(value, str) or (isinstance(value, type) and issubclass(value, Effect))


def read_coefficients(name: str, value: Any) -> tuple[float, ...]:
    """Return the coefficients of a fixed effect as a tuple of numbers.

    Args:
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        value: a number, or a list of numbers.

    Raises:
        InputError: a coefficient is not a finite number of plausible size.
    """
    values = value if isinstance(value, list | tuple) else (value,)
    if not all(map(is_plausible_number, values)):
        raise InputError(
            f"effect {name}: expected finite coefficients, found {format_value(value)}"
        )
    return tuple(float(v) for v in values)


def check_coefficient_sizes(effect: Effect, system: type[System], values: Sequence[float]) -> None:
    """Check that no coefficient is larger than its plausible range by `MAX_COEFFICIENT_FACTOR`.

    Args:
        effect: effect of the library: a force, friction, input, sensor or contact law.
        system: the system on which it acts.
        values: its first coefficients in order.

    Raises:
        InputError: A coefficient is too large; the message states the limit with its unit.
    """
    # Coefficients that are not given are zero.
    for coefficient, value in zip(effect.on(system), values, strict=False):
        largest = max(map(abs, coefficient.range(system.kind)))
        if abs(value) > MAX_COEFFICIENT_FACTOR * largest:
            unit = coefficient.unit_on(system) or ""
            expected = f"within ±{MAX_COEFFICIENT_FACTOR * largest:g} {unit}".rstrip()
            raise InputError(
                f"effect {effect.name}: expected {coefficient.name} {expected}, found {value:g}"
            )
