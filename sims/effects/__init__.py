"""Effect library: one effect family per module, registered by entry points as plugins are."""

from __future__ import annotations

from sims.core.effect import Effect
from sims.core.registry import PartUnavailableError, Registry
from sims.core.system import System

registry: Registry[Effect] = Registry("effect", "simgap.effects", Effect)

# Users of the library call `effects.get("drag.linear")`.
list_names = registry.names
get_effect = registry.get
register_effect = registry.register


def list_effects_for(system: type[System]) -> dict[str, type[Effect]]:
    """Return every usable effect that the system can have, by name.

    An effect whose package is missing is left out.

    Args:
        system: Class of the system.
    """
    usable = {}
    for name in registry.names():
        try:
            effect = registry.get(name)
        except PartUnavailableError:
            # Its package is missing; the list of effects shows this reason.
            continue
        for placed_effect in system.placed(effect):
            usable[placed_effect.name] = placed_effect
    return usable


def find_effect(name: str, system: type[System]) -> type[Effect]:
    """Return the effect of this name on a system: at one of its places, or a registered one.

    Args:
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        system: system on which the effect acts.

    Raises:
        InputError: no such effect exists.
    """
    return system.effect(name) or registry.get(name)
