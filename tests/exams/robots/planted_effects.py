"""Causes that can be hidden, their places and their coefficients.

Coefficients are a function of a strength; strength 1 is the largest plausible value.

They are friction that the work of another joint heats, cogging with hysteresis, friction in a part
of the range, and a slipping encoder.
"""

from __future__ import annotations

import numpy as np

from bench.diagnosis_benchmark.case_generation.effect_coefficients import (
    SHAPE_SAMPLERS,
    draw_direction,
)
from bench.diagnosis_benchmark.machine_cases.machine_effect_coefficients import (
    MOTION_SCALED_EFFECTS,
)

JOINT = (
    "friction.coulomb", "friction.stribeck", "drag.linear", "drag.quadratic", "spring.linear",
    "inertia.armature", "force.bias", "force.ripple", "friction.direction",
    "friction.position", "friction.warming",
    "friction.load", "friction.load_direction", "friction.load_quadratic", "state.limit",
    "friction.hysteresis", "joint.flexibility", "joint.backlash", "joint.coupling",
)  # fmt: skip
BODY = ("mass.scale", "mass.offset", "inertia.scale")
BOTH = (
    "input.gain", "input.bias", "input.delay", "input.lag", "input.rate", "supply.braking",
    "supply.sag",
)  # fmt: skip
MOTOR = ("input.deadband", "input.saturation", "input.power")
SERVO = (
    "actuator.stiffness", "actuator.damping", "servo.deadband", "servo.derivative", "servo.profile",
)  # fmt: skip
CHANNEL = ("sensor.bias", "sensor.gain", "sensor.delay", "sensor.eccentricity", "sensor.slip")
WORLD = ("gravity.tilt", "gravity.scale", "clock.skew")
STIFFEST = 10.0  # Natural frequency in Hz of a link on its elastic joint at strength 0.1.
FOREIGN = ("heated", "cogging", "binding", "slip")
FAMILIES = ("friction.coulomb", "drag.linear")
SIMPLER = {
    "friction.stribeck": "friction.coulomb", "friction.direction": "drag.linear",
    "input.power": "input.gain",
    "friction.load_direction": "friction.load", "friction.load_quadratic": "friction.load",
    "friction.position": "friction.coulomb", "friction.warming": "friction.coulomb",
    "friction.hysteresis": "friction.coulomb", "joint.flexibility": "inertia.armature",
    "joint.backlash": "inertia.armature",
}  # fmt: skip
WITH_ROTOR = ("joint.flexibility", "joint.backlash")
"""Effects whose last coefficient is a drive inertia that no file specifies."""
SIGNED = (
    "force.bias", "mass.scale", "inertia.scale", "input.gain", "input.bias", "sensor.bias",
    "sensor.gain", "clock.skew", "gravity.scale", "actuator.stiffness", "actuator.damping",
    "joint.coupling",
)  # fmt: skip
FAR = {  # Coefficients at strength 1 of effects that do not depend on the scale of the motion.
    "mass.scale": 0.5, "inertia.scale": 0.9, "input.gain": 0.4, "input.delay": 0.1,
    "input.lag": 0.2, "sensor.bias": 0.2, "sensor.gain": 0.3, "sensor.delay": 0.1,
    "clock.skew": 0.06, "gravity.scale": 0.3, "actuator.stiffness": 0.5, "actuator.damping": 0.8,
    "gravity.tilt": 0.2, "mass.offset": 0.1, "servo.derivative": 0.1,
    "friction.load": 0.5, "joint.coupling": 1.0, "supply.braking": 1.0,
}  # fmt: skip


FLOATING = (
    "friction.coulomb", "friction.stribeck", "drag.linear", "spring.linear", "force.bias",
    "inertia.armature", "mass.scale", "mass.offset", "inertia.scale", "input.gain", "input.bias",
    "input.delay", "input.lag", "sensor.gain", "sensor.delay",
)  # fmt: skip
"""Effects of robots with a floating base."""
FLOATING_ROBOTS = {
    "satellite": ("input.deadband",),
    "dropped": ("actuator.stiffness", "actuator.damping"),
    "hung": ("gravity.scale", "input.deadband"),
}
"""Further effects by robot with a floating base."""


def effects(robot):
    """Return the effects that can be hidden in a robot, such as arm2-motor."""
    kind, _, drive = robot.partition("-")
    if kind in FLOATING_ROBOTS:
        return FLOATING + FLOATING_ROBOTS[kind]
    inputs = BOTH + (MOTOR if drive == "motor" else SERVO)
    return JOINT + BODY + inputs + CHANNEL + WORLD


def places(machine, effect):
    """Return the places where an effect can act."""
    if effect == "joint.coupling":
        return [machine.joints[joint] for joint in machine.driven if machine.before(joint) >= 0]
    if effect.startswith(("friction.load", "joint.")):
        return [machine.joints[joint] for joint in machine.driven]
    if effect in JOINT:
        return list(machine.hinges)
    if effect in BODY:
        return list(dict.fromkeys(machine.bodies))
    if effect in CHANNEL:
        is_limited = effect == "sensor.eccentricity"
        return [f"q.{j}" for j in machine.hinges if not is_limited or machine.unit(j) == "rad"]
    if effect in WORLD:
        return [""]
    shared = [""] * (effect == "supply.sag" and len(machine.drives) > 1)
    return [drive.name for drive in machine.drives] + shared


def named(effect, place):
    """Return effect@place, or the effect alone if it acts on the whole system."""
    return f"{effect}@{place}" if place else effect


def shape(effect, place, setting, rng):
    """Return a function from strength to coefficients."""
    if effect in MOTION_SCALED_EFFECTS and effect not in SIGNED:
        return MOTION_SCALED_EFFECTS[effect](_at(setting, place), rng)
    sign = float(rng.choice([-1.0, 1.0])) if effect in SIGNED else 1.0
    if effect in SHAPES:
        return SHAPES[effect](place, setting, rng)
    if effect == "gravity.tilt":
        return draw_direction(FAR[effect], PlaceMotion(setting, place), rng)
    if effect in SHARED_SHAPES:
        scale = SHARED_SHAPES[effect](_at(setting, place))
        return SHAPE_SAMPLERS[effect](scale, PlaceMotion(setting, place), rng)
    far = FAR[effect] if effect in FAR else SCALES[effect](place, setting)
    return lambda s: (sign * far * float(s),)


def _at(setting, place):
    """Return the typical scales of the joint of a place, by name."""
    index = setting.machine.index(place)
    return {name: float(values[index]) for name, values in setting.typical.items()}


def _command(setting, place):
    return np.concatenate([run.commands[place] for run in setting.fitted])


def _drawn(place, setting):
    """Return a typical force of one drive, or the sum over all drives if there is no place."""
    if place:
        return _at(setting, place)["force"]
    return float(setting.typical["force"][setting.machine.driven].sum())


SCALES = {
    "force.bias": lambda place, setting: 2.0 * _at(setting, place)["force"],
    "supply.sag": lambda place, setting: 1.0 / _drawn(place, setting),
    "input.bias": lambda place, setting: float(np.ptp(_command(setting, place))) / 2,
    "servo.deadband": lambda place, setting: float(np.ptp(_command(setting, place))) / 8,
    "input.deadband": lambda place, setting: float(np.abs(_command(setting, place)).max()) / 2,
}


def _offset(place, setting, rng):
    way = rng.normal(size=3)
    way *= FAR["mass.offset"] / np.linalg.norm(way)
    return lambda s: tuple((way * s).tolist())


def _profile(place, setting, rng):
    """Return acceleration limits: a jump over the command's range takes two samples to 1 s."""
    range_, least = float(np.ptp(_command(setting, place))), 2 * setting.fitted[0].times[1]
    return lambda s: (4.0 * range_ / float(least + s) ** 2,)


def _stop(place, setting, rng):
    """Return a stop near one end of the joint's travel."""
    typical, index = _at(setting, place), setting.machine.index(place)
    path = np.concatenate([motion[:, index] for motion in setting.bare])
    side, within = float(rng.choice([-1.0, 1.0])), float(rng.uniform(0.03, 0.15))
    stands = float(np.quantile(path, 1 - within if side > 0 else within))
    stiffness = 20.0 * typical["force"] / typical["travel"]
    loss = float(rng.uniform(0.0, 0.3)) / typical["speed"]
    return lambda s: (side * stiffness * s, stands, loss)


def _rotor(rng):
    """Draw the drive inertia as a fraction of the inertia that the joint moves.

    No file specifies it; a larger value alone would be visible.
    """
    return float(rng.uniform(0.015, 0.04))


def _flexible(place, setting, rng):
    """Return a spring that becomes softer: at strength 0.1 the natural frequency is 10 Hz."""
    inertia = _at(setting, place)["inertia"]
    ratio, rotor = float(rng.uniform(0.02, 0.1)), _rotor(rng)
    return lambda s: (10.0 * s / (inertia * (2 * np.pi * STIFFEST) ** 2), ratio, rotor)


def _play(place, setting, rng):
    """Return backlash of up to a tenth of the travel."""
    rotor = _rotor(rng)
    return lambda s: (0.1 * _at(setting, place)["travel"] * s, rotor)


SHAPES = {
    "joint.flexibility": _flexible,
    "joint.backlash": _play,
    "state.limit": _stop,
    "servo.profile": _profile,
    "mass.offset": _offset,
}
"""Functions that draw the shape of an effect from its place, the setting and a generator."""


class PlaceMotion:
    """Scales of the motion at a place, from which shapes of effects on any system are drawn."""

    system = "robot"

    def __init__(self, setting, place):
        self.seconds = float(setting.fitted[0].times[-1])
        if not place:
            return
        typical = _at(setting, place)
        self.travel, self.speed = typical["travel"], typical["speed"]
        # The peak of a command, or a typical force of a joint.
        is_command = place in setting.runs[0].commands
        self.peak = (
            float(np.abs(_command(setting, place)).max()) if is_command else typical["force"]
        )


SHARED_SHAPES = {
    "friction.direction": lambda typical: 2.0 * typical["force"] / typical["speed"],
    "friction.hysteresis": lambda typical: typical["force"],
    "friction.load_direction": lambda typical: 0.5,
    "friction.load_quadratic": lambda typical: 0.5,
    "friction.position": lambda typical: typical["force"],
    "friction.warming": lambda typical: typical["force"],
    "input.power": lambda typical: 1.0,
    "input.rate": lambda typical: 1.0,
    "input.saturation": lambda typical: 1.0,
    "sensor.eccentricity": lambda typical: 0.3,
    "sensor.slip": lambda typical: 0.1,
}
"""Coefficient at strength 1, from the typical scales of the joint, of effects whose shape is drawn
as for ball, pendulum and slider.
"""


def family(effect, setting, rng):
    """Return a function from strength to coefficients of different sizes for every joint."""
    shares = {joint: float(rng.uniform(0.5, 1.5)) for joint in setting.machine.joints}
    far = {joint: shape(effect, joint, setting, rng)(1.0)[0] for joint in shares}
    return lambda s: {f"{effect}@{joint}": (shares[joint] * far[joint] * s,) for joint in shares}


def drawn(cause, joint, setting, rng):
    """Return a function from strength to keyword arguments, the hidden cause of a question.

    Args:
        cause: one of `planted_effects.FOREIGN`.
        joint: index of the joint.
        setting: setting of the recording.
        rng: random generator for the shape of the cause.
    """
    return DRAWN[cause](joint, setting, rng)


def _heated(joint, setting, rng):
    """Draw friction that the work of another joint heats, with a time constant of 0.5 to 2 s.

    At the typical power the equilibrium heat is 1.
    """
    others = [k for k in setting.machine.driven if k != joint]
    other = int(rng.choice(others)) if others else joint
    power = float(setting.typical["force"][other] * setting.typical["speed"][other])
    force, time = float(setting.typical["force"][joint]), float(rng.uniform(0.5, 2.0))
    return lambda strength: {"heated": (joint, other, 2 * force * strength, power * time, time)}


def _cogging(joint, setting, rng):
    """Draw three to eight teeth over the travel."""
    tooth = float(setting.typical["travel"][joint] / rng.uniform(3.0, 8.0))
    force = float(setting.typical["force"][joint])
    return lambda strength: {"cogging": (joint, 2 * force * strength, tooth)}


def _binding(joint, setting, rng):
    """Draw friction around a position that the joint often passes, over a part of its travel."""
    path = np.concatenate([motion[:, joint] for motion in setting.bare])
    centre = float(np.quantile(path, rng.uniform(0.3, 0.7)))
    half = float(setting.typical["travel"][joint] * rng.uniform(0.08, 0.2))
    force = float(setting.typical["force"][joint])
    return lambda strength: {"binding": (joint, 2 * force * strength, centre, half)}


def _slip(joint, setting, rng):
    """Draw one or two jumps per run: (joint, run, time, jump, run, time, jump, ...)."""
    seconds = setting.runs[0].times[-1]
    jumps = []
    for number in range(len(setting.runs)):
        for _ in range(int(rng.integers(1, 3))):
            instant = float(rng.uniform(0.15, 0.9) * seconds)
            jumps += [number, instant, float(rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.5))]

    def cause(strength):
        sized = np.array(jumps).reshape(-1, 3) * [1.0, 1.0, 0.1 * strength]
        return {"slip": (joint, *sized.ravel().tolist())}

    return cause


DRAWN = {"heated": _heated, "cogging": _cogging, "binding": _binding, "slip": _slip}


def slips_of(effects, number):
    """Return the encoder jumps of a run as tuples (joint, time, jump)."""
    if "slip" not in effects:
        return ()
    joint, *rest = effects["slip"]
    return tuple(
        (int(joint), instant, jump)
        for run, instant, jump in np.reshape(rest, (-1, 3)).tolist()
        if run == number
    )
