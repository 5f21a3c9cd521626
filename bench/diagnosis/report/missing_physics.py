"""Physical explanation of a trend: which effect would make a parameter move with a covariate.

A parameter belongs to a physical law. If its value depends on load, speed or time, the law is
incomplete, and the kind of dependence shows which law is missing.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from bench.diagnosis.validation.run_consistency import CovariateKind

LAW_PREFIXES: Mapping[str, tuple[str, ...]] = {
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
"""Prefixes of parameter names by law; the first law with a matching prefix applies."""
_WARMS = "friction that changes with time, as surfaces warm or wear,"
_LOAD = "friction that depends on the load (friction.load)"
_DIRECTION = "friction that differs by direction (friction.direction)"
_PLACE = "friction that depends on position"
_FASTER = "friction that grows faster than the speed (drag.quadratic)"
_FRICTION_BY_COVARIATE: Mapping[CovariateKind, str] = {
    "time": _WARMS, "load": _LOAD, "command": _LOAD, "direction": _DIRECTION, "position": _PLACE,
}  # fmt: skip
LAW_NAMES: Mapping[str, str] = {
    "viscous": "friction", "dry": "friction", "resistance": "a resistance",
    "spring": "a stiffness", "delay": "a delay", "push": "a force", "drive": "a drive",
    "inertia": "an inertia", "bounce": "restitution",
}  # fmt: skip
"""Names of the laws in words."""
MISSING_PHYSICS_NAMES: Mapping[tuple[str, CovariateKind], str | tuple[str, str]] = {
    **{
        (law, kind): text
        for law in ("viscous", "dry", "resistance")
        for kind, text in _FRICTION_BY_COVARIATE.items()
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
    ("push", "direction"): _DIRECTION,
    ("push", "load"): "a weight (gravity.scale)",
    ("push", "position"): "a force that depends on position (spring.linear)",
    ("push", "time"): "a force that drifts",
    ("drive", "command"): ("a dead zone (input.deadband)", "a limit (input.saturation)"),
    ("drive", "speed"): ("a drive that gains with speed", "a limit of the rate (input.rate)"),
    ("drive", "load"): "a supply that sags under load",
    ("drive", "supply"): "a drive that depends on its supply",
    ("drive", "time"): "a supply that sags, or a drive that warms",
    ("inertia", "time"): "a load that changes with time",
    ("bounce", "speed"): "restitution that depends on speed (restitution.speed)",
}
"""Missing effect by law and by covariate of the trend; two texts if an increasing and a decreasing
parameter have different explanations.
"""


def name_missing_physics(
    number: str, kind: CovariateKind, name: str, is_increasing: bool, known_effects: Collection[str]
) -> str:
    """Name the effect that would explain a trend, or else the dependence itself.

    Args:
        number: Name of the parameter; for a coefficient of a cause, it includes the effect.
        kind: Category of the covariate.
        name: Covariate in words.
        is_increasing: Whether the parameter increases with the covariate.
        known_effects: Effects in the model already, which cannot be missing.
    """
    base_name = number.partition("@")[0]
    family = next((law for law, prefix in LAW_PREFIXES.items() if base_name.startswith(prefix)), "")
    explanation = MISSING_PHYSICS_NAMES.get((family, kind), "")
    text = explanation if isinstance(explanation, str) else explanation[0 if is_increasing else 1]
    effect = text.partition("(")[2].rstrip(")")
    if not text or any(known_effect.partition("@")[0] == effect for known_effect in known_effects):
        return f"{LAW_NAMES.get(family, 'something')} that depends on {name}"
    return text
