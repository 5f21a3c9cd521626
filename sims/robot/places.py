"""Effects at the places of a robot: each registered effect becomes a class for every joint,
actuator, body or channel where it can act, named ``effect@place``, and one for all of them
together, the family ``effect@*``.

An effect knows nothing of robots. At a joint it sees that joint alone, as a system of one
coordinate; at an actuator or a channel it gets that signal. A family is the sum of its members.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from sims.base import Array
from sims.robot.moment import RobotMoment
from sims.robot.spots import Spot
from sims.system import (
    FAMILY,
    Acting,
    Coefficient,
    Effect,
    Force,
    Friction,
    Hidden,
    Input,
    Kind,
    Moment,
    Sensor,
    State,
    Value,
)

SHARED = frozenset({"input.delay", "input.hold", "input.lag", "sensor.delay", "sensor.lag"})
"""Families of one coefficient for all places: what is late is late everywhere."""
ALONE = frozenset(
    {
        "force.periodic",
        "force.ripple",
        "input.power",
        "joint.backlash",
        "joint.coupling",
        "joint.flexibility",
        "friction.direction",
        "friction.hysteresis",
        "friction.load_direction",
        "friction.load_quadratic",
        "friction.position",
        "friction.stribeck",
        "friction.warming",
        "sensor.eccentricity",
        "sensor.slip",
        "state.limit",
    }
)
"""Effects without a family: what shapes them differs from place to place."""
COMMON = frozenset({"supply.sag"})
"""Effects at actuators that they may have in common, as a battery: the world's, by one number."""
ENCODERS = frozenset({"sensor.slip"})
"""Effects on what counts a position, and on no other channel."""
TYPICAL = {"hinge": 0.5, "slide": 5.0}
"""A force for which the plausible ranges of the library are meant: N m on a hinge, N on a slide."""
SHAPES = 6
"""Sizes tried of what shapes an effect with a state: each is followed through time."""
SLOWEST = 15.0
"""rad/s; what is carried swings no slower on a joint that gives."""
_KINDS: Mapping[str, Kind] = {"hinge": "rotary", "slide": "linear"}


def at_world(effect: type[Effect]) -> type[Effect]:
    """The effect as one of the world's, with the units that it has on any kind of system."""
    coefficients = [_everywhere(c) for c in effect.coefficients]
    return _made(effect, effect.name, "", coefficients, {})


def at_place(effect: type[Effect], spot: Spot) -> type[Effect]:
    """The effect at one place."""
    coefficients = [_of_spot(effect, c, spot) for c in effect.coefficients]
    changed: dict[str, Any] = {"coordinate": spot.coordinate, "signal": spot.signal}
    changed["says"] = f"{effect.says} (at {spot.words})"
    if issubclass(effect, Force):
        changed["force"] = _force_of(effect)
    elif issubclass(effect, Friction):
        changed["limit"] = _limit_of(effect)
    elif issubclass(effect, Hidden):
        changed["act"] = _act_of(effect)
        declared = effect.between or effect.coefficients
        coefficients = [_tried(_of_spot(effect, c, spot)) for c in declared if not _has(spot, c)]
        own = [f"{other}@{spot.name}" for other in effect.contains]
        # What the drive weighs, where it gives nothing.
        drive = f"inertia.armature@{spot.name}"
        for number, c in enumerate(coefficients):
            if c.of == "rotor":
                own.append(drive)
                changed["taking"] = _taking(drive, spot.inertia, number, c.plausible[0])
        changed["contains"] = tuple(own)
    return _made(effect, f"{effect.name}@{spot.name}", spot.name, coefficients, changed)


def _force_of(effect: type[Force]) -> Callable[[Force, Array, Moment], Array]:
    def force(self: Force, c: Array, moment: Moment) -> Array:
        """(L, D) along its joint."""
        joint = cast(int, self.coordinate)
        alone = cast(RobotMoment, moment).of_joint(joint)
        result = np.zeros_like(moment.x)
        result[:, joint] = effect.force(self, c, alone)[:, 0]
        return result

    return force


def at_all(effect: type[Effect], drives: Sequence[Spot]) -> Iterator[type[Effect]]:
    """The effect as all drives have it in common, where they are of one kind."""
    joints = {one.coordinate: one for one in drives}
    kinds = {one.kind for one in drives}
    if len(joints) < 2 or len(kinds) > 1 or not issubclass(effect, Force):
        return
    whole = drives[0]._replace(size=sum(one.size for one in joints.values()))
    coefficients = [_of_spot(effect, c, whole) for c in effect.coefficients]
    changed: dict[str, Any] = {
        "at": "world",
        "says": f"{effect.says} (of one supply that all drives share)",
        "force": _force_of_all(effect, [cast(int, joint) for joint in joints]),
    }
    yield _made(effect, effect.name, "", coefficients, changed)


def _force_of_all(effect: type[Force], joints: Sequence[int]) -> Callable[..., Array]:
    def force(self: Force, c: Array, moment: Moment) -> Array:
        """(L, D) along the joints, each with what all draw."""
        robot = cast(RobotMoment, moment)
        drawn = sum(np.abs(robot.carried[0][:, joint : joint + 1]) for joint in joints)
        result = np.zeros_like(moment.x)
        for joint in joints:
            alone = replace(robot.of_joint(joint), shared=drawn)
            result[:, joint] = effect.force(self, c, alone)[:, 0]
        return result

    return force


def _limit_of(effect: type[Friction]) -> Callable[[Friction, Array, Moment], Array]:
    def limit(self: Friction, c: Array, moment: Moment) -> Array:
        """(L, 1) of its joint."""
        alone = cast(RobotMoment, moment).of_joint(cast(int, self.coordinate))
        return effect.limit(self, c, alone)

    return limit


def _has(spot: Spot, c: Coefficient) -> bool:
    """Whether the file states what a coefficient is of."""
    stated = spot.stated.get("inertia.armature", 0.0)
    return c.of == "rotor" and stated > c.plausible[0][0] * spot.inertia


def _taking(
    drive: str, inertia: float, number: int, bounds: tuple[float, float]
) -> Callable[[Effect, Array, str, Array], Array]:
    def taking(_: Effect, c: Array, simpler: str, given: Array) -> Array:
        """With the drive's inertia as that of the rotor, a share of the joint's."""
        if simpler != drive:
            return c
        made: Array = c.copy()
        made[number] = np.clip(given[0] / inertia, *bounds)
        return made

    return taking


def _tried(c: Coefficient) -> Coefficient:
    """With a few sizes from which a search begins, where it shapes an effect with a state."""
    low, high = c.plausible[0]
    if c.tried or low <= 0:
        return c
    return replace(c, tried=tuple(np.geomspace(low, high, SHAPES).tolist()))


def _act_of(effect: type[Hidden]) -> Callable[..., tuple[Array, Array]]:
    def act(self: Hidden, c: Array, moment: Moment, state: State) -> tuple[Array, Array]:
        """(L, D) along its joint, and the rate of its state."""
        joint = cast(int, self.coordinate)
        alone = cast(RobotMoment, moment).of_joint(joint)
        result = np.zeros_like(moment.x)
        force, rate = effect.act(self, c, alone, state)
        result[:, joint] = force[:, 0]
        return result, rate

    return act


def family(effect: type[Effect], members: Sequence[type[Effect]]) -> type[Effect]:
    """The effect at all of its places at once, a coefficient for each, or one for all."""
    shared = effect.name in SHARED
    first = members[0].coefficients
    coefficients: list[Coefficient] = list(first) if shared else []
    if not shared:
        for member in members:
            for c in member.coefficients:
                coefficients.append(replace(c, name=f"{c.name}@{member.place}"))
    count = len(first)
    instances = tuple(member() for member in members)

    def parts(_: Effect, c: Array) -> Acting:
        """Each member with its own part of the coefficients."""
        if shared:
            return tuple((one, c) for one in instances)
        return tuple((one, c[i * count : (i + 1) * count]) for i, one in enumerate(instances))

    contains = {member.name for member in members}
    for member in members:
        contains.update(member.contains)
    contains.update(f"{name}@{FAMILY}" for name in effect.contains)
    changed = {
        "parts": parts,
        "members": instances,
        "places": tuple(member.place for member in members),
        "contains": tuple(sorted(contains)),
        "says": f"{effect.says} (at every place of its kind)",
    }
    return _made(effect, f"{effect.name}@{FAMILY}", FAMILY, coefficients, changed)


def _made(
    effect: type[Effect],
    name: str,
    place: str,
    coefficients: Sequence[Coefficient],
    changed: Mapping[str, Any],
) -> type[Effect]:
    contains = tuple(f"{other}@{place}" for other in effect.contains) if place else ()
    body = {
        "name": name,
        "of": effect.name,
        "place": place,
        "coefficients": tuple(coefficients),
        "contains": contains,
        "needs": "",
        "__module__": __name__,
        "__doc__": effect.__doc__,
        **changed,
    }
    return type(f"{effect.__name__}At", (effect,), body)


def _everywhere(c: Coefficient) -> Coefficient:
    """With one unit and range for every kind of system: the first that it has."""
    i = next(k for k, unit in enumerate(c.units) if unit is not None)
    return replace(c, units=(c.units[i],) * 3, plausible=(c.plausible[i],) * 3)


def _of_spot(effect: type[Effect], c: Coefficient, spot: Spot) -> Coefficient:
    """A coefficient with the unit and the plausible range that it has at a place."""
    i = 2 if spot.kind == "hinge" else 1
    unit, (low, high) = c.units[i], c.plausible[i]
    least = c.least
    if c.of.startswith(("input", "error")):
        unit = c.of.replace("error", "input").replace("input", spot.unit)
    elif c.of.startswith("reading"):
        unit = c.of.replace("reading", spot.unit)
    # What the library calls plausible is meant for small joints: a force here may be larger.
    if unit is None:
        unit = "1"
    share = spot.size / TYPICAL[spot.kind]
    if unit.startswith("N"):
        low, high = share * low, share * high
    elif unit.startswith(("1/N", "1/(N")):
        low, high = low / share, high / share
    if effect.name == "inertia.armature":
        high = 3.0 * spot.inertia
    if c.of == "give":
        high = 1.0 / (spot.inertia * SLOWEST**2)
    most = c.most
    stated = spot.stated.get(effect.name) if effect.at == "joint" else None
    if stated is not None:
        # The total is not negative: the difference may take away what the file states, and no more.
        high = max(high, 2.0 * abs(stated))
        low = least = min(0.0 - stated, 0.0)
    if effect.name == "mass.offset":
        least, most = spot.offsets[c.name]
        if least < most:
            low, high = max(low, least), min(high, most)
    return replace(c, units=(unit,) * 3, plausible=((low, high),) * 3, least=least, most=most)


def classes(
    effect: type[Effect],
    found: Mapping[str, Sequence[Spot]],
    native: Collection[str],
    compiles: Callable[[type[Effect]], bool] = lambda _: True,
) -> Iterator[type[Effect]]:
    """An effect at all places of a robot where it can act, then its family.

    Args:
        effect: registered.
        found: the robot's places.
        native: effects that the engine writes into the model.
        compiles: whether the model compiles that an effect at one place needs.
    """
    if effect.at == "world":
        if effect.name in native or (issubclass(effect, Sensor) and not effect.filters):
            yield at_world(effect)
        return
    if effect.name not in native and not _for_one(effect):
        return
    members = [at_place(effect, s) for s in found[effect.at] if _acts_at(effect, s, found)]
    members = [member for member in members if compiles(member)]
    yield from members
    # Encoders are of one make; what else is recorded has units of its own.
    alike = [m for m in members if effect.at != "channel" or m.place.startswith("q.")]
    if len(alike) > 1 and effect.name not in ALONE:
        yield family(effect, alike)
    if len(alike) > 1 and effect.name in COMMON:
        yield from at_all(effect, found["actuator"])


def _for_one(effect: type[Effect]) -> bool:
    """Whether it can act at one of several places without the engine's help."""
    if issubclass(effect, Input | Sensor):
        return True
    # A force that asks for more than its own joint has no meaning at one of several.
    alone = effect.needs in ("", "guide", "input", "servo")
    if issubclass(effect, Hidden):
        # What has a part of the joint's inertia needs to say what it is between.
        return bool(effect.between) or effect.behind is Hidden.behind
    return alone and issubclass(effect, Force | Friction)


def _acts_at(effect: type[Effect], spot: Spot, found: Mapping[str, Sequence[Spot]]) -> bool:
    """Whether a place has what the effect changes."""
    if effect.at == "joint" and effect.coefficients[0].unit(_KINDS[spot.kind]) is None:
        return False
    if effect.at == "joint" and effect.needs == "input":
        return any(actuator.coordinate == spot.coordinate for actuator in found["actuator"])
    if issubclass(effect, Hidden) and effect.between:
        # Between what drives a joint and what it carries.
        return spot.last and any(one.coordinate == spot.coordinate for one in found["actuator"])
    if effect.needs == "servo" and not spot.servo:
        return False
    if effect.name == "joint.coupling" and not spot.coupled:
        return False
    # A set point has no power.
    if effect.name == "input.power" and not spot.unit.startswith(("N", "1")):
        return False
    if effect.name in ENCODERS and not spot.name.startswith("q."):
        return False
    # What is an angle to an encoder is none to what else is recorded.
    if effect.at == "channel" and not effect.coefficients[0].of:
        unit = effect.coefficients[0].unit(_KINDS[spot.kind])
        if unit is None or (unit == "rad" and spot.unit != "rad"):
            return False
    if issubclass(effect, Value) and effect.at == "actuator":
        return spot.stated.get(effect.name, 1.0) != 0.0
    return True
