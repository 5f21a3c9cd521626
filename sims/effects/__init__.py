"""The library of effects: one family a module, registered by entry point as third parties' are."""

from __future__ import annotations

from functools import lru_cache
from importlib.metadata import entry_points

from sims.base import InputError, unknown
from sims.system import Effect, System

_from_files: dict[str, type[Effect]] = {}


@lru_cache(maxsize=1)
def _registered() -> dict[str, type[Effect] | str]:
    """Every effect of the installed packages; for one that cannot be imported, the reason."""
    found: dict[str, type[Effect] | str] = {}
    for entry in entry_points(group="simgap.effects"):
        try:
            found[entry.name] = entry.load()
        except Exception as error:
            found[entry.name] = f"{type(error).__name__}: {error}"
    return found


def register(effect: type[Effect]) -> None:
    """Add an effect to the library.

    Raises:
        InputError: its name is taken.
    """
    if effect.name in names():
        raise InputError(f"effect '{effect.name}' exists already; give it another name")
    _from_files[effect.name] = effect


def names() -> list[str]:
    """All registered names, sorted."""
    return sorted({*_registered(), *_from_files})


def get(name: str) -> type[Effect]:
    """The effect of this name.

    Raises:
        InputError: there is none, or it cannot be imported.
    """
    found = _from_files.get(name) or _registered().get(name)
    if found is None:
        raise unknown("effect", name, names())
    if isinstance(found, str):
        raise InputError(f"effect {name} cannot be used here: {found}")
    return found


def library(system: type[System]) -> dict[str, type[Effect]]:
    """Every usable effect that the system can have, by name."""
    usable = {
        name: found
        for name in names()
        if not isinstance(found := _from_files.get(name) or _registered()[name], str)
    }
    return {name: effect for name, effect in usable.items() if effect.fits(system)}
