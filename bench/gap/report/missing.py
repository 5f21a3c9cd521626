"""What is missing where a number, fitted apart, moves with something: physics in words.

A number stands for a law; where it takes another value at another load, speed or time, the law
holds nowhere but there, and the way in which it moves says which one holds everywhere.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from bench.gap.along import Kind

FAMILIES: Mapping[str, tuple[str, ...]] = {
    "viscous": ("drag.linear", "friction.direction"),
    "dry": ("friction.",),
    "resistance": ("drag.", "wind"),
    "spring": ("spring.",),
    "delay": ("input.delay", "input.lag", "sensor.delay", "sensor.lag"),
    "push": ("force.bias", "input.bias", "gravity.tilt"),
    "drive": ("input.gain", "actuator.", "torque", "winding", "servo."),
    "inertia": ("mass", "inertia", "armature"),
    "bounce": ("restitution",),
}
"""Laws, by how the names of their numbers begin; the first that fits."""
_WARMS = "friction that changes with time, as what rubs warms or wears"
_LOAD = "friction that depends on the load (friction.load)"
_WAY = "friction that differs by direction (friction.direction)"
_PLACE = "friction that depends on position"
_FASTER = "friction that grows faster than the speed (drag.quadratic)"
_RUBS: Mapping[Kind, str] = {
    "time": _WARMS, "load": _LOAD, "command": _LOAD, "direction": _WAY, "position": _PLACE,
}  # fmt: skip
LAWS: Mapping[str, str] = {
    "viscous": "friction", "dry": "friction", "resistance": "a resistance",
    "spring": "a stiffness", "delay": "a delay", "push": "a force", "drive": "a drive",
    "inertia": "an inertia", "bounce": "restitution",
}  # fmt: skip
"""In words."""
NAMES: Mapping[tuple[str, Kind], str | tuple[str, str]] = {
    **{
        (law, kind): text
        for law in ("viscous", "dry", "resistance")
        for kind, text in _RUBS.items()
    },
    ("viscous", "speed"): (_FASTER, "friction that does not grow with speed (friction.coulomb)"),
    ("viscous", "amplitude"): (
        _FASTER,
        "friction that does not grow with speed (friction.coulomb)",
    ),
    ("dry", "speed"): (
        "friction that grows with speed (drag.linear)",
        "dry friction that falls with speed (friction.stribeck)",
    ),
    ("spring", "amplitude"): "a stiffness that changes with deflection (spring.cubic)",
    ("delay", "command"): ("a limit of the rate (input.rate)", "play (backlash)"),
    ("delay", "amplitude"): ("a limit of the rate (input.rate)", "play (backlash)"),
    ("delay", "time"): "clocks that drift apart (clock.skew)",
    ("push", "direction"): _WAY,
    ("push", "load"): "a weight (gravity.scale)",
    ("push", "position"): "a force that depends on position (spring.linear)",
    ("push", "time"): "a force that drifts",
    ("drive", "command"): ("a dead zone (input.deadband)", "a limit (input.saturation)"),
    ("drive", "speed"): ("a drive that gains with speed", "a limit of the rate (input.rate)"),
    ("drive", "load"): "a supply that sags under load",
    ("drive", "supply"): "a drive that hangs on its supply",
    ("drive", "time"): "a supply that sags, or a drive that warms",
    ("inertia", "time"): "a load that changes",
    ("bounce", "speed"): "restitution that depends on speed (restitution.speed)",
}
"""What is missing, by law and by what its number moves with; two where growing is not falling."""


def missing(number: str, kind: Kind, name: str, grows: bool, known: Collection[str]) -> str:
    """What makes a number move, as a noun; as far as nothing is known, what it depends on.

    Args:
        number: its name, of a cause's coefficient with the effect.
        kind: what it moves with.
        name: of that, in words.
        grows: whether it grows with it.
        known: effects that are in the model already, and cannot be missing.
    """
    bare = number.partition("@")[0]
    family = next((law for law, begins in FAMILIES.items() if bare.startswith(begins)), "")
    found = NAMES.get((family, kind), "")
    text = found if isinstance(found, str) else found[0 if grows else 1]
    effect = text.partition("(")[2].rstrip(")")
    if not text or any(one.partition("@")[0] == effect for one in known):
        return f"{LAWS.get(family, 'something')} that depends on {name}"
    return text
