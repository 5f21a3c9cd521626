"""Names of a model's parts, as places need them: each has one, and none holds what divides the
words of a place or an option.
"""

from __future__ import annotations

from typing import Any
from xml.etree.ElementTree import Element

from sims.robot.words import listed

DIVIDING = "@=,*"
"""``friction.coulomb@elbow=0.3``, ``--free damping@*,mass@forearm``."""
FREE = ("file", "class", "childclass", "filename")
"""Attributes whose values are no names of parts."""


def renamed(root: Element) -> list[str]:
    """Rename what cannot be a place, wherever it is named."""
    named = {element.get("name") or "" for element in root.iter()}
    changed: dict[str, str] = {}
    for name in sorted(named):
        other = name.strip()
        for character in DIVIDING:
            other = other.replace(character, "_")
        if other == name:
            continue
        while other in named or other in changed.values() or not other:
            other += "_"
        changed[name] = other
    for element in root.iter():
        for key, value in element.items():
            if value in changed and key not in FREE:
                element.set(key, changed[value])
    pairs = [f"{name} -> {other}" for name, other in changed.items()]
    return [f"renamed, since places are written with {DIVIDING}: {listed(pairs)}"] if pairs else []


def given(spec: Any) -> list[str]:
    """Name the joints, actuators, bodies and sensors of a spec that have no name, by their numbers
    in the file.
    """
    notes = []
    kinds = {
        "joint": spec.joints,
        "actuator": spec.actuators,
        "body": spec.bodies,
        "sensor": spec.sensors,
    }
    for kind, parts in kinds.items():
        taken = {part.name for part in parts}
        new = []
        for number, part in enumerate(parts):
            if part.name:
                continue
            name = f"{kind}{number}"
            while name in taken:
                name += "_"
            part.name = name
            taken.add(name)
            new.append(name)
        if new:
            notes.append(f"without a name in the file, called here: {listed(new)}")
    return notes
