"""Benchmark cases of robots: recordings with a hidden cause, drawn from a seed.

`draw` chooses the cause, its place and its size. Everything that is drawn follows from the name of
the case. A case is a specification and contains no data.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import lru_cache

import numpy as np

from tests.robot_exam import cause_sizing, causes_outside_library, planted_effects, reference_plant
from tests.robot_exam.cause_sizing import Gauge
from tests.robot_exam.exam_settings import setting as drawn_setting

KINDS = ("clean", "single", "family", "double", "foreign", "numerics")
APART = 1.0
"""Smallest residual without the full truth in the model, in units of the noise.

The model has only one of two causes or, for an unmodelled cause, one effect at the same joint.
"""
TELLING = 0.4
"""Smallest residual with the simpler form of an effect, in units of the noise.

Below it, the simpler form is the right answer.
"""


@dataclass(frozen=True)
class Item:
    """One benchmark case.

    Attributes:
        name: kind, robot, requested effect and seed.
        kind: one of `KINDS`.
        robot: one of `robot_models.NAMES`.
        effects: hidden coefficients by effect@place; for an unmodelled cause, its own numbers.
        family: whether all effects are one family with one coefficient per place.
        size: RMS discrepancy in the fitted runs with refitted initial states, in units of the
            noise. For two causes it is the smaller one; for backlash and joint flexibility, the
            effect of the drive inertia alone is subtracted.
        noise: white, ar1 or quantised.
        channels: names of the recorded channels.
        beyond: residual in units of the noise with the nearest tested alternatives, to first order;
            None if none were tested.
        numerics: error of MuJoCo's numerics in units of the noise.
        step, integrator: MuJoCo settings that the recording specifies.
    """

    name: str
    kind: str
    robot: str
    effects: dict[str, tuple[float, ...]]
    family: bool
    size: float
    noise: str
    channels: tuple[str, ...]
    beyond: float | None
    numerics: float
    step: float
    integrator: str

    def json(self):
        return asdict(self)

    @classmethod
    def of(cls, document):
        """Build a case from its JSON document."""
        effects = {name: tuple(c) for name, c in document["effects"].items()}
        return cls(**{**document, "effects": effects, "channels": tuple(document["channels"])})


def rng_of(name, purpose):
    return np.random.default_rng(list(f"{name} {purpose}".encode()))


@lru_cache(maxsize=4)
def setting_of(name):
    """Return the setting in which the case of this name was drawn."""
    kind, robot, *_ = name.split("/")
    return drawn_setting(robot, rng_of(name, "setting"), coarse=kind == "numerics")


@lru_cache(maxsize=2)
def gauge_of(name):
    return Gauge(setting_of(name))


def draw(kind, robot, effect, seed):
    """Draw a case, or return None if these commands and this machine cannot show the cause.

    Args:
        kind: one of `KINDS`.
        robot: one of `robot_models.NAMES`.
        effect: effect to hide (the first of two); "any" to draw it.
        seed: seed of everything else.
    """
    name = f"{kind}/{robot}/{effect}/{seed}"
    try:
        setting = setting_of(name)
    except ValueError:
        return None
    rng = rng_of(name, "cause")
    item = Item(
        name, kind, robot, {}, False, 0.0, setting.noise.kind, setting.channels, None,
        setting.numerics, setting.machine.step, setting.machine.integrator,
    )  # fmt: skip
    if kind == "numerics":
        return replace(item, size=setting.numerics)
    return item if kind == "clean" else DRAW[kind](item, setting, effect, rng)


def _wanted(rng):
    return float(np.exp(rng.uniform(np.log(3.0), np.log(10.0))))


def _drawn_effect(item, effect, rng):
    names = planted_effects.effects(item.robot.partition("-")[2])
    return str(rng.choice(names)) if effect == "any" else effect


def _sized(item, effect, setting, rng, taken=()):
    """Return ({effect@place: coefficients}, size) at a drawn place; None if it is not visible."""
    places = [p for p in planted_effects.places(setting.machine, effect) if p not in taken]
    if not places:
        return None
    wanted = _wanted(rng)
    place = str(rng.choice(places))
    of, name = (
        planted_effects.shape(effect, place, setting, rng),
        planted_effects.named(effect, place),
    )
    gauge, beyond = gauge_of(item.name), ()
    if effect in planted_effects.WITH_ROTOR:
        # The drive inertia is there even if the joint is nearly rigid, so its change is subtracted.
        beyond = gauge.change(reference_plant.stiff(setting.machine, place, of(0.0)[-1]))
    found = cause_sizing.sized(lambda s: gauge.gap({name: of(s)}, beyond), wanted)
    return found and ({name: of(found[0])}, found[1])


def _single(item, setting, effect, rng):
    effect = _drawn_effect(item, effect, rng)
    found = _sized(item, effect, setting, rng)
    if found is None:
        return None
    hidden, size = found
    beyond = None
    if effect in planted_effects.SIMPLER:
        (name, c), gauge = *hidden.items(), gauge_of(item.name)
        simpler = planted_effects.SIMPLER[effect] + "@" + name.partition("@")[2]
        tried = [gauge.change({simpler: (share * (c[0] + abs(c[1])),)}) for share in (0.3, 0.6)]
        beyond = cause_sizing.left(_joined(gauge.change(hidden)), [_joined(t) for t in tried])
        if beyond < TELLING:
            return None
    return replace(item, effects=hidden, size=size, beyond=beyond)


def _joined(change):
    return np.concatenate(change)


def _family(item, setting, effect, rng):
    effect = str(rng.choice(planted_effects.FAMILIES)) if effect == "any" else effect
    of = planted_effects.family(effect, setting, rng)
    found = cause_sizing.sized(lambda s: gauge_of(item.name).gap(of(s)), _wanted(rng))
    return found and replace(item, effects=of(found[0]), family=True, size=found[1])


def _double(item, setting, effect, rng):
    """Draw two causes at different places; one cause alone must not explain both."""
    first = _sized(item, _drawn_effect(item, effect, rng), setting, rng)
    if first is None:
        return None
    name = next(iter(first[0]))
    taken = (name.partition("@")[2],)
    pool = [
        e
        for e in planted_effects.effects(item.robot.partition("-")[2])
        if e != name.partition("@")[0]
    ]
    second_effect = str(rng.choice(pool))
    if not [p for p in planted_effects.places(setting.machine, second_effect) if p not in taken]:
        return None
    second = _sized(item, second_effect, setting, rng, taken)
    if second is None:
        return None
    gauge, both = gauge_of(item.name), first[0] | second[0]
    if not np.isfinite(gauge.gap(both)):
        return None
    whole = _joined(gauge.change(both))
    alone = [_joined(gauge.change(part[0])) for part in (first, second)]
    beyond = min(cause_sizing.left(whole, [part]) for part in alone)
    size = min(first[1], second[1])
    return replace(item, effects=both, size=size, beyond=beyond) if beyond >= APART else None


def _foreign(item, setting, effect, rng):
    """Draw an unmodelled cause that no effect at the same joint explains completely."""
    cause = str(rng.choice(planted_effects.FOREIGN)) if effect == "any" else effect
    joint = int(rng.choice(setting.machine.driven))
    of, gauge = causes_outside_library.drawn(cause, joint, setting, rng), gauge_of(item.name)
    found = cause_sizing.sized(lambda s: gauge.gap(of(s)), _wanted(rng))
    if found is None:
        return None
    hidden = of(found[0])
    change = _joined(gauge.change(hidden))
    beyond = min(cause_sizing.left(change, [other]) for other in _near(setting, joint, gauge, rng))
    shown = replace(item, effects=hidden, size=found[1], beyond=beyond)
    return shown if beyond >= APART else None


def _near(setting, joint, gauge, rng):
    """Yield the changes (N,) that effects at one joint cause."""
    machine = setting.machine
    at = {machine.joints[joint], machine.bodies[joint], f"q.{machine.joints[joint]}"}
    at |= {d.name for d in machine.drives if d.joint == machine.joints[joint]} | {""}
    drive = "servo" if machine.drives[0].kp else "motor"
    for effect in planted_effects.effects(drive):
        for place in at & set(planted_effects.places(machine, effect)):
            c = planted_effects.shape(effect, place, setting, rng)(0.05)
            yield _joined(gauge.change({planted_effects.named(effect, place): c}))


DRAW = {"single": _single, "family": _family, "double": _double, "foreign": _foreign}
