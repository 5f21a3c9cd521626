"""Effect classes for each place of a robot, and effect families over all places.

Each registered effect becomes a class for every joint, actuator, body or channel where it can act,
named ``effect@place``, and one class for all of them together, the family ``effect@*``.

An effect does not depend on robots. At a joint it receives that joint alone, as a system of one
coordinate; at an actuator or a channel it receives that signal. A family is the sum of its members.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from sims.core.effect import (
    ALL_PLACES,
    ActiveEffects,
    Coefficient,
    Effect,
    Force,
    Friction,
    HiddenState,
    HiddenStateEffect,
    Input,
    ModelValueEffect,
    Sensor,
)
from sims.core.simulator import Array
from sims.core.system import SYSTEM_KINDS, StateSnapshot, SystemKind
from sims.robot.places.place_list import EffectPlace
from sims.robot.state_snapshots import RobotSnapshot

SHARED_COEFFICIENT_EFFECTS = frozenset(
    {"input.delay", "input.hold", "input.lag", "sensor.delay", "sensor.lag"}
)
"""Families with one coefficient for all places, such as delays."""
EFFECTS_WITHOUT_FAMILY = frozenset(
    {
        "contact.damping",
        "contact.friction",
        "contact.softness",
        "force.periodic",
        "force.ripple",
        "geom.radius",
        "input.power",
        "joint.axis",
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
        "payload",
        "sensor.eccentricity",
        "sensor.slip",
        "state.limit",
    }
)
"""Effects without a family, since their shape parameters differ between places."""
EFFECTS_WITH_TOTAL = frozenset({"contact.friction", "gravity.compensation"})
"""Effects, in addition to those at joints, whose coefficient is a difference from the file."""
SHARED_ACTUATOR_EFFECTS = frozenset({"supply.sag"})
"""Effects at actuators that the actuators may share, such as a battery; one number of the world."""
BASE_EFFECTS = frozenset({"drag.linear", "drag.quadratic", "force.bias"})
"""Effects at the coordinates of a floating body: it has no bearing and no drive."""
POSITION_SENSOR_EFFECTS = frozenset({"sensor.slip"})
"""Effects of position encoders, which act on no other channel."""
REFERENCE_FORCES = {"hinge": 0.5, "slide": 5.0, "contact": 1.0, "geom": 1.0}
"""Reference force for the plausible ranges of the effect library.

N m on a hinge, N on a slide; no coefficient of a contact or geom is a force.
"""
HIDDEN_STATE_SHAPE_COUNT = 6
"""Number of values tried for a shape parameter of a hidden-state effect.

It is small since each value requires an integration over time.
"""
MAX_PAYLOAD_SHARE = 0.5
"""Largest plausible payload, as a share of the mass of all moving bodies."""
MIN_LOAD_FREQUENCY = 15.0
"""Minimum natural frequency of the load on a flexible joint, in rad/s."""
_KINDS: Mapping[str, SystemKind] = {
    "hinge": "rotary",
    "slide": "linear",
    "contact": "point",
    "geom": "point",
}


def make_world_effect(effect: type[Effect]) -> type[Effect]:
    """Make an effect of the world, with the units that it has on any kind of system."""
    coefficients = [_unify_units(c) for c in effect.coefficients]
    return _create_placed_effect(effect, effect.name, "", coefficients, {})


def make_placed_effect(effect: type[Effect], effect_place: EffectPlace) -> type[Effect]:
    """Make the class of a registered effect at one joint, actuator, body or channel of a robot.

    A registered effect is written for a system of one coordinate. The class passes it the
    coordinate or the signal of its place only, and has the units and plausible ranges that apply
    there. Forces, dry friction and hidden states get a method for this (`force`, `limit`, `act`);
    the engine treats all other effects.

    Args:
        effect: registered effect.
        effect_place: place, with what the model file states there.
    """
    # Coefficients. Those of a joint's axis are tilts about x, y and z, of which only some can be
    # observed.
    tilts = effect_place.tilts if effect.name == "joint.axis" else None
    observable_coefficients = [c for c in effect.coefficients if tilts is None or c.name in tilts]
    coefficients = [_adapt_to_place(effect, c, effect_place) for c in observable_coefficients]
    # Attributes and methods that differ from those of the registered effect.
    changed: dict[str, Any] = {"coordinate": effect_place.coordinate, "signal": effect_place.signal}
    changed["says"] = f"{effect.says_at_place or effect.says} (at {effect_place.words})"
    # At a contact, the pairs of geoms whose contacts get parameters of their own.
    changed["pairs"] = effect_place.pairs
    if issubclass(effect, Force):
        changed["force"] = _make_force_method(effect)
    elif issubclass(effect, Friction):
        changed["limit"] = _make_limit_method(effect)
    elif issubclass(effect, HiddenStateEffect):
        changed["act"] = _make_act_method(effect)
        # Coefficients, without those whose quantity the model file states. An effect between a
        # drive and its load has other coefficients (`between`) where both sides are known, as here.
        declared_coefficients = effect.between or effect.coefficients
        coefficients = [
            _add_search_starts(_adapt_to_place(effect, c, effect_place))
            for c in declared_coefficients
            if not _is_rotor_inertia_stated(effect_place, c)
        ]
        # Simpler effects that it contains: those that are declared; and with a rotor, the armature
        # effect, which is a rigid transmission with the drive's inertia.
        contained_names = [
            f"{contained_effect}@{effect_place.name}" for contained_effect in effect.contains
        ]
        armature_effect = f"inertia.armature@{effect_place.name}"
        for number, c in enumerate(coefficients):
            if c.of == "rotor":  # the rotor's share of the joint's inertia
                contained_names.append(armature_effect)
                changed["taking"] = _make_taking_method(
                    armature_effect, effect_place.inertia, number, c.plausible[0]
                )
        changed["contains"] = tuple(contained_names)
    return _create_placed_effect(
        effect, f"{effect.name}@{effect_place.name}", effect_place.name, coefficients, changed
    )


def _make_force_method(effect: type[Force]) -> Callable[[Force, Array, StateSnapshot], Array]:
    """Make the `force` method of an effect at one joint from that of the registered effect.

    The registered effect is written for a system with one coordinate. The new method passes it
    the state of its joint alone, and writes the result into that joint's column.

    Args:
        effect: registered effect with a force.
    """

    def force(self: Force, c: Array, moment: StateSnapshot) -> Array:
        """Compute the forces (L, D), which are zero at all joints but that of the effect.

        There are L batch elements and D joints. The registered effect (`effect`) computes the
        force of one joint.

        Args:
            self: the effect at its place.
            c: (K, L, 1) the K coefficients.
            moment: snapshot of the robot.
        """
        joint = cast(int, self.coordinate)
        joint_snapshot = cast(RobotSnapshot, moment).get_joint_snapshot(joint)
        result = np.zeros_like(moment.x)
        result[:, joint] = effect.force(self, c, joint_snapshot)[:, 0]
        return result

    return force


def make_shared_effects(
    effect: type[Effect], drives: Sequence[EffectPlace]
) -> Iterator[type[Effect]]:
    """Yield the class of an effect that all drives share, such as a sagging common supply.

    Drives with a common supply lose force together when any of them needs much. Exactly one class
    is yielded if the effect is a force, at least two joints are driven, and all drives are of one
    kind (angles or lengths); otherwise none.

    Args:
        effect: registered effect.
        drives: places of the actuators.
    """
    # Drives on tendons and sites have no coordinate.
    drives = [drive for drive in drives if drive.coordinate is not None]
    joints = {drive.coordinate: drive for drive in drives}
    kinds = {drive.kind for drive in drives}
    if len(joints) < 2 or len(kinds) > 1 or not issubclass(effect, Force):
        return
    # Its coefficients have the units of a drive, and the sum of the typical forces. The drives are
    # of one kind, so that the first one stands for all.
    combined_place = drives[0]._replace(size=sum(drive.size for drive in joints.values()))
    coefficients = [_adapt_to_place(effect, c, combined_place) for c in effect.coefficients]
    changed: dict[str, Any] = {
        "at": "world",
        "says": f"{effect.says} (of the common supply of all drives)",
        "force": _make_shared_force_method(effect, [cast(int, joint) for joint in joints]),
    }
    yield _create_placed_effect(effect, effect.name, "", coefficients, changed)


def _make_shared_force_method(effect: type[Force], joints: Sequence[int]) -> Callable[..., Array]:
    """Make the `force` method of an effect that all drives share, such as a supply that sags.

    The method evaluates the registered effect at each driven joint. There the effect depends on the
    load of the supply, the sum of all drives' absolute forces.

    Args:
        effect: registered effect, written for a system of one coordinate.
        joints: coordinates of the driven joints.
    """

    def force(self: Force, c: Array, moment: StateSnapshot) -> Array:
        """Compute the forces (L, D) along all driven joints from the total load of the supply.

        There are L batch elements and D joints, of which `joints` are driven. The registered effect
        (`effect`) computes the force of one joint.

        Args:
            self: the effect at its place.
            c: (K, L, 1) the K coefficients.
            moment: snapshot of the robot.
        """
        robot = cast(RobotSnapshot, moment)
        # Forces (L, D) of the drives, the first of both loads of the transmissions.
        drive_forces, _ = robot.carried
        total_load = sum(np.abs(drive_forces[:, joint : joint + 1]) for joint in joints)  # (L, 1)
        forces = np.zeros_like(moment.x)
        for joint in joints:
            joint_snapshot = replace(robot.get_joint_snapshot(joint), shared=total_load)
            forces[:, joint] = effect.force(self, c, joint_snapshot)[:, 0]
        return forces

    return force


def _make_limit_method(effect: type[Friction]) -> Callable[[Friction, Array, StateSnapshot], Array]:
    """Make the `limit` method of a dry friction at one joint from that of the registered effect.

    The registered effect is written for a system with one coordinate. The new method passes it the
    state of its joint alone; `limit` is the largest friction force.

    Args:
        effect: registered effect with dry friction.
    """

    def limit(self: Friction, c: Array, moment: StateSnapshot) -> Array:
        """Compute the friction limit (L, 1) of the effect's joint, in L batch elements.

        The registered effect (`effect`) computes it from the state of this joint alone.

        Args:
            self: the effect at its place.
            c: (K, L, 1) the K coefficients.
            moment: snapshot of the robot.
        """
        joint_snapshot = cast(RobotSnapshot, moment).get_joint_snapshot(cast(int, self.coordinate))
        return effect.limit(self, c, joint_snapshot)

    return limit


def _is_rotor_inertia_stated(effect_place: EffectPlace, c: Coefficient) -> bool:
    """Return whether the model file states the inertia of the rotor that a coefficient stands for.

    The coefficient, the rotor's share of the joint inertia, is not needed then. Other coefficients
    are always needed.

    Args:
        effect_place: place of the effect, with the values of the model file.
        c: coefficient of the effect.
    """
    file_armature = effect_place.stated.get("inertia.armature", 0.0)
    # An armature below the smallest plausible rotor does not count as stated.
    (smallest_share, _), *_ = c.plausible
    return c.of == "rotor" and file_armature > smallest_share * effect_place.inertia


def _make_taking_method(
    armature_effect: str, inertia: float, number: int, bounds: tuple[float, float]
) -> Callable[[Effect, Array, str, Array], Array]:
    """Make the `taking` method, which starts a flexible joint at the values of a fitted armature.

    A flexible joint may replace an armature effect, an added inertia of the rotor. The fitted
    armature is then the inertia of the rotor of the flexible joint, from which its coefficient, the
    rotor's share of the joint inertia, follows.

    Args:
        armature_effect: name of the armature effect, with its place.
        inertia: inertia of the joint in kg m² or kg.
        number: index of the rotor's share among the coefficients of the flexible joint.
        bounds: lowest and highest value of the share.
    """

    def taking(_: Effect, c: Array, simpler: str, armature: Array) -> Array:
        """Return coefficients c that include the effect `simpler`, if it is the armature effect."""
        if simpler != armature_effect:
            return c
        coefficients: Array = c.copy()
        coefficients[number] = np.clip(armature[0] / inertia, *bounds)
        return coefficients

    return taking


def _add_search_starts(c: Coefficient) -> Coefficient:
    """Add start values of a search to a shape parameter of a hidden-state effect."""
    low, high = c.plausible[0]
    if c.tried or low <= 0:
        return c
    return replace(c, tried=tuple(np.geomspace(low, high, HIDDEN_STATE_SHAPE_COUNT).tolist()))


def _make_act_method(effect: type[HiddenStateEffect]) -> Callable[..., tuple[Array, Array]]:
    """Make the `act` method of an effect with a hidden state at one joint.

    The registered effect is written for a system with one coordinate. The new method passes it
    the state of its joint alone, and writes the force into that joint's column.

    Args:
        effect: registered effect with a hidden state.
    """

    def act(
        self: HiddenStateEffect, c: Array, moment: StateSnapshot, state: HiddenState
    ) -> tuple[Array, Array]:
        """Compute the forces (L, D), zero at other joints, and the rate of the hidden state.

        There are L batch elements and D joints. The registered effect (`effect`) computes the
        force (L, 1) of one joint, and the rate (L, 1).

        Args:
            self: the effect at its place.
            c: (K, L, 1) the K coefficients.
            moment: snapshot of the robot.
            state: hidden state of the effect, (L, 1).
        """
        joint = cast(int, self.coordinate)
        joint_snapshot = cast(RobotSnapshot, moment).get_joint_snapshot(joint)
        forces = np.zeros_like(moment.x)
        force, rate = effect.act(self, c, joint_snapshot, state)
        forces[:, joint] = force[:, 0]
        return forces, rate

    return act


def make_effect_family(effect: type[Effect], members: Sequence[type[Effect]]) -> type[Effect]:
    """Make the family of an effect: a class that acts at all its places at once.

    Its coefficients are those of all members, named ``coefficient@place``. The members of
    `SHARED_COEFFICIENT_EFFECTS`, such as a delay, have the same coefficients instead. The method
    `parts` divides the family into its members. Searches test a family before its single places.

    Args:
        effect: registered effect.
        members: classes of the effect at each place, which is not empty.
    """
    # 1. Coefficients. All members have the same number of them.
    is_shared = effect.name in SHARED_COEFFICIENT_EFFECTS
    first_coefficients = members[0].coefficients
    coefficients: list[Coefficient] = list(first_coefficients) if is_shared else []
    if not is_shared:
        for member in members:
            for coefficient in member.coefficients:
                coefficients.append(replace(coefficient, name=f"{coefficient.name}@{member.place}"))
    count = len(first_coefficients)
    instances = tuple(member() for member in members)

    def parts(_: Effect, c: Array) -> ActiveEffects:
        """Return the effect at each place, with its rows of the coefficients c (K, L, 1)."""
        if is_shared:
            return tuple((member_effect, c) for member_effect in instances)
        return tuple(
            (member_effect, c[i * count : (i + 1) * count])
            for i, member_effect in enumerate(instances)
        )

    # 2. Simpler effects that it contains: its members, theirs, and families of simpler effects.
    contains = {member.name for member in members}
    for member in members:
        contains.update(member.contains)
    contains.update(f"{name}@{ALL_PLACES}" for name in effect.contains)
    changed = {
        "parts": parts,
        "members": instances,
        "places": tuple(member.place for member in members),
        "contains": tuple(sorted(contains)),
        "says": f"{effect.says} (at every place of its kind)",
    }
    return _create_placed_effect(
        effect, f"{effect.name}@{ALL_PLACES}", ALL_PLACES, coefficients, changed
    )


def _create_placed_effect(
    effect: type[Effect],
    name: str,
    place: str,
    coefficients: Sequence[Coefficient],
    changed: Mapping[str, Any],
) -> type[Effect]:
    """Create a subclass of a registered effect that acts at one place of a robot, or at all places.

    The simpler effects that it contains are those of the registered effect at the same place.

    Args:
        effect: registered effect.
        name: name of the new class, such as ``drag.linear@elbow``.
        place: name of the place; empty for an effect of the world.
        coefficients: coefficients with units and ranges for this place.
        changed: attributes and methods that differ from those of `effect`, by name.
    """
    contains = (
        tuple(f"{contained_effect}@{place}" for contained_effect in effect.contains)
        if place
        else ()
    )
    attributes = {
        "name": name,
        "of": effect.name,
        "place": place,
        "coefficients": tuple(coefficients),
        "contains": contains,
        # A place at which the effect can act has all that it needs.
        "needs": "",
        "__module__": __name__,
        "__doc__": effect.__doc__,
        **changed,
    }
    return type(f"{effect.__name__}At", (effect,), attributes)


def _unify_units(c: Coefficient) -> Coefficient:
    """Give a coefficient one unit and range for all kinds of systems: the first that it has."""
    kinds = zip(c.units, c.plausible, strict=True)
    unit, plausible = next((unit, bounds) for unit, bounds in kinds if unit is not None)
    return replace(c, units=(unit,) * 3, plausible=(plausible,) * 3)


def _adapt_to_place(effect: type[Effect], c: Coefficient, effect_place: EffectPlace) -> Coefficient:
    """Return a coefficient with the unit, plausible range and limits that apply at a place.

    1. Find the unit of the place, such as N·m at a hinge.
    2. Scale ranges of forces with the typical force of the joint, since the ranges of the library
       refer to small joints.
    3. If the model file states a value, the coefficient is a difference from it: limit it so that
       the total is not negative.
    4. Apply the limits of the place, such as those of a link's size.

    Args:
        effect: class of the effect.
        c: coefficient as declared in the library.
        effect_place: place, with the values that the model file states there.
    """
    # 1. Unit. A coefficient has one unit and one range for each kind of system (rotary, linear or
    # point), of which the place is one. If `of` names the input, the error of a servo or the
    # reading, such as ``input/s``, the unit is made from that of the place.
    system_kind = SYSTEM_KINDS.index(_KINDS[effect_place.kind])
    unit, (low, high) = c.units[system_kind], c.plausible[system_kind]
    lower_limit = c.least
    if c.of.startswith(("input", "error")):
        unit = c.of.replace("error", "input").replace("input", effect_place.unit)
    elif c.of.startswith("reading"):
        unit = c.of.replace("reading", effect_place.unit)
    # 2. Scale. Forces are proportional to the typical force, and inverse forces to its inverse.
    if unit is None:
        unit = "1"
    force_ratio = effect_place.size / REFERENCE_FORCES[effect_place.kind]
    if unit.startswith("N"):
        low, high = force_ratio * low, force_ratio * high
    elif unit.startswith(("1/N", "1/(N")):
        low, high = low / force_ratio, high / force_ratio
    if effect.name == "inertia.armature":
        # A gear multiplies the inertia of a rotor, which may exceed that of the links.
        high = 3.0 * effect_place.inertia
    if effect.name == "drag.linear":
        # A joint may have as much damping as its servo, which acts alike.
        high = max(high, effect_place.servo_damping)
    if c.of == "give":
        # A compliance, at most that with which the load swings at the lowest frequency.
        high = 1.0 / (effect_place.inertia * MIN_LOAD_FREQUENCY**2)
    # 3. Total.
    upper_limit = c.most
    has_total = effect.at == "joint" or effect.name in EFFECTS_WITH_TOTAL
    file_value = effect_place.stated.get(effect.name) if has_total else None
    if file_value is not None:
        # The difference can at most remove the value of the file.
        high = max(high, 2.0 * abs(file_value))
        low = lower_limit = min(0.0 - file_value, 0.0)
    # 4. Limits of the place.
    if effect.name == "payload" and c.name == "mass":
        high = MAX_PAYLOAD_SHARE * effect_place.mass
    if c.name in effect_place.limits.get(effect.name, {}):
        lower_limit, highest = effect_place.limits[effect.name][c.name]
        upper_limit = highest if np.isfinite(highest) else None
        # The limits of a payload's offset lie outside the link, and its plausible range within it.
        # Along an axis in which no offset can be observed, both ends are zero.
        if effect.name == "payload":
            begin, end = effect_place.limits["mass.offset"][c.name]
            low, high = (begin, end) if begin < end else (low, high)
        elif lower_limit < highest:
            low, high = max(low, lower_limit), min(high, highest)
    # The place has one kind, so the unit and the range are repeated for all three.
    return replace(
        c, units=(unit,) * 3, plausible=((low, high),) * 3, least=lower_limit, most=upper_limit
    )


def make_effect_classes(
    effect: type[Effect],
    places: Mapping[str, Sequence[EffectPlace]],
    native: Collection[str],
    compiles: Callable[[type[Effect]], bool] = lambda _: True,
) -> Iterator[type[Effect]]:
    """Yield the classes of an effect at all places of a robot, followed by its family, if any.

    A family is one effect at all places together. Nothing is yielded if the robot cannot have the
    effect.

    Args:
        effect: registered effect.
        places: places of the robot by kind.
        native: names of effects that the engine writes into fields of MuJoCo's model.
        compiles: returns whether the model with an effect at one place compiles.
    """
    # Effects of the world have no places.
    if effect.at == "world":
        if effect.name in native or (issubclass(effect, Sensor) and not effect.filters):
            yield make_world_effect(effect)
        return
    if effect.name not in native and not _needs_no_engine_support(effect):
        return
    members = [
        make_placed_effect(effect, place)
        for place in places[effect.at]
        if _acts_at(effect, place, places)
    ]
    members = [member for member in members if compiles(member)]
    yield from members
    # Of the channels, only positions form a family; others have units of their own.
    family_members = [m for m in members if effect.at != "channel" or m.place.startswith("q.")]
    if len(family_members) > 1 and effect.name not in EFFECTS_WITHOUT_FAMILY:
        yield make_effect_family(effect, family_members)
    if len(family_members) > 1 and effect.name in SHARED_ACTUATOR_EFFECTS:
        yield from make_shared_effects(effect, places["actuator"])


def _needs_no_engine_support(effect: type[Effect]) -> bool:
    """Return whether an effect can be evaluated outside MuJoCo, at one of several places.

    This is so for effects on inputs and sensors; for forces and dry friction that need no more than
    their own joint; and for effects with a hidden state, unless they connect the drive of a joint
    to its load without declaring it.

    Args:
        effect: registered effect that the engine does not write into the model.
    """
    if issubclass(effect, Input | Sensor):
        return True
    if issubclass(effect, HiddenStateEffect):
        # With coefficients `between`, it is declared as an element between drive and load. An
        # effect that moves a part of the joint's inertia itself overrides `behind`.
        return bool(effect.between) or effect.behind is HiddenStateEffect.behind
    # A force that needs more than its own joint is undefined at one of several joints. A guide, an
    # input and a servo belong to a joint.
    needs_own_joint_only = effect.needs in ("", "guide", "input", "servo")
    return needs_own_joint_only and issubclass(effect, Force | Friction)


def _acts_at(
    effect: type[Effect], effect_place: EffectPlace, places: Mapping[str, Sequence[EffectPlace]]
) -> bool:
    """Return whether a place has the quantity that an effect changes.

    For example, a servo effect needs a position servo, and an effect of a drive needs a joint with
    an actuator.

    Args:
        effect: registered effect.
        effect_place: place of the kind at which the effect acts.
        places: all places of the robot by kind.
    """
    first_coefficient = effect.coefficients[0]
    is_driven = any(
        actuator.coordinate == effect_place.coordinate for actuator in places["actuator"]
    )
    # Joints. The effect may not exist along a length, or along an angle: its unit is None there.
    if effect.at == "joint" and first_coefficient.unit(_KINDS[effect_place.kind]) is None:
        return False
    if effect.at == "joint" and effect_place.is_base and effect.name not in BASE_EFFECTS:
        return False
    if effect.at == "joint" and effect.needs == "input":
        return is_driven
    if issubclass(effect, HiddenStateEffect) and effect.between:
        # The effect connects the drive of a joint to its load, so both must exist. The second joint
        # that it adds is the last one of the body.
        return effect_place.last and is_driven
    if effect.needs == "servo" and not effect_place.servo:
        return False
    # The drive of such a joint also drives the preceding joint.
    if effect.name == "joint.coupling" and not effect_place.coupled:
        return False
    # Actuators.
    if effect.at == "actuator":
        # A relative change of a number of the file, such as a gain, needs one that is not zero.
        # Numbers that are not stated here, such as a force limit, can always be changed.
        if issubclass(effect, ModelValueEffect):
            return effect_place.stated.get(effect.name, 1.0) != 0.0
        # A power effect is undefined for a set point.
        if effect.name == "input.power" and not effect_place.unit.startswith(("N", "1")):
            return False
        # On a tendon or a site, only the command is defined.
        return effect_place.coordinate is not None or issubclass(effect, Input)
    # Geometry: a link without length, and an axis whose tilt does not show.
    if effect.name == "link.length" and not effect_place.stated["link.length"]:
        return False
    if effect.name == "joint.axis" and not effect_place.tilts:
        return False
    # Channels.
    if effect.name in POSITION_SENSOR_EFFECTS and not effect_place.name.startswith("q."):
        return False
    # Angular coefficients apply to encoders, and not to other channels.
    if effect.at == "channel" and not first_coefficient.of:
        unit = first_coefficient.unit(_KINDS[effect_place.kind])
        if unit is None or (unit == "rad" and effect_place.unit != "rad"):
            return False
    return True
