"""Causes that can be hidden in a machine: their places, and coefficients by strength.

Strength 1 is the upper end of the plausible range.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bench.diagnosis_benchmark.machine_cases.machine_dynamics import MACHINES
from bench.diagnosis_benchmark.machine_cases.machine_recording_conditions import (
    MachineRecordingConditions,
)

CoefficientFunction = Callable[[float], tuple[float, ...]]

JOINT_EFFECTS = (
    "drag.linear",
    "drag.quadratic",
    "force.bias",
    "force.ripple",
    "friction.coulomb",
    "friction.stribeck",
    "spring.linear",
)
INPUT_EFFECTS = (
    "input.bias",
    "input.deadband",
    "input.delay",
    "input.gain",
    "input.lag",
    "input.saturation",
)
SENSOR_EFFECTS = ("sensor.bias", "sensor.delay", "sensor.drift", "sensor.gain")
GRAVITY_EFFECTS = ("gravity.scale", "gravity.tilt")
_ABSORBED_BY_PARAMETERS = {"drag.linear", "input.gain", "sensor.gain"}
"""Effects that the parameters of a servo absorb entirely or almost entirely."""
EFFECTS_BY_MACHINE = {
    "servo": tuple(
        sorted(
            {*JOINT_EFFECTS, *INPUT_EFFECTS, *SENSOR_EFFECTS, "gravity.tilt", "servo.deadband"}
            - _ABSORBED_BY_PARAMETERS
        )
    ),
    "arm2": tuple(
        sorted(
            {
                *JOINT_EFFECTS,
                *INPUT_EFFECTS,
                *SENSOR_EFFECTS,
                *GRAVITY_EFFECTS,
                "inertia.armature",
                "mass.scale",
            }
        )
    ),
}
"""Effects that can be hidden, by machine."""
UNMODELLED_CAUSES = ("gust", "patch")
"""Causes that the library does not contain.

They are a temporary force in every run, and dry friction in a part of a joint's travel.
"""
SIGNED_EFFECTS = (
    "force.bias",
    "gravity.scale",
    "gravity.tilt",
    "input.bias",
    "input.gain",
    "mass.scale",
    "sensor.bias",
    "sensor.drift",
    "sensor.gain",
)
_MAX_COEFFICIENTS = {
    "gravity.scale": 0.3,
    "input.delay": 0.1,
    "input.gain": 0.4,
    "input.lag": 0.2,
    "mass.scale": 0.5,
    "sensor.bias": 0.2,
    "sensor.delay": 0.1,
    "sensor.drift": 0.1,
    "sensor.gain": 0.3,
}
"""Coefficient at strength 1 of effects that need no scale of the motion."""
TILT_AT_STRENGTH_ONE = 0.3
"""Tilt of gravity at strength 1, rad."""
DEADBAND_AT_STRENGTH_ONE = 0.3
"""Dead band of a servo at strength 1, rad."""
STRIBECK_FORCE_SHARE = 0.3
"""Coulomb friction at strength 1, as a share of the joint's typical force."""


def list_effect_places(system: str, effect: str) -> tuple[str, ...]:
    """List the places of an effect or unmodelled cause, as ``effect@place`` or ``effect`` alone.

    Places are joints, bodies, motors or channels. Gravity acts on the whole machine, and a servo
    has one joint only, so these need no place.

    Args:
        system: servo or arm2.
        effect: name of the effect or cause.
    """
    plant = MACHINES[system]
    if effect in GRAVITY_EFFECTS or system == "servo":
        return (effect,)
    if effect == "mass.scale":
        places: tuple[str, ...] = plant.bodies
    elif effect in INPUT_EFFECTS:
        places = plant.motors
    elif effect in SENSOR_EFFECTS:
        places = plant.channels
    else:
        places = plant.joints
    return tuple(f"{effect}@{place}" for place in places)


def get_joint(system: str, place: str) -> int:
    """Return the index of the joint that a place belongs to; each joint has one of each kind.

    Args:
        system: servo or arm2.
        place: name of a joint, body, motor or channel; empty for an effect on the whole machine,
            which gets index 0.
    """
    plant = MACHINES[system]
    for names in (plant.joints, plant.bodies, plant.motors, plant.channels):
        if place in names:
            return names.index(place)
    return 0


def draw_effect_shape(
    name: str, setting: MachineRecordingConditions, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw the shape of a cause at a place: everything but its strength, such as its sign.

    The largest coefficient is fixed for some effects (`_MAX_COEFFICIENTS`). Forces are scaled by
    the typical forces and speeds of the joint, other effects of the input by its commands.

    Args:
        name: ``cause@place``, or ``cause`` alone.
        setting: recording conditions.
        rng: random generator.

    Returns:
        Coefficients as a function of the strength.
    """
    effect, _, place = name.partition("@")
    joint = get_joint(setting.system, place)
    if effect in UNMODELLED_CAUSES:
        return _draw_unmodelled_cause(effect, joint, setting, rng)
    typical_scales = {
        quantity: float(values[joint]) for quantity, values in setting.motion_scales.items()
    }
    sign = float(rng.choice([-1.0, 1.0])) if effect in SIGNED_EFFECTS else 1.0
    if effect in _MAX_COEFFICIENTS:
        return lambda strength: (sign * _MAX_COEFFICIENTS[effect] * strength,)
    if effect in MOTION_SCALED_EFFECTS:
        return MOTION_SCALED_EFFECTS[effect](typical_scales, rng)
    if effect == "gravity.tilt":
        # An arm can be tilted along x and y, of which its motion in a plane shows only the first.
        tilt_along_y = (0.0,) if setting.system == "arm2" else ()
        return lambda strength: (TILT_AT_STRENGTH_ONE * sign * strength, *tilt_along_y)
    command = setting.fitted_runs.commands[:, :, joint]
    max_command = float(np.abs(command).max())
    return {
        "input.bias": lambda strength: (sign * float(np.ptp(command)) / 2 * strength,),
        "input.deadband": lambda strength: (max_command * strength,),
        # Strength 0 limits the command at its peak, strength 1 at zero.
        "input.saturation": lambda strength: (max_command * (1 - strength),),
        "servo.deadband": lambda strength: (DEADBAND_AT_STRENGTH_ONE * strength,),
    }[effect]


def _make_force_drawer(
    get_factor: Callable[[dict[str, float]], float],
) -> Callable[..., CoefficientFunction]:
    """Make the function that draws an effect whose force is proportional to its coefficient.

    At strength 1, the coefficient times `get_factor` is twice the typical force of the joint.

    Args:
        get_factor: returns, from the typical scales of the joint, the quantity by which the
            coefficient is multiplied to give the force, such as the speed for a linear drag.
    """

    def draw_coefficients(
        typical: dict[str, float], rng: np.random.Generator
    ) -> CoefficientFunction:
        """Draw the effect from the typical scales of its joint; `rng` is not used."""
        coefficient_scale = 2.0 * typical["force"] / get_factor(typical)
        return lambda strength: (coefficient_scale * strength,)

    return draw_coefficients


def _draw_ripple(typical_scales: dict[str, float], rng: np.random.Generator) -> CoefficientFunction:
    """Draw a force that is periodic in the joint angle; its amplitude is twice the typical force.

    The motion passes 1.5 to 4 periods, and the period is between 0.08 and 1 rad.

    Args:
        typical_scales: typical scales of the joint: force, inertia, position, speed and travel.
        rng: random generator.

    Returns:
        Function from the strength to sine amplitude, cosine amplitude, and period.
    """
    angle = rng.uniform(0, 2 * np.pi)  # phase
    period = float(np.clip(typical_scales["travel"] / rng.uniform(1.5, 4.0), 0.08, 1.0))
    sine, cosine = (
        2 * typical_scales["force"] * float(function(angle)) for function in (np.sin, np.cos)
    )
    return lambda strength: (sine * strength, cosine * strength, period)


def _draw_stribeck(
    typical_scales: dict[str, float], rng: np.random.Generator
) -> CoefficientFunction:
    """Draw Stribeck friction: Coulomb friction and a larger part that ends at some speed.

    Args:
        typical_scales: typical scales of the joint: force, inertia, position, speed and travel.
        rng: random generator.

    Returns:
        Function from the strength to Coulomb friction, additional friction at rest, and Stribeck
        speed.
    """
    # Additional friction at rest, in Coulomb frictions.
    extra = float(rng.uniform(2.0, 6.0))
    speed = typical_scales["speed"] * float(rng.uniform(0.15, 0.5))
    return lambda strength: (
        STRIBECK_FORCE_SHARE * typical_scales["force"] * strength,
        STRIBECK_FORCE_SHARE * extra * typical_scales["force"] * strength,
        speed,
    )


MOTION_SCALED_EFFECTS: dict[str, Callable[..., CoefficientFunction]] = {
    "drag.linear": _make_force_drawer(lambda typical: typical["speed"]),
    "drag.quadratic": _make_force_drawer(lambda typical: typical["speed"] ** 2),
    "force.bias": _make_force_drawer(lambda typical: 1.0),
    "force.ripple": _draw_ripple,
    "friction.coulomb": _make_force_drawer(lambda typical: 2.0),
    "friction.stribeck": _draw_stribeck,
    "inertia.armature": lambda typical, rng: (
        lambda strength: (2.0 * typical["inertia"] * strength,)
    ),
    "spring.linear": _make_force_drawer(lambda typical: typical["position"] + 0.05),
}
"""Functions that draw the shape of an effect from the typical scales of its joint and a generator.

The scales are force, inertia, position, speed and travel.
"""


def _draw_unmodelled_cause(
    cause: str, joint: int, setting: MachineRecordingConditions, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw the shape of an unmodelled cause: when a gust acts, or where a patch of friction lies.

    Args:
        cause: gust or patch.
        joint: index of the joint on which it acts.
        setting: recording conditions.
        rng: random generator.

    Returns:
        Function from the strength to the numbers of the cause: force (N·m), begin and duration (s)
        of a gust, or friction limit (N·m), centre and half width (rad) of a patch.
    """
    force = float(setting.motion_scales["force"][joint])
    if cause == "gust":
        # Duration and begin of the gust, in s.
        duration = float(rng.uniform(0.1, 0.3) * setting.seconds)
        start = float(rng.uniform(0.1, 0.6) * setting.seconds)
        sign = float(rng.choice([-1.0, 1.0]))
        return lambda strength: (2.0 * sign * force * strength, start, duration)
    path = setting.base_motion.q[:, :, joint]
    # Centre and half width of the region, in rad.
    centre = float(np.quantile(path, rng.uniform(0.3, 0.7)))
    half_width = float(np.ptp(path) * rng.uniform(0.08, 0.2))
    return lambda strength: (2.0 * force * strength, centre, half_width)
