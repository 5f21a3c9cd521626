"""The library of effects: one family a module, registered by entry point as third parties' are."""

from __future__ import annotations

from sims.registry import Registry, SkippedError
from sims.system import Effect, System

registry: Registry[Effect] = Registry("effect", "simgap.effects", Effect)

# What a user of the library asks it for reads `effects.get("drag.linear")`.
names = registry.names
get = registry.get
register = registry.register


def library(system: type[System]) -> dict[str, type[Effect]]:
    """Every usable effect that the system can have, by name."""
    usable = {}
    for name in registry.names():
        try:
            effect = registry.get(name)
        except SkippedError:  # whoever lists effects says why; explain does without
            continue
        for placed in system.placed(effect):
            usable[placed.name] = placed
    return usable


def find(name: str, system: type[System]) -> type[Effect]:
    """The effect of a name on a system: one of its places, or a registered one.

    Raises:
        InputError: there is none.
    """
    return system.effect(name) or registry.get(name)
