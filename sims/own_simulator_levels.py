"""Effects on the levels of a user-defined simulator.

A registered effect on levels becomes one class per level, named ``effect@level`` if there are
several levels. Its unit is that of the level, and its range is scaled to the typical size of the
level.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

from sims.core.effect import Coefficient, Effect, Level
from sims.core.registry import PartUnavailableError
from sims.core.simulator import InputError, make_unknown_name_error
from sims.core.system import System
from sims.effects import registry


@lru_cache(maxsize=64)
def make_level_effects(effect: type[Level], system: type[System]) -> tuple[type[Effect], ...]:
    """Return the effect at each level of a system; empty if it has no levels.

    Args:
        effect: Registered effect.
        system: System of a user-defined simulator.
    """
    levels = [channel for channel in system.channels if channel.name in system.levels]
    effects = []
    for channel in levels:
        has_several_levels = len(levels) > 1
        body = {
            "name": f"{effect.name}@{channel.name}" if has_several_levels else effect.name,
            "of": effect.name,
            "place": channel.name if has_several_levels else "",
            "coefficients": [_sized(c, channel.unit, channel.scale) for c in effect.coefficients],
            "__module__": __name__,
            "__doc__": effect.__doc__,
        }
        effects.append(type(f"{effect.__name__}At", (effect,), body))
    return tuple(effects)


def _sized(c: Coefficient, unit: str, scale: float) -> Coefficient:
    """Convert a coefficient to the unit and size of a level."""
    low, high = c.plausible[0]
    return replace(c, units=(unit,) * 3, plausible=((low * scale, high * scale),) * 3)


def find_level_effect(name: str, system: type[System]) -> type[Effect] | None:
    """Return the effect with a name such as ``state.overflow@upper``; None if it is not on levels.

    Args:
        name: Name of the effect.
        system: System of a user-defined simulator.

    Raises:
        InputError: The effect is not possible on this system or at this place; the message states
            the reason or the possible places.
    """
    base, separator, place = name.partition("@")
    try:
        effect = registry.get(base)
    except PartUnavailableError:
        return None
    if not issubclass(effect, Level) or not system.levels:
        return None
    if reason := effect.misses(system):
        raise InputError(f"system {system.name} cannot have effect {name}: {reason}")
    effects_by_name = {
        effect_class.name: effect_class for effect_class in make_level_effects(effect, system)
    }
    if name in effects_by_name:
        return effects_by_name[name]
    places: Sequence[str] = [effect_class.place for effect_class in effects_by_name.values()]
    if not separator:
        alternatives = ", ".join(f"{base}@{place_name}" for place_name in places)
        raise InputError(f"effect {base} of simulator {system.name} needs a place: {alternatives}")
    raise make_unknown_name_error(
        f"place of effect {base} in simulator {system.name}", place, list(system.levels)
    )
