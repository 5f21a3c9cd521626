"""The system of a robot: its coordinates, inputs and channels, and the effects at its places."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from sims import effects as library
from sims.core.effect import ALL_PLACES, Effect
from sims.core.registry import PartUnavailableError
from sims.core.simulator import Channel, InputError, Parameter, make_unknown_name_error
from sims.core.system import System, SystemKind
from sims.robot.contact_pairs import PAIR_SEPARATOR
from sims.robot.dynamics.activation_filters import activation_filters
from sims.robot.dynamics.added_elements import find_compile_error, list_added_elements
from sims.robot.floating_joints import FloatingJoints, list_state_units
from sims.robot.loop_closure import (
    close_loops,
    coupled_joints,
    list_following_joints,
    list_joints_placed_by_loops,
    list_unmeasured_joints,
    settle_loops,
)
from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS
from sims.robot.places import placed_effect_classes
from sims.robot.places.default_excitation import LazyDefaultRecording
from sims.robot.places.place_list import (
    MUJOCO_EFFECT_WORDS,
    EffectPlace,
    list_places,
    make_contact_place,
    make_geom_place,
)
from sims.robot.robot_model import RobotModel
from sims.robot.state_snapshots import SingleJointSystem, SingleSlideSystem

INTEGRATOR_ACTUATOR_REASON = (
    "the actuator integrates its control (dyntype integrator), and the initial value of its "
    "integral "
    "is not recorded; expected a position servo, whose input is the integral"
)
"""Reason why a recording cannot contain the control of an integrator actuator."""


class RobotSystem(System):
    """The system of a robot's simulator, created from its model file.

    Attributes:
        robot: the robot.
        places: its places by kind.
        alone: (D,) each joint as a separate system.
        drives: inputs of the actuators of each coordinate.
        servos: input that is the set point of the position servo, by coordinate.
        gears: gear of that servo, by coordinate: its set point per unit of the coordinate.
        activations: names under which a recording may specify initial activations of filters.
        refused_inputs: reason why a recording cannot contain an input, by input.
        joint_loops: names of the joints of each closed loop; of floating joints only those whose
            pose follows from the loop.
        traced: compiled effects by inputs (`sims.robot.dynamics.effect_force_program`).
    """

    name = "robot"
    says = "a robot of a model file"
    kind: ClassVar[SystemKind] = "rotary"
    has_model = True
    usual_recording = LazyDefaultRecording()
    robot: ClassVar[RobotModel]
    places: ClassVar[Mapping[str, Sequence[EffectPlace]]]
    alone: ClassVar[tuple[System, ...]]
    drives: ClassVar[Mapping[int, tuple[str, ...]]]
    servos: ClassVar[Mapping[int, str]]
    gears: ClassVar[Mapping[int, float]]
    activations: ClassVar[tuple[str, ...]]
    refused_inputs: ClassVar[Mapping[str, str]]
    joint_loops: ClassVar[tuple[frozenset[str], ...]] = ()
    freed_parameters: ClassVar[frozenset[str]] = frozenset()
    freed_effects: ClassVar[tuple[type[Effect], ...]] = ()
    traced: ClassVar[dict[tuple[str, ...], Any]]
    _placed: ClassVar[dict[str, tuple[type[Effect], ...]]]

    def __init_subclass__(cls) -> None:
        """Give the system of each robot caches of its own."""
        super().__init_subclass__()
        # These caches must not be shared with other robots, or with the same robot with free
        # parameters.
        cls.traced, cls._placed, cls.left_out = {}, {}, {}

    @classmethod
    def gear(cls, coordinate: int) -> float:
        """Return the gear of a coordinate's position servo, see `System`."""
        return cls.gears.get(coordinate, 1.0)

    @classmethod
    def close_loops(
        cls, states: Mapping[str, float], measured: Collection[str]
    ) -> dict[str, float]:
        """Return states in which the closed loops of the robot are closed, see `System`.

        A closed loop is a chain of links whose ends the model connects. Joints in loops that are
        not measured are placed where the loops put them, also rods with ball joints. Those that the
        measured ones move then settle: MuJoCo's loops give way a little under load.

        Args:
            states: initial states by name.
            measured: names of the measured positions, such as ``q.crank``.

        Returns:
            All given states, changed where joints are placed.
        """
        unmeasured = [
            name
            for loop in cls.joint_loops
            for name in list_unmeasured_joints(cls.robot, loop, measured)
        ]
        closed = close_loops(cls.robot, states, unmeasured)
        following = list_following_joints(cls.robot, cls.joint_loops, measured)
        return settle_loops(cls.robot, closed, following)

    @classmethod
    def placed(cls, effect: type[Effect]) -> Sequence[type[Effect]]:
        """Return the classes of an effect at each of its places, and of its family, if any.

        A family is one effect at all of its places. Left out are places where the effect's
        coefficient is a free parameter of the simulator. A payload is also left out on a body whose
        mass is free, since the log cannot tell the two masses apart.

        Args:
            effect: registered effect, such as dry friction.
        """
        # The classes at all places are made once.
        if effect.name not in cls._placed:
            cls._placed[effect.name] = tuple(
                placed_effect_classes.make_effect_classes(
                    effect, cls.places, MODEL_FIELD_EFFECTS, cls._compiles_with
                )
            )
        placed_effects = [
            placed_effect
            for placed_effect in cls._placed[effect.name]
            if not cls.is_free(placed_effect)
        ]
        if effect.name == "payload":
            return [
                placed_effect
                for placed_effect in placed_effects
                if f"mass.scale@{placed_effect.place}" not in cls.freed_parameters
            ]
        return placed_effects

    @classmethod
    def _compiles_with(cls, effect: type[Effect]) -> bool:
        """Return whether the model compiles with the elements that an effect at one place adds.

        An effect may add an element, such as a second joint. If the model does not compile with it,
        MuJoCo's reason is stored in `left_out` for messages.

        Args:
            effect: class of the effect at its place.
        """
        added = list_added_elements(effect)
        # Most effects add no elements, and a pair of existing geoms always compiles.
        if not added or effect.pairs:
            return True
        error = find_compile_error(cls.robot, added)
        if error:
            cls.left_out[effect.name] = f"MuJoCo does not compile the model with it: {error}"
        return not error

    @classmethod
    def is_free(cls, effect: type[Effect]) -> bool:
        """Return whether a coefficient of an effect is a parameter; then it cannot be a cause."""
        names = {effect.name, *(member.name for member in getattr(effect, "members", ()))}
        return not cls.freed_parameters.isdisjoint(names)

    @classmethod
    def effect(cls, name: str) -> type[Effect] | None:
        """Find the effect with a name such as ``friction.coulomb@elbow``.

        The place after ``@`` may be

        * left out for an effect without places,
        * a joint, actuator, body or channel, or a link that was fused into a body,
        * `ALL_PLACES` for the family, the effect at all places,
        * any contact of two geoms, or any geom with a radius, also without a recorded contact.

        Args:
            name: Name of the effect, with its place after ``@``.

        Returns:
            Class of the effect at its place; a robot never returns None, which `System` allows.

        Raises:
            InputError: there is no such effect, or it has no such place; the message lists the
                existing ones.
        """
        effect_name, _, place = name.partition("@")
        registered = library.get_effect(effect_name)
        cls.placed(registered)  # fills `left_out` and `_placed`
        if name in cls.left_out:
            raise InputError(f"effect {name} of robot {cls.name}: {cls.left_out[name]}")
        effects_by_name = {
            placed_effect.name: placed_effect for placed_effect in cls._placed[effect_name]
        }
        if name in effects_by_name:
            return effects_by_name[name]
        if registered.at == "contact" and PAIR_SEPARATOR in place:
            # The contacts of a recording have effects already, but any contact may be named.
            effect_place = make_contact_place(cls.robot, place, (place,))
            return placed_effect_classes.make_placed_effect(registered, effect_place)
        if registered.at == "geom" and place not in ("", ALL_PLACES):
            effect_place = make_geom_place(cls.robot, place)
            return placed_effect_classes.make_placed_effect(registered, effect_place)
        if not effects_by_name:
            raise InputError(f"robot {cls.name} cannot have effect {effect_name}")
        if not place:
            raise InputError(
                f"effect {effect_name} of robot {cls.name} needs a place; there are: "
                + ", ".join(sorted(effects_by_name))
            )
        if registered.at == "body" and place in (cls.robot.aliases or {}):
            # A link that is fused into a body: the effect acts on the whole body.
            return cls.effect(f"{effect_name}@{cls.robot.body(place).name}")
        place_names = [
            placed_effect.place for placed_effect in effects_by_name.values() if placed_effect.place
        ]
        if place == ALL_PLACES and len(place_names) == 1:
            # If there is one place only, the family is this place.
            return effects_by_name[f"{effect_name}@{place_names[0]}"]
        raise make_unknown_name_error(
            f"place of effect {effect_name} in robot {cls.name}", place, place_names or ["none"]
        )

    @classmethod
    def find_freeable_effects(cls, word: str) -> list[type[Effect]]:
        """Return the effects whose coefficients an entry of ``--free`` refers to.

        Such an entry names a number of the model file that is to be tuned. For all places, the
        result is one effect for each place, except for effects with one number that all places
        share.

        Args:
            word: name in MuJoCo's words such as ``damping@elbow``, or effect such as
                ``drag.linear@elbow``; ``@*`` is every place.

        Raises:
            InputError: there is no such number, or it has no such place.
        """
        base, _, place = word.partition("@")
        # Name of the effect that changes the number; `base` may be this name already.
        name = MUJOCO_EFFECT_WORDS.get(base, base)
        if name not in library.list_names():
            known_words = [
                *cls.list_mujoco_words(),
                *(
                    effect_name
                    for effect_name in library.list_names()
                    if cls._can_have_effect(effect_name)
                ),
            ]
            raise make_unknown_name_error(f"number of robot {cls.name}", base, known_words)
        placed_effect = cls.effect(f"{name}@{place}" if place else name)
        assert placed_effect is not None  # an unknown place raises an error instead
        # Shared effects, such as delays, have one number for all places, and are not divided.
        if name in placed_effect_classes.SHARED_COEFFICIENT_EFFECTS:
            return [placed_effect]
        # Only a family, the effect at all places, has members.
        members = getattr(placed_effect, "members", ())
        return [type(member) for member in members] or [placed_effect]

    @classmethod
    def list_mujoco_words(cls) -> list[str]:
        """List MuJoCo's words for numbers that the model file specifies."""
        return [word for word, name in MUJOCO_EFFECT_WORDS.items() if cls._can_have_effect(name)]

    @classmethod
    def _can_have_effect(cls, name: str) -> bool:
        """Return whether the robot can have a registered effect at any place."""
        try:
            return bool(cls.placed(library.get_effect(name)))
        except PartUnavailableError:
            return False


def make_robot_system(robot: RobotModel, free: Sequence[str] = ()) -> type[RobotSystem]:
    """Make the system of a robot, a class that depends on the model file.

    It tells tuners and effects what the robot has: coordinates, inputs, channels and initial
    states, by the names of its joints and actuators. The attributes are those of `System` and
    `RobotSystem`.

    Args:
        robot: robot as read from its model file.
        free: numbers to tune, such as ``damping@*`` or ``mass.scale@forearm``.

    Raises:
        InputError: the robot has no joint with one coordinate, or a name in `free` does not exist.
    """
    # 1. Joints, channels, inputs and initial states. The coordinates are those of the joints with
    # one coordinate; free and ball joints only have initial states.
    joints = [joint for joint in robot.joints if joint.has_one_coordinate]
    if not joints:
        floating_joint = robot.joints[0].name
        raise InputError(
            f"{robot.path}: expected a hinge or slide joint, found none that moves; if the pose of "
            "the body is recorded, state it as channels "
            f"q.{floating_joint}.x, y, z, qw, qx, qy, qz"
        )
    channels = _list_channels(robot)
    inputs = [Channel(f"u.{a.name}", a.control_unit) for a in robot.actuators]
    inputs += [Channel(f"force.{j.name}", j.force_unit) for j in joints]
    model = robot.compiled
    states = {f"q.{j.name}": float(model.qpos0[j.position]) for j in joints}
    states |= {f"qd.{j.name}": 0.0 for j in joints}
    floating = FloatingJoints.from_robot(robot)
    states |= floating.states()
    floating_state_units = floating.units()
    # 2. Closed loops. The pose of some floating joints follows from the loop, so a recording need
    # not state it.
    placed_joints = list_joints_placed_by_loops(robot)
    loop_joints = [*joints, *placed_joints]
    placed_states = {
        name for joint in placed_joints for units in list_state_units(joint) for name in units
    }
    # 3. Actuators of each joint. With several servos at one joint, its motion would not show which
    # one has an error.
    actuators_by_coordinate = {
        coordinate: [a for a in robot.actuators if a.joint == joint.name]
        for coordinate, joint in enumerate(joints)
    }
    servo_by_coordinate = {
        coordinate: servos[0]
        for coordinate, actuators in actuators_by_coordinate.items()
        if len(servos := [a for a in actuators if a.kind == "position"]) == 1
    }
    # 4. Class with these attributes.
    attributes: dict[str, Any] = {
        "name": robot.name,
        "says": f"the robot of {robot.path.name}",
        "parameters": (),
        "constants": (),
        "inputs": tuple(inputs),
        "channels": channels,
        "coordinates": tuple(f"q.{j.name}" for j in joints),
        "rates": tuple(f"qd.{j.name}" for j in joints),
        "states": MappingProxyType(states),
        "sensed": tuple(c.name for c in channels),
        "robot": robot,
        "floating_state_units": MappingProxyType(floating_state_units),
        "required_state_units": MappingProxyType(
            {n: unit for n, unit in floating_state_units.items() if n not in placed_states}
        ),
        # Names of the joints of each closed loop, also of floating ones that the loop places.
        "joint_loops": tuple(
            frozenset(loop_joints[k].name for k in group)
            for group in coupled_joints(model, [j.velocity for j in loop_joints])
        ),
        "base_orientations": MappingProxyType(dict(robot.base_orientations)),
        # Indices of the coordinates of each closed loop.
        "loops": tuple(map(frozenset, coupled_joints(model, [j.velocity for j in joints]))),
        "places": list_places(robot, [(c.name, c.unit) for c in channels]),
        "alone": tuple(
            SingleJointSystem() if j.kind == "hinge" else SingleSlideSystem() for j in joints
        ),
        "drives": {
            coordinate: tuple(f"u.{a.name}" for a in actuators)
            for coordinate, actuators in actuators_by_coordinate.items()
        },
        "servos": {c: f"u.{servo.name}" for c, servo in servo_by_coordinate.items()},
        "gears": {
            c: float(model.actuator_gear[servo.id, 0]) for c, servo in servo_by_coordinate.items()
        },
        "activations": tuple(
            activation_filter.state for activation_filter in activation_filters(robot)
        ),
        "refused_inputs": MappingProxyType(
            {
                f"u.{a.name}": INTEGRATOR_ACTUATOR_REASON
                for a in robot.actuators
                if robot.integrates(a)
            }
        ),
    }
    system: type[RobotSystem] = type("RobotSystemOfFile", (RobotSystem,), attributes)
    if not free:
        return system
    # The names in `free` are resolved by the system without free parameters. The class is then made
    # again, so that its caches of effects are empty.
    effects = list_freed_effects(system, free)
    attributes["freed_parameters"] = frozenset(effect.name for effect in effects)
    attributes["parameters"] = tuple(p for effect in effects for p in _make_parameters(effect))
    attributes["freed_effects"] = tuple(effects)
    return type("RobotSystemOfFile", (RobotSystem,), attributes)


def list_freed_effects(system: type[RobotSystem], free: Sequence[str]) -> list[type[Effect]]:
    """Return the effects that the names of ``--free`` refer to, without duplicates.

    Args:
        system: system of the robot.
        free: names such as ``damping@*``.

    Returns:
        Effects at one place each, or shared by all places.
    """
    by_name = {
        effect.name: effect for word in free for effect in system.find_freeable_effects(word)
    }
    return list(by_name.values())


FREED_RANGE_FACTOR = 4.0
"""Bounds of a free parameter, as a multiple of its plausible range."""
FREED_GAIN_RANGE_FACTOR = 9.0
"""Upper bound of a free servo gain's relative change, as a multiple of the specified gain."""


def _make_parameters(effect: type[Effect]) -> list[Parameter]:
    """Make parameters of the simulator from an effect's coefficients.

    A coefficient is a change of a number of the model file. Its nominal value zero keeps the file's
    number, and its bounds are a multiple of the plausible range.

    Args:
        effect: effect at one place whose coefficients the user frees.
    """
    parameters = []
    for coefficient in effect.coefficients:
        # Units and ranges are equal for all kinds of systems, since the effect is at one place.
        low, high = coefficient.plausible[0]
        # The gain of a servo is often a guess, so the true value may be several times as large. Its
        # relative change has a lowest value; other coefficients of actuators have none.
        is_free_gain = effect.at == "actuator" and coefficient.least is not None
        bounds = (
            FREED_RANGE_FACTOR * low,
            FREED_GAIN_RANGE_FACTOR if is_free_gain else FREED_RANGE_FACTOR * high,
        )
        # Bounds stay within the limits of the coefficient. Equal limits mean that it cannot be
        # observed; it keeps the wider bounds, and the data will not identify it.
        if coefficient.least is not None and coefficient.least != coefficient.most:
            upper_limit = np.inf if coefficient.most is None else coefficient.most
            bounds = max(bounds[0], coefficient.least), min(bounds[1], upper_limit)
        name = effect.name if len(effect.coefficients) == 1 else f"{effect.name}.{coefficient.name}"
        unit = coefficient.units[0] or "1"
        parameters.append(Parameter(name, unit, 0.0, bounds, (low, high), says=effect.says))
    return parameters


def _list_channels(robot: RobotModel) -> tuple[Channel, ...]:
    """Return position, velocity and drive force channels of each joint, and the model's sensors.

    Args:
        robot: robot whose joints and sensors are observed.

    Returns:
        Channels named ``q.JOINT``, ``qd.JOINT``, ``tau.JOINT`` and ``s.SENSOR``, in this order.
    """
    joints = [joint for joint in robot.joints if joint.has_one_coordinate]
    channels = [Channel(f"q.{j.name}", j.unit, says=f"position of joint {j.name}") for j in joints]
    channels += [
        Channel(f"qd.{j.name}", f"{j.unit}/s", says=f"velocity of joint {j.name}") for j in joints
    ]
    channels += [
        Channel(f"tau.{j.name}", j.force_unit, says=f"actuator force at joint {j.name}")
        for j in joints
    ]
    channels += [Channel(f"s.{s.name}", s.unit, says=f"sensor {s.name}") for s in robot.sensors]
    return tuple(channels)
