"""Give the elements of a model file names that effect places can refer to.

Effect places refer to elements by name. So every element needs a name, without the characters that
separate the parts of a place or of an option.
"""

from __future__ import annotations

from typing import Any
from xml.etree.ElementTree import Element

from sims.robot.mujoco_messages import format_name_list

RESERVED_CHARACTERS = "@=,*"
"""Characters with a meaning in places and options, which names must not contain.

Examples: ``friction.coulomb@elbow=0.3`` and ``--free damping@*,mass@forearm``.
"""


FREE_TEXT_ATTRIBUTES = ("file", "class", "childclass", "filename")
"""XML attributes whose values are not names of elements."""


def rename_invalid_names(root: Element) -> list[str]:
    """Rename elements whose names contain `RESERVED_CHARACTERS`, and all references to them.

    Users write the place of an effect as ``EFFECT@NAME``, so names must not contain such a
    character. It is replaced by an underscore; further underscores make the name unique.

    Args:
        root: root element of the model file; it is changed in place.

    Returns:
        Notes, at most one.
    """
    names = {element.get("name") or "" for element in root.iter()}
    changed: dict[str, str] = {}  # new name by name in the file
    for name in sorted(names):
        valid_name = name.strip()
        for character in RESERVED_CHARACTERS:
            valid_name = valid_name.replace(character, "_")
        # An empty name, that of elements without one, stays.
        if valid_name == name:
            continue
        while valid_name in names or valid_name in changed.values() or not valid_name:
            valid_name += "_"
        changed[name] = valid_name
    # References to an element are attributes whose value is its name.
    for element in root.iter():
        for key, value in element.items():
            if value in changed and key not in FREE_TEXT_ATTRIBUTES:
                element.set(key, changed[value])
    pairs = [f"{name} -> {valid_name}" for name, valid_name in changed.items()]
    if not pairs:
        return []
    changes = format_name_list(pairs)
    return [f"renamed, since places are written with {RESERVED_CHARACTERS}: {changes}"]


def name_unnamed_elements(spec: Any) -> list[str]:
    """Name unnamed joints, actuators, bodies and sensors of a spec by their numbers in the file.

    Examples are ``joint3`` and ``body0``; underscores are added if another element has this name.

    Args:
        spec: the mujoco.MjSpec; it is changed in place.

    Returns:
        Notes, one for each kind of element with new names.
    """
    notes = []
    kinds = {
        "joint": spec.joints,
        "actuator": spec.actuators,
        "body": spec.bodies,
        "sensor": spec.sensors,
    }
    for kind, parts in kinds.items():
        used_names = {part.name for part in parts}
        new_names = []
        for number, part in enumerate(parts):
            if part.name:
                continue
            name = f"{kind}{number}"
            while name in used_names:
                name += "_"
            part.name = name
            used_names.add(name)
            new_names.append(name)
        if new_names:
            notes.append(f"without a name in the file, called here: {format_name_list(new_names)}")
    return notes
