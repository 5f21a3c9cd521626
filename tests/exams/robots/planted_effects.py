"""Effects that can be hidden, their places and their coefficients.

Coefficients are a function of a strength; strength 1 is the largest plausible value.
"""

from __future__ import annotations

import numpy as np

from bench.diagnosis_benchmark.machine_cases.hidden_causes import MOTION_SCALED_EFFECTS

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


def _tilt(place, setting, rng):
    angle = rng.uniform(0, 2 * np.pi)
    x, y = FAR["gravity.tilt"] * float(np.cos(angle)), FAR["gravity.tilt"] * float(np.sin(angle))
    return lambda s: (x * s, y * s)


def _offset(place, setting, rng):
    way = rng.normal(size=3)
    way *= FAR["mass.offset"] / np.linalg.norm(way)
    return lambda s: tuple((way * s).tolist())


def _saturation(place, setting, rng):
    """Return limits below the peak of the command: the peak at strength 0, zero at strength 1."""
    peak = float(np.abs(_command(setting, place)).max())
    return lambda s: (peak * (1 - s),)


def _rate(place, setting, rng):
    """Return rate limits: a jump over the command's range takes 0 s to 1 s."""
    range_ = float(np.ptp(_command(setting, place)))
    return lambda s: (range_ / s,)


def _profile(place, setting, rng):
    """Return acceleration limits: a jump over the command's range takes two samples to 1 s."""
    range_, least = float(np.ptp(_command(setting, place))), 2 * setting.fitted[0].times[1]
    return lambda s: (4.0 * range_ / float(least + s) ** 2,)


def _power(place, setting, rng):
    """Return exponents above 1, normalised so that the peak of the command does not change."""
    peak = float(np.abs(_command(setting, place)).max())
    return lambda s: (peak ** (-2 * s) - 1, 2.0 * s)


def _direction(place, setting, rng):
    """Return different damping for the two directions; one is at most 0.3 times the other."""
    (far,) = shape("drag.linear", place, setting, rng)(1.0)
    shares = [1.0, float(rng.uniform(0.0, 0.3))]
    rng.shuffle(shares)
    return lambda s: (far * shares[0] * s, far * shares[1] * s)


def _uneven(place, setting, rng):
    """Return friction that varies sinusoidally by 50 to 95 % of its mean over the position.

    The period is drawn so that the travel contains one to four periods, within 0.5 to 6.28 rad.
    """
    typical, angle = _at(setting, place), rng.uniform(0, 2 * np.pi)
    period = float(np.clip(typical["travel"] / rng.uniform(1.0, 4.0), 0.5, 6.28))
    far, share = typical["force"], float(rng.uniform(0.5, 0.95))
    sine, cosine = far * share * float(np.sin(angle)), far * share * float(np.cos(angle))
    return lambda s: (far * (1 - share) * s, sine * s, cosine * s, period)


def _warming(place, setting, rng):
    """Return friction that decays with a time constant of 20 to 80 % of a run."""
    typical, lasting = _at(setting, place), float(setting.fitted[0].times[-1])
    time = max(lasting * float(rng.uniform(0.2, 0.8)), 0.5)
    viscous = float(rng.uniform(0.0, 1.0)) * typical["force"] / typical["speed"]
    return lambda s: (typical["force"] * s, viscous * s, time)


def _by_side(place, setting, rng):
    """Return load friction whose coefficients differ: one is at most 0.3 times the other."""
    shares = [1.0, float(rng.uniform(0.0, 0.3))]
    rng.shuffle(shares)
    return lambda s: (0.5 * shares[0] * s, 0.5 * shares[1] * s)


def _square(place, setting, rng):
    """Return load friction with a quadratic term 2 to 6 times the linear one at typical forces."""
    square = float(rng.uniform(2.0, 6.0)) / _at(setting, place)["force"]
    return lambda s: (0.25 * s, 0.5 * square * s)


def _eccentric(place, setting, rng):
    angle = rng.uniform(0, 2 * np.pi)
    sine, cosine = 0.3 * float(np.sin(angle)), 0.3 * float(np.cos(angle))
    return lambda s: (sine * s, cosine * s)


def _slip(place, setting, rng):
    """Return a jump at the same time in every run."""
    times = setting.runs[0].times
    instant = float(rng.uniform(0.15, 0.85) * times[-1])
    sign = float(rng.choice([-1.0, 1.0]))
    return lambda s: (sign * 0.1 * s, instant)


def _stop(place, setting, rng):
    """Return a stop near one end of the joint's travel."""
    typical, index = _at(setting, place), setting.machine.index(place)
    path = np.concatenate([motion[:, index] for motion in setting.bare])
    side, within = float(rng.choice([-1.0, 1.0])), float(rng.uniform(0.03, 0.15))
    stands = float(np.quantile(path, 1 - within if side > 0 else within))
    stiffness = 20.0 * typical["force"] / typical["travel"]
    loss = float(rng.uniform(0.0, 0.3)) / typical["speed"]
    return lambda s: (side * stiffness * s, stands, loss)


def _hysteresis(place, setting, rng):
    """Return hysteresis over 2 to 15 % of the travel, limited to 0.01 to 0.2 rad or m."""
    typical = _at(setting, place)
    way = float(np.clip(typical["travel"] * rng.uniform(0.02, 0.15), 0.01, 0.2))
    return lambda s: (typical["force"] * s, way)


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
    "friction.hysteresis": _hysteresis,
    "joint.flexibility": _flexible,
    "joint.backlash": _play,
    "state.limit": _stop,
    "sensor.slip": _slip,
    "friction.direction": _direction,
    "friction.load_direction": _by_side,
    "friction.load_quadratic": _square,
    "friction.position": _uneven,
    "friction.warming": _warming,
    "input.rate": _rate,
    "servo.profile": _profile,
    "input.power": _power,
    "sensor.eccentricity": _eccentric,
    "gravity.tilt": _tilt,
    "mass.offset": _offset,
    "input.saturation": _saturation,
}


def family(effect, setting, rng):
    """Return a function from strength to coefficients of different sizes for every joint."""
    shares = {joint: float(rng.uniform(0.5, 1.5)) for joint in setting.machine.joints}
    far = {joint: shape(effect, joint, setting, rng)(1.0)[0] for joint in shares}
    return lambda s: {f"{effect}@{joint}": (shares[joint] * far[joint] * s,) for joint in shares}
