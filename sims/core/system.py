"""Interfaces of systems, effects and engines.

A *system* is declared once (`System`): names, units, and its generalised forces as array functions.
An *engine* integrates it (`Engine`), many batch elements at once. An *effect* (`Effect`) adds one
contribution through one hook. They are independent of each other's implementation and communicate
through `StateSnapshot`, the state at which forces are evaluated, and `IntegrationBatch`, the work
for an engine.

Shapes: L batch elements (each a parameter vector in a run), D coordinates, S steps, K coefficients.
Numbers per batch element are (L, 1), so that they can be multiplied with generalised vectors
(L, D). With the mass M, the drive U and the passive force P that it works against (gravity alone in
most systems: `passive`),

    M x'' = U(x, v, u) - P(x, v) + forces of effects                       (1)

minus dry friction, whose limits are added over all effects and which opposes the motion as one
force.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import takewhile
from types import MappingProxyType
from typing import Any, ClassVar, Literal, Protocol

import numpy as np

from sims.core.simulator import Array, Channel, Constant, Parameter

SystemKind = Literal["point", "linear", "rotary"]
"""Unit of a system's forces: `point` per unit mass (m/s^2), `linear` in N, `rotary` in N*m."""
SYSTEM_KINDS: tuple[SystemKind, ...] = ("point", "linear", "rotary")
"""All kinds, in the order of a coefficient's units and ranges."""
PlaceKind = Literal["joint", "actuator", "body", "channel", "world", "level"]
"""Kinds of places where an effect acts; `level` exists only in user-defined simulators."""
ALL_PLACES = "*"
"""Place of an effect that acts at all places of its kind."""
STANDARD_GRAVITY = 9.80665
"""Standard gravity in m/s^2 (3rd General Conference on Weights and Measures, 1901)."""


@dataclass
class StateSnapshot:
    """State of all batch elements at one time, for the evaluation of effects.

    Attributes:
        system: System to which the state belongs.
        theta: (L, p) parameters of the system itself.
        constants: Known numbers of each batch element, (L, 1) by name.
        t: (L, 1) time since the start of the run, s.
        x: (L, D) generalised position.
        v: (L, D) generalised velocity.
        inputs: Inputs applied to the plant, (L, 1) by name.
    """

    system: System
    theta: Array
    constants: Mapping[str, Array]
    t: Array
    x: Array
    v: Array
    inputs: Mapping[str, Array] = field(default_factory=dict)

    @property
    def speed(self) -> Array:
        """Magnitude of the velocity (L, 1)."""
        # Exact in one dimension, where the root of a square would be rounded and could underflow.
        if self.v.shape[1] == 1:
            return np.abs(self.v)
        speed: Array = np.sqrt((self.v * self.v).sum(axis=1, keepdims=True))
        return speed

    @property
    def gravity(self) -> Array:
        """Gravitational acceleration (L, 1), m/s^2; standard gravity if the system states none."""
        return self.constants.get("gravity", np.full((len(self.x), 1), STANDARD_GRAVITY))

    @property
    def weight(self) -> Array:
        """Generalised force (L, D) of gravity."""
        return self.system.weight(self)

    def push(self, axis: Literal["x", "y"]) -> Array:
        """Return the generalised force (L, D) of a horizontal 1 m/s^2 acceleration along `axis`."""
        return self.system.push(self, axis)

    @property
    def load(self) -> Array:
        """Load (L, 1) of the transmission: magnitude of drive force plus passive force."""
        carried = self.system.drive(self) + self.system.passive(self)
        load: Array = np.abs(carried).sum(axis=1, keepdims=True)
        return load

    @property
    def sides(self) -> tuple[Array, Array]:
        """Drive force and passive force of the primary coordinate, each (L, 1).

        With equal signs, they press on the transmission from both sides.
        """
        place = slice(self.system.primary, self.system.primary + 1)
        return self.system.drive(self)[:, place], self.system.passive(self)[:, place]

    @property
    def drawn(self) -> Array:
        """Sum of the force magnitudes (L, 1) of all drives that share a power supply."""
        drawn: Array = np.abs(self.sides[0])
        return drawn

    @property
    def error(self) -> Array:
        """Error of the servo (L, 1): set point minus position."""
        error: Array = self.inputs[self.system.servo] - self.primary
        return error

    def aimed(self, shift: Array) -> Array:
        """Return the change of the drive's force (L, D) if the servo's set point is shifted.

        Args:
            shift: (L, 1) shift of the set point.
        """
        name = self.system.servo
        moved = replace(self, inputs={**self.inputs, name: self.inputs[name] + shift})
        more: Array = self.system.drive(moved) - self.system.drive(self)
        return more

    @property
    def inertia(self) -> Array:
        """Generalised inertia (L, 1)."""
        return self.system.mass(self.theta, self.constants)

    @property
    def primary(self) -> Array:
        """Position (L, 1) of the primary coordinate, on which biases, springs and ripples act."""
        return self.x[:, self.system.primary, None]

    @property
    def primary_rate(self) -> Array:
        """Velocity (L, 1) of the primary coordinate."""
        return self.v[:, self.system.primary, None]

    def along_primary(self, force: Array) -> Array:
        """Return the generalised force (L, D) with `force` (L, 1) along the primary coordinate."""
        result = np.zeros_like(self.x)
        result[:, self.system.primary] = force[:, 0]
        return result


@dataclass(frozen=True)
class DefaultRecording:
    """Default content of a simulated recording of a system.

    Attributes:
        observe: Channels to record; all of the system if empty.
        initial: Range by state, SI units, from which the initial state of each run is drawn; other
            states begin at their default.
        inputs: Text of a signal by input (`core.input_signals`), such as ``steps:2:0.5``; other
            inputs are zero.
    """

    observe: tuple[str, ...] = ()
    initial: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # One declaration is shared by all recordings of the process, so it must be read-only.
        object.__setattr__(self, "initial", MappingProxyType(dict(self.initial)))
        object.__setattr__(self, "inputs", MappingProxyType(dict(self.inputs)))


@dataclass(frozen=True)
class DerivedQuantity:
    """Quantity of interest that is computed from a system's parameters and constants.

    Attributes:
        name: Name of the quantity.
        unit: Unit of the quantity.
        says: Description in a few words.
        of: Function of parameters and constants by name that computes it.
        strongest: Whether it is the maximum force of the drive at rest.
    """

    name: str
    unit: str
    says: str
    of: Callable[[Mapping[str, float]], float]
    strongest: bool = False


@dataclass(frozen=True)
class RenderedModelFile:
    """System in the form of a robot's model file.

    Attributes:
        text: Content in MJCF.
        joint: Name of the joint.
        actuator: Name of the actuator that drives the joint.
        signals: Channels and inputs of the robot, by those of the system.
        said: Properties that the file cannot express, one clause each.
    """

    text: str
    joint: str
    actuator: str
    signals: Mapping[str, str]
    said: tuple[str, ...] = ()


class System(ABC):
    """Physical system, declared once for all engines.

    Attributes:
        kind: Unit of its forces.
        parameters: Tunable parameters.
        constants: Known numbers with their defaults.
        inputs: Input signals; effects on the input act on the first.
        channels: Signals that its sensors can measure; effects on a sensor's value act on the first
            observed one of `sensed`.
        coordinates: Names of the states that are the generalised position, in order.
        rates: Names of the states that are the generalised velocity, in order.
        states: Default values of both.
        bounces: Whether its last coordinate strikes the ground at `floor`.
        afloat: Units by name of the poses and velocities of floating bodies, which are states but
            no coordinates: they are known at the beginning of a run, but not at the beginning of a
            part of a run.
        sensed: Channels on which sensor effects may act, in order of preference.
        primary: Index of the coordinate on which biases and springs act.
        servo: Input that is the set point of the servo of the primary coordinate; empty if there is
            none.
        uniform: Whether its own force is constant in space and time, so that it moves on parabolas.
        bends: Whether its own force may change sharply, so that steps must be shortened there.
        fastest: Maximum angular frequency in rad/s of oscillations that are not visible in its
            forces; steps are divided for it, too.
        guided: Number of coordinates, from the first one, on which dry friction acts; 0 for all.
        has_model: Whether it comes from a model file, whose numbers may be wrong.
        levels: States that are stored quantities, such as a tank's level, which may overflow.
        usual_recording: Default content of its simulated recordings.
        derived: Quantities computed from others, for a data sheet.
        left_out: Effects that it would have but cannot simulate, with the reason, by name. It is
            filled when all effects are requested (`sims.effects.list_effects_for`).
    """

    name: ClassVar[str]
    says: ClassVar[str]
    kind: ClassVar[SystemKind]
    parameters: ClassVar[tuple[Parameter, ...]]
    constants: ClassVar[tuple[Constant, ...]] = ()
    inputs: ClassVar[tuple[Channel, ...]] = ()
    channels: ClassVar[tuple[Channel, ...]]
    coordinates: ClassVar[tuple[str, ...]]
    rates: ClassVar[tuple[str, ...]]
    states: ClassVar[Mapping[str, float]]
    sensed: ClassVar[tuple[str, ...]]
    primary: ClassVar[int] = 0
    servo: ClassVar[str] = ""
    bounces: ClassVar[bool] = False
    afloat: ClassVar[Mapping[str, str]] = {}
    uniform: ClassVar[bool] = False
    guided: ClassVar[int] = 0
    bends: ClassVar[bool] = False
    fastest: ClassVar[float] = 0.0
    has_model: ClassVar[bool] = False
    levels: ClassVar[tuple[str, ...]] = ()
    usual_recording: ClassVar[DefaultRecording] = DefaultRecording()
    derived: ClassVar[tuple[DerivedQuantity, ...]] = ()
    left_out: ClassVar[dict[str, str]] = {}

    @classmethod
    def reading(cls, observed: Sequence[str]) -> str:
        """Return the channel among those `observed` on whose value sensor effects act."""
        return next((name for name in cls.sensed if name in observed), observed[0])

    @classmethod
    def model_file(cls, numbers: Mapping[str, float]) -> RenderedModelFile | None:  # noqa: ARG003
        """Return the system as a robot's model file; None if that is not possible.

        Args:
            numbers: Parameters and constants by name.
        """
        return None

    @classmethod
    def gear(cls, coordinate: int) -> float:  # noqa: ARG003
        """Return the gear ratio: the servo's travel per unit of a coordinate."""
        return 1.0

    @classmethod
    def placed(cls, effect: type[Effect]) -> Sequence[type[Effect]]:
        """Return the forms of a registered effect that this system can have; empty if none.

        This is the effect itself in a system with one place, and a class for each place and family
        in a robot.
        """
        return (effect,) if effect.fits(cls) else ()

    @classmethod
    def effect(cls, name: str) -> type[Effect] | None:  # noqa: ARG003
        """Return the effect with a name that only this system defines, such as those of its places.

        The result is None for registered effects.
        """
        return None

    @classmethod
    def refuses(cls, effect: type[Effect]) -> str:  # noqa: ARG003
        """Return why the system cannot have an effect although it has all that the effect `needs`.

        The result is empty if it can.
        """
        return ""

    @abstractmethod
    def mass(self, theta: Array, constants: Mapping[str, Array]) -> Array:
        """Return the generalised inertia (L, 1); 1 for a system that counts force per unit mass.

        Args:
            theta: (L, p) parameters.
            constants: Constants (L, 1) by name.
        """

    @abstractmethod
    def weight(self, moment: StateSnapshot) -> Array:
        """Return the generalised force (L, D) of gravity."""

    def drive(self, moment: StateSnapshot) -> Array:
        """Return the generalised force (L, D) of the inputs, applied by the actuator."""
        return np.zeros_like(moment.x)

    def passive(self, moment: StateSnapshot) -> Array:
        """Return minus all generalised forces (L, D) of the system except the drive.

        This is the force that the drive works against.
        """
        return -self.weight(moment)

    def force(self, moment: StateSnapshot) -> Array:
        """Return the generalised force (L, D) of the system itself, without effects."""
        return self.drive(moment) - self.passive(moment)  # (1)

    def push(self, moment: StateSnapshot, axis: Literal["x", "y"]) -> Array:
        """Return the generalised force (L, D) of a horizontal acceleration of 1 m/s^2.

        Args:
            moment: State of all batch elements.
            axis: Direction of the acceleration.
        """
        raise NotImplementedError

    @abstractmethod
    def observe(
        self, x: Array, v: Array, a: Array, constants: Mapping[str, Array]
    ) -> dict[str, Array]:
        """Return the channels (L, S) by name.

        Args:
            x: (L, S, D) positions.
            v: (L, S, D) velocities.
            a: (L, S, D) accelerations.
            constants: Constants (L, 1) by name.
        """

    def floor(self, constants: Mapping[str, Array]) -> Array:
        """Return the value (L, 1) of the last coordinate at which it strikes the ground."""
        raise NotImplementedError

    def restitution(self, theta: Array) -> Array:
        """Return the restitution (L, 1) of an impact."""
        raise NotImplementedError

    def friction(self, constants: Mapping[str, Array]) -> Array | None:  # noqa: ARG002
        """Return the friction coefficient (L, 1) of the ground without effects; None for none."""
        return None

    def grip(self, constants: Mapping[str, Array]) -> Array | None:  # noqa: ARG002
        """Return the maximum share (L, 1) of tangential speed that an impact removes.

        It is less than 1 where the body begins to roll; None for no such limit.
        """
        return None


CoefficientReference = Literal[
    "",
    "input",
    "input/s",
    "input/s^2",
    "error",
    "reading",
    "reading/s",
    "drive",
    "level",
    "travel",
    "stop",
    "give",
    "rotor",
]
"""Quantity from which the unit of a coefficient is derived, or the meaning of a coefficient."""


@dataclass(frozen=True)
class Coefficient:
    """Number of an effect, zero where the effect is off.

    Attributes:
        name: Name; ``coefficient`` if the effect has only one.
        units: Units for a point (per unit mass), linear and rotary system; None where the effect
            does not exist.
        plausible: Plausible ranges, in the same order.
        of: Quantity whose unit it has, if `units` are only the default ones: ``input`` the first
            input, ``error`` likewise for values compared with a servo's error, ``reading`` the
            channel on which it acts, ``input/s`` and ``reading/s`` per second, ``input/s^2`` per
            second squared, ``level`` the stored quantity. Other values state a meaning: ``stop`` is
            the stiffness of a stop at the position given by coefficient ``place``; ``drive`` is a
            limit of the drive's force and ``travel`` a part of its travel, with units of their own;
            ``give`` is a compliance; ``rotor`` is an inertia that a model file may state itself.
        least: Lower bound of a fit that is not a matter of plausibility; None for none.
        most: Upper bound of a fit that is not a matter of plausibility; None for none.
        tried: Values at which a search for it begins, if an evenly spaced grid would be too large.
    """

    name: str
    units: tuple[str | None, str | None, str | None]
    plausible: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
    of: CoefficientReference = ""
    least: float | None = None
    most: float | None = None
    tried: tuple[float, ...] = ()

    def unit(self, kind: SystemKind) -> str | None:
        """Return the unit on systems of this kind; None if the effect does not exist there."""
        return self.units[SYSTEM_KINDS.index(kind)]

    def unit_on(self, system: System | type[System], observed: Sequence[str] = ()) -> str | None:
        """Return the unit on this system; None if the effect does not exist there.

        Args:
            system: System on which the effect acts.
            observed: Names of the recorded channels (default: all).
        """
        if system.has_model:
            return self.unit(system.kind)
        if self.of.startswith(("input", "error")) and system.inputs:
            return self.of.replace("error", "input").replace("input", system.inputs[0].unit)
        if self.of.startswith("reading"):
            units = {channel.name: channel.unit for channel in system.channels}
            return self.of.replace("reading", units[system.reading(observed or tuple(units))])
        return self.unit(system.kind)

    def range(self, kind: SystemKind) -> tuple[float, float]:
        """Return the plausible range on systems of this kind."""
        return self.plausible[SYSTEM_KINDS.index(kind)]


class Effect(ABC):
    """Physical cause that a simulator may lack. Subclass one of the hook classes below instead.

    A coefficient vector `c` has the shape (K, L, 1): ``c[0]`` is the first coefficient of all batch
    elements.

    Attributes:
        name: Name, ``family.form``.
        noun: Noun with article for reports, such as ``linear drag`` or ``a sensor bias``; if empty,
            the name and the beginning of `says` are used.
        says: Description in one sentence, as the end of "the data say that ...".
        source: Reference for the law.
        coefficients: Its numbers; if all are zero, the effect is off and must not change anything,
            bit for bit. Those that a kind of system does not have come last and remain zero there;
            a kind that lacks the first one lacks the effect.
        needs: Property that the system must have: ``input``; ``ground`` that it strikes; ``guide``,
            which a freely flying body lacks; ``joint``, a single one; ``servo``, an input that is a
            set point; ``gravity``; ``push``, the response to horizontal acceleration; ``space``,
            three dimensions; ``model``, a file that states its numbers; ``level``, a stored
            quantity; or empty.
        contains: Simpler effects to which it reduces if some of its coefficients are zero.
        hook: Hook of the engine that it uses; set by the hook classes.
        sharp: Whether it begins and ends at a position within a step, so that finer steps are
            needed.
        at: Kind of its places in a robot.
        place: Place in a robot: the joint, actuator, body or channel where it acts; ``*`` for a
            family; empty for an effect of the world and in systems with one place.
        coordinate: Coordinate on which it acts; None for the system's primary one.
        signal: Input or channel on which it acts; empty for the first, or for all.
        of: Name of the registered effect of which it is a form at one place.
    """

    name: ClassVar[str]
    noun: ClassVar[str] = ""
    says: ClassVar[str]
    source: ClassVar[str] = ""
    coefficients: ClassVar[tuple[Coefficient, ...]]
    needs: ClassVar[str] = ""
    contains: ClassVar[tuple[str, ...]] = ()
    hook: ClassVar[str]
    sharp: ClassVar[bool] = False
    at: ClassVar[PlaceKind]
    place: ClassVar[str] = ""
    coordinate: ClassVar[int | None] = None
    signal: ClassVar[str] = ""
    of: ClassVar[str] = ""

    def parts(self, c: Array) -> ActiveEffects:
        """Return the effect as the sum of effects at one place each.

        Args:
            c: Coefficients (K, L, 1).

        Returns:
            The effects with their coefficients.
        """
        return ((self, c),)

    def taking(self, c: Array, simpler: str, given: Array) -> Array:  # noqa: ARG002
        """Return coefficients that include a simpler effect, which this effect replaces.

        Args:
            c: (k,) coefficients of this effect.
            simpler: Name of the simpler effect, one of `contains`.
            given: Coefficients of the simpler effect.

        Returns:
            Coefficients (k,); the default implementation returns `c` unchanged.
        """
        return c

    @classmethod
    def fits(cls, system: System | type[System]) -> bool:
        """Return whether the system can have this effect."""
        return not cls.misses(system)

    @classmethod
    def misses(cls, system: System | type[System]) -> str:
        """Return why the system cannot have this effect; empty if it can."""
        declared = system if isinstance(system, type) else type(system)
        heavy = any(c.name == "gravity" for c in system.constants)
        says_push = declared.push is not System.push
        in_space = len(system.coordinates) == 3
        lacks = {
            "": "",
            "input": "" if system.inputs else "it has no input",
            "ground": "" if system.bounces else "it meets no ground",
            # A bouncing body flies freely: dry friction and springs would act against nothing.
            "guide": "it flies freely" if system.bounces else "",
            "joint": "" if _is_joint(system) else "it is not one joint alone",
            "servo": "" if declared.servo else "it has no servo that follows a set point",
            "gravity": "" if heavy else "it states no gravity",
            "push": "" if says_push else "it does not say what horizontal acceleration does",
            "space": "" if in_space else "it does not move in three dimensions",
            "model": ""
            if declared.has_model
            else "it has no model file whose numbers may be wrong",
            "level": "" if declared.levels else "it names no level that could spill over",
        }[cls.needs]
        undefined = "" if cls.on(system) else f"it is not defined for a {system.kind} system"
        return lacks or undefined or system.refuses(cls)

    @classmethod
    def on(cls, system: System | type[System]) -> tuple[Coefficient, ...]:
        """Return the coefficients that the effect has on this system."""
        # Coefficients that the kind does not have come last.
        return tuple(takewhile(lambda c: c.unit(system.kind) is not None, cls.coefficients))


def _is_joint(system: System | type[System]) -> bool:
    """Return whether a system is a single joint, declared by equations."""
    return len(system.coordinates) == 1 and not system.bounces and not system.has_model


def members_of(effect: Effect | type[Effect]) -> Sequence[Any]:
    """Return the members of a family, which are instances; otherwise the effect alone."""
    members: Sequence[Any] = getattr(effect, "members", ()) or (effect,)
    return members


class Force(Effect):
    """Generalised force, added to the others."""

    hook = "force"
    at: ClassVar[PlaceKind] = "joint"

    @abstractmethod
    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the generalised force (L, D).

        Args:
            c: Coefficients (K, L, 1).
            moment: State of all batch elements.
        """


class Friction(Effect):
    """Dry friction, which opposes motion with at most `limit` and prevents motion at lower loads.

    Engines add the limits of all frictions and apply one force against the motion.
    """

    hook = "force"
    at: ClassVar[PlaceKind] = "joint"

    @abstractmethod
    def limit(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the maximum force (L, 1), >= 0.

        Args:
            c: Coefficients (K, L, 1).
            moment: State of all batch elements.
        """


@dataclass(frozen=True)
class HiddenState:
    """Hidden state of an effect.

    Attributes:
        x: (L, 1) position, or another first quantity.
        v: (L, 1) rate of `x`.
    """

    x: Array
    v: Array


@dataclass(frozen=True)
class SeriesElement:
    """Element in series between a drive and its load, for many batch elements.

    Attributes:
        stiffness: (L,) stiffness of its spring, N/m or N m/rad; no spring if not above zero.
        damping: (L,) damping ratio of the load on that spring.
        gap: (L,) backlash between its flanks, m or rad; with a spring, the flanks are elastic.
        drive: (L,) inertia of the drive in addition to the stated one, as a share of the joint's.
    """

    stiffness: Array
    damping: Array
    gap: Array
    drive: Array


class HiddenStateEffect(Effect):
    """Force with a hidden state, which no sensor shows and which is integrated as a coordinate.

    It is off where its first coefficient is not above zero.
    """

    hook = "hidden"
    at: ClassVar[PlaceKind] = "joint"
    needs = "joint"
    fastest: ClassVar[float] = 0.0
    """Maximum angular frequency of its oscillations in rad/s, if it is not visible at rest."""
    between: ClassVar[tuple[Coefficient, ...]] = ()
    """Its coefficients where both sides are known, as in a robot.

    Only for an element in series between a drive and its load.
    """

    def element(self, c: Array) -> SeriesElement:
        """Return the series element with these values (K, L) of the coefficients `between`."""
        raise NotImplementedError

    def behind(self, c: Array) -> Array:
        """Return the share (L, 1) of the joint's inertia on the hidden coordinate, below 1."""
        return np.zeros_like(c[0])

    def begin(self, c: Array, moment: StateSnapshot) -> HiddenState:  # noqa: ARG002
        """Return the hidden state at the beginning of the run.

        Args:
            c: Coefficients (K, L, 1).
            moment: State of all batch elements at the beginning.
        """
        return HiddenState(np.zeros_like(c[0]), np.zeros_like(c[0]))

    @abstractmethod
    def act(self, c: Array, moment: StateSnapshot, state: HiddenState) -> tuple[Array, Array]:
        """Return the generalised force and the rate of the hidden state.

        Args:
            c: Coefficients (K, L, 1).
            moment: State of all batch elements.
            state: Hidden state.

        Returns:
            Force (L, D) that the effect adds, and rate (L, 1) of `state.v`.
        """


class ModelValueEffect(Effect):
    """Number in a robot's model file that may be wrong; the engine writes it into the model."""

    hook = "value"
    needs = "model"


class Level(Effect):
    """Bound of a stored quantity, such as a tank's level.

    A user-defined simulator applies it after each of its steps.
    """

    hook = "level"
    at: ClassVar[PlaceKind] = "level"
    needs = "level"

    @abstractmethod
    def keep(self, c: Array, level: Array) -> Array:
        """Return the bounded level (L, 1).

        Args:
            c: Coefficients (K, L, 1).
            level: (L, 1) level before.
        """


class Contact(Effect):
    """Change of an impact with the ground."""

    hook = "contact"
    at: ClassVar[PlaceKind] = "world"

    def restitution(self, c: Array, restitution: Array, speed: Array) -> Array:  # noqa: ARG002
        """Return the restitution (L, 1).

        Args:
            c: Coefficients (K, L, 1).
            restitution: (L, 1) restitution without the effect.
            speed: (L, 1) impact speed, >= 0, m/s.
        """
        return restitution

    def friction(self, c: Array) -> Array:
        """Return the friction coefficient (L, 1).

        The tangential speed lost is this times (1 + e) |vn|, limited by the tangential speed
        itself.
        """
        return np.zeros_like(c[0])


@dataclass(frozen=True)
class Signal:
    """Signal on the steps of an integration.

    Attributes:
        values: (L, S) for an input, the constant value over each step; for a reading, the value at
            its end.
        steps: (L, S) lengths of the steps, s; zero where a batch element waits.
        start: (L, 1) value before the first step.
        times: (L, S) time since the start of the run at the end of each step, s.
        clock: (L, 1) time stamp of the recording at the start of the run, s.
    """

    values: Array
    steps: Array
    start: Array
    times: Array
    clock: Array | float = 0.0


class Input(Effect):
    """Change of the first input on its way to the plant.

    Several effects are applied in the order given by the user.
    """

    hook = "input"
    at: ClassVar[PlaceKind] = "actuator"
    needs = "input"
    between: ClassVar[bool] = False
    """Whether its first coefficient is the share of the opposite interpolation between samples.

    That is linear interpolation for an input that is stated to be held, and the reverse.
    """

    def times(self, c: Array, t: Array) -> Array:  # noqa: ARG002
        """Return the times (L, S) of the commands that are applied at times t (L, S).

        Args:
            c: Coefficients (K, L, 1).
            t: (L, S) times since the start of the run, s.
        """
        return t

    def feel(self, c: Array, signal: Signal) -> Array:  # noqa: ARG002
        """Return the applied values (L, S) over the steps.

        Args:
            c: Coefficients (K, L, 1).
            signal: Signal before the effect.
        """
        return signal.values


class Sensor(Effect):
    """Change of an observation by the sensor that records it."""

    hook = "sensor"
    at: ClassVar[PlaceKind] = "channel"
    filters: ClassVar[bool] = False
    """Whether `read` needs every step of the integration instead of the samples only."""

    def times(self, c: Array, t: Array) -> Array:  # noqa: ARG002
        """Return the times (L, T) at which the system is really sampled.

        Args:
            c: Coefficients (K, L, 1).
            t: (L, T) recorded times since the start of the run, s.
        """
        return t

    def read(self, c: Array, signal: Signal) -> Array:  # noqa: ARG002
        """Return the recorded values (L, S).

        Args:
            c: Coefficients (K, L, 1).
            signal: Signal before the effect.
        """
        return signal.values


ActiveEffects = tuple[tuple[Effect, Array], ...]
"""Effects with their coefficients (K, L, 1)."""


@dataclass(frozen=True)
class IntegrationBatch:
    """Batch of simulations to be integrated by an engine.

    Attributes:
        system: System to integrate.
        theta: (L, p) parameters of the system.
        constants: Constants (L, 1) by name.
        x: (L, D) initial position.
        v: (L, D) initial velocity.
        steps: (L, S) lengths of the steps, s; zero where a batch element has finished.
        inputs: Applied inputs (L, S) by name, constant over each step.
        effects: Forces, frictions, contacts and effects with other hooks of the engine; inputs and
            sensors are processed outside the engine.
        steps_per_sample: Number of steps after which the state is stored, in addition to the
            initial state.
    """

    system: System
    theta: Array
    constants: Mapping[str, Array]
    x: Array
    v: Array
    steps: Array
    inputs: Mapping[str, Array]
    effects: ActiveEffects
    steps_per_sample: int = 1


@dataclass(frozen=True)
class Trajectories:
    """Result of an engine: positions, velocities, accelerations (L, S // every + 1, D).

    The acceleration is that of the smooth motion without the shocks of impacts. Failed batch
    elements are NaN.
    """

    x: Array
    v: Array
    a: Array


class Engine(Protocol):
    """Integrator of batches of simulations."""

    name: str
    requires: tuple[str, ...]
    largest_step: float
    """Maximum step in seconds, to which sampling intervals are divided."""

    def integrate(self, lanes: IntegrationBatch) -> Trajectories:
        """Integrate every batch element over its steps."""
        ...

    def find_unsupported_reason(self, system: type[System]) -> str:
        """Return why this engine cannot integrate the system; empty if it can."""
        ...

    def close(self) -> None:
        """Release the engine's worlds."""
        ...
