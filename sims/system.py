"""What a system is, what an effect gives to it, what an engine integrates: the seam between the
three.

A *system* is declared once (`System`): names, units, and its generalised forces as array functions.
An *engine* integrates it (`Engine`), many lanes at once. An *effect* (`Effect`) adds one
contribution through one hook. None of them knows the others' insides: they meet in `Moment`, the
instant at which forces are asked for, and in `Lanes`, the work for an engine.

Shapes: L lanes (a parameter vector in a run), D coordinates, S steps, K coefficients. Per-lane
numbers are (L, 1), so that they multiply generalised vectors (L, D) as they stand. With the mass M,
the drive U and what it works against, P (gravity alone in most systems: `passive`),

    M x'' = U(x, v, u) - P(x, v) + forces of effects                       (1)

less dry friction, which is added up over its effects and opposes the motion as one force.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import takewhile
from types import MappingProxyType
from typing import Any, ClassVar, Literal, Protocol

import numpy as np

from sims.base import Array, Channel, Constant, Parameter

Kind = Literal["point", "linear", "rotary"]
"""How a system counts force: `point` per unit mass (m/s^2), `linear` in N, `rotary` in N*m."""
KINDS: tuple[Kind, ...] = ("point", "linear", "rotary")
"""All kinds, in the order of a coefficient's units and ranges."""
PlaceKind = Literal["joint", "actuator", "body", "channel", "world", "level"]
"""Kinds of places in a robot, and of an own simulator the levels."""
FAMILY = "*"
"""The place of an effect that acts at all places of its kind."""
STANDARD_GRAVITY = 9.80665
"""m/s^2 (3rd General Conference on Weights and Measures, 1901)."""


@dataclass
class Moment:
    """One instant of every lane, as effects see it.

    Attributes:
        system: whose moment it is.
        theta: (L, p) the system's own parameters.
        constants: known numbers of each lane, (L, 1) by name.
        t: (L, 1) seconds since the start of the run.
        x: (L, D) generalised position.
        v: (L, D) generalised velocity.
        inputs: inputs as the plant feels them, (L, 1) by name.
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
        """(L, 1) magnitude of the velocity."""
        # Exact in one dimension, where the root of a square would round and underflow.
        if self.v.shape[1] == 1:
            return np.abs(self.v)
        speed: Array = np.sqrt((self.v * self.v).sum(axis=1, keepdims=True))
        return speed

    @property
    def gravity(self) -> Array:
        """(L, 1) m/s^2; the standard value where the system states none."""
        return self.constants.get("gravity", np.full((len(self.x), 1), STANDARD_GRAVITY))

    @property
    def weight(self) -> Array:
        """(L, D) generalised force of gravity."""
        return self.system.weight(self)

    def push(self, axis: Literal["x", "y"]) -> Array:
        """(L, D) generalised force of one m/s^2 of horizontal acceleration of everything, along
        `axis`.
        """
        return self.system.push(self, axis)

    @property
    def load(self) -> Array:
        """(L, 1) what a transmission carries: the drive from one side plus what it works against
        from the other.
        """
        carried = self.system.drive(self) + self.system.passive(self)
        load: Array = np.abs(carried).sum(axis=1, keepdims=True)
        return load

    @property
    def sides(self) -> tuple[Array, Array]:
        """(L, 1) each, of the primary coordinate: the force of the drive, and what it works
        against; both press on the transmission where they have one sign.
        """
        place = slice(self.system.primary, self.system.primary + 1)
        return self.system.drive(self)[:, place], self.system.passive(self)[:, place]

    @property
    def drawn(self) -> Array:
        """(L, 1) sizes of the forces of all drives that share the supply of this one."""
        drawn: Array = np.abs(self.sides[0])
        return drawn

    @property
    def error(self) -> Array:
        """(L, 1) of the servo: how far its set point is from where it is."""
        error: Array = self.inputs[self.system.servo] - self.primary
        return error

    def aimed(self, shift: Array) -> Array:
        """(L, D) what the drive would exert more if its servo's set point were moved by `shift`
        (L, 1).
        """
        name = self.system.servo
        moved = replace(self, inputs={**self.inputs, name: self.inputs[name] + shift})
        more: Array = self.system.drive(moved) - self.system.drive(self)
        return more

    @property
    def inertia(self) -> Array:
        """(L, 1) generalised inertia."""
        return self.system.mass(self.theta, self.constants)

    @property
    def primary(self) -> Array:
        """(L, 1) the coordinate that biases, springs and ripples act on."""
        return self.x[:, self.system.primary, None]

    @property
    def primary_rate(self) -> Array:
        """(L, 1) velocity of that coordinate."""
        return self.v[:, self.system.primary, None]

    def along_primary(self, force: Array) -> Array:
        """(L, D) generalised force: `force` (L, 1) along the primary coordinate, zero along the
        others.
        """
        result = np.zeros_like(self.x)
        result[:, self.system.primary] = force[:, 0]
        return result


@dataclass(frozen=True)
class UsualRecording:
    """What a simulated recording of a system shows where the user does not say.

    Attributes:
        observe: channels to record; all that the system has where empty.
        initial: by state, the lowest and the highest value from which each run draws, SI units; a
            state that is not named begins at its default.
        inputs: by input, the text of a signal (`bench.problem.signals`), as ``steps:2:0.5``; an
            input that is not named is zero.
    """

    observe: tuple[str, ...] = ()
    initial: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # One declaration serves every recording of the process: nobody may write into it.
        object.__setattr__(self, "initial", MappingProxyType(dict(self.initial)))
        object.__setattr__(self, "inputs", MappingProxyType(dict(self.inputs)))


@dataclass(frozen=True)
class Derived:
    """A number that follows from a system's parameters and constants, and that people ask for.

    Attributes:
        name: what it is called.
        unit: of it.
        says: what it is, in a few words.
        of: of parameters and constants by name.
        strongest: whether it is the force of the drive at its limit, at rest.
    """

    name: str
    unit: str
    says: str
    of: Callable[[Mapping[str, float]], float]
    strongest: bool = False


@dataclass(frozen=True)
class ModelFile:
    """A system as a robot's model file.

    Attributes:
        text: MJCF.
        joint: its joint.
        actuator: what drives that.
        signals: channels and inputs of the robot, by the system's.
        said: what the file cannot say, a clause each.
    """

    text: str
    joint: str
    actuator: str
    signals: Mapping[str, str]
    said: tuple[str, ...] = ()


class System(ABC):
    """A physical system, declared once for every engine.

    Attributes:
        kind: how it counts force.
        parameters: what may be tuned.
        constants: known numbers with their defaults.
        inputs: signals it takes; effects on the input act on the first.
        channels: what its sensors can give; effects on a sensor's value act on the first one
            observed of `sensed`.
        coordinates: state names of the generalised position, in order.
        rates: state names of the generalised velocity, in order.
        states: defaults of both.
        bounces: whether its last coordinate strikes ground at `floor`.
        afloat: units by name of the states that are poses and velocities of bodies that float, and
            no coordinates: where a run begins with them is known, and where a part of one does is
            not.
        sensed: channels that sensor effects may act on, in order of preference.
        primary: index of the coordinate that biases and springs act on.
        servo: input that is the set point of a servo's primary coordinate; empty where none is.
        uniform: whether its own force is the same everywhere and always, so that it moves along
            parabolas.
        bends: whether its own force may bend sharply, so that steps are shortened where it does.
        fastest: rad/s with which it may swing where a look at its forces does not show it; its
            steps are divided for that, too.
        guided: how many coordinates, the first ones, dry friction acts on; 0 for all.
        has_model: whether it comes from a model file, whose numbers may be wrong.
        levels: states that are stores, such as a tank's level: they may spill over.
        usual_recording: what its simulated recordings show where the user does not say.
        derived: numbers that follow from others, for a data sheet.
        left_out: effects that it would have and cannot simulate, with the reason, by name. Whatever
            asks for all effects (`sims.effects.library`) fills it.
    """

    name: ClassVar[str]
    says: ClassVar[str]
    kind: ClassVar[Kind]
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
    usual_recording: ClassVar[UsualRecording] = UsualRecording()
    derived: ClassVar[tuple[Derived, ...]] = ()
    left_out: ClassVar[dict[str, str]] = {}

    @classmethod
    def reading(cls, observed: Sequence[str]) -> str:
        """The channel among those `observed` whose value sensor effects act on."""
        return next((name for name in cls.sensed if name in observed), observed[0])

    @classmethod
    def model_file(cls, numbers: Mapping[str, float]) -> ModelFile | None:  # noqa: ARG003
        """The system as a robot's model file, with these parameters and constants by name; None
        where it has no such form.
        """
        return None

    @classmethod
    def gear(cls, coordinate: int) -> float:  # noqa: ARG003
        """By how much its servo turns for each unit of a coordinate."""
        return 1.0

    @classmethod
    def placed(cls, effect: type[Effect]) -> Sequence[type[Effect]]:
        """The registered effect where this system can have it: itself in a system of one place, a
        class for each place and family in a robot; empty where it cannot.
        """
        return (effect,) if effect.fits(cls) else ()

    @classmethod
    def effect(cls, name: str) -> type[Effect] | None:  # noqa: ARG003
        """The effect of a name that only this system knows, as those of its places; None for what
        is registered.
        """
        return None

    @classmethod
    def refuses(cls, effect: type[Effect]) -> str:  # noqa: ARG003
        """Why it cannot have an effect although it has all that the effect `needs`; empty if it
        can.
        """
        return ""

    @abstractmethod
    def mass(self, theta: Array, constants: Mapping[str, Array]) -> Array:
        """(L, 1) generalised inertia; 1 for a system that counts force per unit mass."""

    @abstractmethod
    def weight(self, moment: Moment) -> Array:
        """(L, D) generalised force of gravity."""

    def drive(self, moment: Moment) -> Array:
        """(L, D) generalised force of the inputs, through the actuator."""
        return np.zeros_like(moment.x)

    def passive(self, moment: Moment) -> Array:
        """(L, D) minus every generalised force of the system that is not the drive: what the drive
        works against.
        """
        return -self.weight(moment)

    def force(self, moment: Moment) -> Array:
        """(L, D) generalised force of the system itself, without effects."""
        return self.drive(moment) - self.passive(moment)  # (1)

    def push(self, moment: Moment, axis: Literal["x", "y"]) -> Array:
        """(L, D) generalised force of one m/s^2 of horizontal acceleration along `axis`; zero where
        it has none.
        """
        raise NotImplementedError

    @abstractmethod
    def observe(
        self, x: Array, v: Array, a: Array, constants: Mapping[str, Array]
    ) -> dict[str, Array]:
        """Channels (L, S) by name from positions, velocities, accelerations (L, S, D); constants
        are (L, 1).
        """

    def floor(self, constants: Mapping[str, Array]) -> Array:
        """(L, 1) value of the last coordinate at which it strikes the ground."""
        raise NotImplementedError

    def restitution(self, theta: Array) -> Array:
        """(L, 1) restitution at an impact."""
        raise NotImplementedError

    def friction(self, constants: Mapping[str, Array]) -> Array | None:  # noqa: ARG002
        """(L, 1) friction coefficient of the ground itself, without effects; None for none."""
        return None

    def grip(self, constants: Mapping[str, Array]) -> Array | None:  # noqa: ARG002
        """(L, 1) largest share of tangential speed that an impact takes, less than 1 where the body
        spins up.
        """
        return None


Of = Literal[
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
"""Whose unit a coefficient has, or what it is of."""


@dataclass(frozen=True)
class Coefficient:
    """A number of an effect, zero where the effect is off.

    Attributes:
        name: ``coefficient`` where the effect has only one.
        units: for a point (per unit mass), linear and rotary system; None where the effect does not
            exist there.
        plausible: the range one would expect, in the same order.
        of: whose unit it has where `units` are only the usual ones: ``input`` the first input's,
            ``error`` the same, where it is compared with a servo's error, ``reading`` that of the
            channel it acts on, ``input/s`` and ``reading/s`` the same per second,
            ``input/s^2`` per second and second; ``level`` that of what is stored; ``stop`` is the
            stiffness of one that stands where coefficient ``place`` says; ``drive`` is a limit of
            the drive's force and ``travel`` a part of the way that it goes, with units of their
            own; ``give`` is how far something yields to a force; ``rotor`` is an inertia that a
            model file may state itself.
        least: what a fit may not go below, where that is not a matter of plausibility.
        most: what it may not exceed, likewise.
        tried: sizes from which a search for it begins, where evenly spread ones would be too many.
    """

    name: str
    units: tuple[str | None, str | None, str | None]
    plausible: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
    of: Of = ""
    least: float | None = None
    most: float | None = None
    tried: tuple[float, ...] = ()

    def unit(self, kind: Kind) -> str | None:
        """The unit on systems of this kind; None where the effect does not exist there."""
        return self.units[KINDS.index(kind)]

    def unit_on(self, system: System | type[System], observed: Sequence[str] = ()) -> str | None:
        """The unit on this system, of whose channels those named `observed` are recorded (default:
        all).
        """
        if system.has_model:
            return self.unit(system.kind)
        if self.of.startswith(("input", "error")) and system.inputs:
            return self.of.replace("error", "input").replace("input", system.inputs[0].unit)
        if self.of.startswith("reading"):
            units = {channel.name: channel.unit for channel in system.channels}
            return self.of.replace("reading", units[system.reading(observed or tuple(units))])
        return self.unit(system.kind)

    def range(self, kind: Kind) -> tuple[float, float]:
        """The plausible range on systems of this kind."""
        return self.plausible[KINDS.index(kind)]


class Effect(ABC):
    """One physical cause that a simulator may lack. Subclass one of the hooks below, not this.

    A coefficient vector `c` comes as (K, L, 1): ``c[0]`` is the first coefficient of every lane.

    Attributes:
        name: ``family.form``.
        noun: what a report calls it, with its article, such as ``linear drag`` or ``a sensor
            bias``; without one its name and the beginning of `says` stand there.
        says: one sentence that a person understands, as the end of "the data say that ...".
        source: where the law stands.
        coefficients: its numbers; all zero is off, and must change nothing, bit for bit. Those that
            a kind of system does not have come last and stay zero there; a kind that lacks the
            first lacks the effect.
        needs: what the system must have: ``input``; ``ground`` to strike; ``guide``, which a body
            that flies freely lacks; ``joint``, one alone; ``servo``, an input that is a set point;
            ``gravity``; ``push``, a say in what horizontal acceleration does to it; ``space`` of
            three dimensions; ``model``, a file that states its numbers; ``level``, something that
            it stores;
            or empty.
        contains: simpler effects that it turns into where some of its coefficients are zero.
        hook: which of the engine's hooks it uses; set by the hook classes.
        sharp: whether it begins and ends at a place, within a step: it is followed in finer steps.
        at: of what kind its places in a robot are.
        place: of a robot: the joint, actuator, body or channel where it acts; ``*`` of a family;
            empty for an effect of the world and in systems of one place.
        coordinate: which coordinate it acts on; None for the system's primary one.
        signal: the input or channel that it acts on; empty for the first, or for all.
        of: name of the effect that it is at a place.
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

    def parts(self, c: Array) -> Acting:
        """The effect as the sum of effects at one place each, with their coefficients (K, L, 1)."""
        return ((self, c),)

    def taking(self, c: Array, simpler: str, given: Array) -> Array:  # noqa: ARG002
        """Coefficients (k,) that do besides what a simpler effect that it contains, which it is to
        stand for, does with those `given`, as far as one of them says so.
        """
        return c

    @classmethod
    def fits(cls, system: System | type[System]) -> bool:
        """Whether the system can have this effect."""
        return not cls.misses(system)

    @classmethod
    def misses(cls, system: System | type[System]) -> str:
        """What keeps the system from having this effect; empty if it can have it."""
        declared = system if isinstance(system, type) else type(system)
        heavy = any(c.name == "gravity" for c in system.constants)
        says_push = declared.push is not System.push
        in_space = len(system.coordinates) == 3
        lacks = {
            "": "",
            "input": "" if system.inputs else "it has no input",
            "ground": "" if system.bounces else "it meets no ground",
            # What bounces flies freely: dry friction and springs have nothing to hold on to.
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
        """The coefficients that the effect has on this system."""
        # Those that the kind does not have come last, so the others are the first ones.
        return tuple(takewhile(lambda c: c.unit(system.kind) is not None, cls.coefficients))


def _is_joint(system: System | type[System]) -> bool:
    """Whether it is a single joint, declared in equations."""
    return len(system.coordinates) == 1 and not system.bounces and not system.has_model


def members_of(effect: Effect | type[Effect]) -> Sequence[Any]:
    """Return the members of a family, which are instances; any other effect alone."""
    members: Sequence[Any] = getattr(effect, "members", ()) or (effect,)
    return members


class Force(Effect):
    """A generalised force, added to the others."""

    hook = "force"
    at: ClassVar[PlaceKind] = "joint"

    @abstractmethod
    def force(self, c: Array, moment: Moment) -> Array:
        """(L, D) generalised force."""


class Friction(Effect):
    """Dry friction: opposes motion with at most `limit`, and holds still at rest what pulls less
    than that.

    Engines add up the limits of all frictions and apply one force against the motion.
    """

    hook = "force"
    at: ClassVar[PlaceKind] = "joint"

    @abstractmethod
    def limit(self, c: Array, moment: Moment) -> Array:
        """(L, 1) largest force, >= 0."""


@dataclass(frozen=True)
class State:
    """The state of its own that an effect has.

    Attributes:
        x: (L, 1) position, or whatever else its first number is.
        v: (L, 1) rate of it.
    """

    x: Array
    v: Array


@dataclass(frozen=True)
class Element:
    """What lies in series between a drive and what it carries, in many lanes.

    Attributes:
        stiffness: (L,) N/m or N m/rad of its spring; none where it is not above zero.
        damping: (L,) share of the critical one of what is carried on that spring.
        gap: (L,) m or rad between its flanks; with a spring, flanks that give.
        drive: (L,) inertia of the drive besides what is stated, as a share of the joint's.
    """

    stiffness: Array
    damping: Array
    gap: Array
    drive: Array


class Hidden(Effect):
    """A force that hangs on more than the system's own motion: on a state that no sensor shows,
    and that goes on beside it as one more coordinate.

    It is off where its first coefficient is not above zero.
    """

    hook = "hidden"
    at: ClassVar[PlaceKind] = "joint"
    needs = "joint"
    fastest: ClassVar[float] = 0.0
    """rad/s with which it may swing, where that is not to be seen at rest."""
    between: ClassVar[tuple[Coefficient, ...]] = ()
    """Its numbers where both sides of it are known, as in a robot, if it is an element in series
    between a drive and what that carries."""

    def element(self, c: Array) -> Element:
        """The element of these numbers (K, L), of those that `between` has."""
        raise NotImplementedError

    def behind(self, c: Array) -> Array:
        """(L, 1) share of the joint's inertia that moves with the hidden coordinate, below 1."""
        return np.zeros_like(c[0])

    def begin(self, c: Array, moment: Moment) -> State:  # noqa: ARG002
        """Its state when the run begins, at that moment."""
        return State(np.zeros_like(c[0]), np.zeros_like(c[0]))

    @abstractmethod
    def act(self, c: Array, moment: Moment, state: State) -> tuple[Array, Array]:
        """The generalised force (L, D) that it adds, and the rate (L, 1) of `state.v`."""


class Value(Effect):
    """A number that a robot's model file states, and that may be wrong; the engine writes it into
    the model.
    """

    hook = "value"
    needs = "model"


class Level(Effect):
    """A bound of what a system stores, such as the level of a tank; an own simulator takes it after
    each of its steps.
    """

    hook = "level"
    at: ClassVar[PlaceKind] = "level"
    needs = "level"

    @abstractmethod
    def keep(self, c: Array, level: Array) -> Array:
        """(L, 1) what remains of a level (L, 1)."""


class Contact(Effect):
    """A change to what happens at an impact with the ground."""

    hook = "contact"
    at: ClassVar[PlaceKind] = "world"

    def restitution(self, c: Array, restitution: Array, speed: Array) -> Array:  # noqa: ARG002
        """(L, 1) restitution from what it would be, and the impact speed (L, 1) >= 0 in m/s."""
        return restitution

    def friction(self, c: Array) -> Array:
        """(L, 1) friction coefficient: tangential speed lost is this times (1 + e) |vn|, never more
        than there is.
        """
        return np.zeros_like(c[0])


@dataclass(frozen=True)
class Signal:
    """A signal on the steps of an integration.

    Attributes:
        values: (L, S); for an input the constant value over each step, for a reading the value at
            its end.
        steps: (L, S) lengths of the steps, seconds; zero where a lane waits.
        start: (L, 1) value before the first step.
        times: (L, S) seconds since the start of the run, at the end of each step.
        clock: (L, 1) what the recording's stamps say at the start of the run, seconds.
    """

    values: Array
    steps: Array
    start: Array
    times: Array
    clock: Array | float = 0.0


class Input(Effect):
    """The first input as the plant feels it. Several are applied in the order of `bench` and the
    command line.
    """

    hook = "input"
    at: ClassVar[PlaceKind] = "actuator"
    needs = "input"
    between: ClassVar[bool] = False
    """Whether its first coefficient is the share with which the signal goes from sample to sample
    as the recording does not say: straight where it is said to hold."""

    def times(self, c: Array, t: Array) -> Array:  # noqa: ARG002
        """The instants (L, S) of the commanded signal that are felt at instants t (L, S)."""
        return t

    def feel(self, c: Array, signal: Signal) -> Array:  # noqa: ARG002
        """(L, S) felt values over the steps."""
        return signal.values


class Sensor(Effect):
    """The observation as recorded."""

    hook = "sensor"
    at: ClassVar[PlaceKind] = "channel"
    filters: ClassVar[bool] = False
    """Whether `read` must see every step of the integration rather than the samples alone."""

    def times(self, c: Array, t: Array) -> Array:  # noqa: ARG002
        """The instants (L, T) at which the world is really sampled, for recorded time stamps t
        since the start.
        """
        return t

    def read(self, c: Array, signal: Signal) -> Array:  # noqa: ARG002
        """(L, S) recorded values."""
        return signal.values


Acting = tuple[tuple[Effect, Array], ...]
"""Effects with their coefficients (K, L, 1)."""


@dataclass(frozen=True)
class Lanes:
    """Work for an engine.

    Attributes:
        system: what to integrate.
        theta: (L, p) the system's parameters.
        constants: (L, 1) by name.
        x: (L, D) initial position.
        v: (L, D) initial velocity.
        steps: (L, S) step lengths in seconds; zero where a lane has nothing more to do.
        inputs: felt inputs (L, S) by name, constant over each step.
        effects: forces, frictions and contacts; inputs and sensors are dealt with outside the
            engine.
        every: keep the state after every this many steps (and the initial one).
    """

    system: System
    theta: Array
    constants: Mapping[str, Array]
    x: Array
    v: Array
    steps: Array
    inputs: Mapping[str, Array]
    effects: Acting
    every: int = 1


@dataclass(frozen=True)
class Motion:
    """What an engine gives back: positions, velocities, accelerations (L, S // every + 1, D).

    The acceleration is that of the smooth motion (an impact's shock is not in it). A lane that
    failed is NaN.
    """

    x: Array
    v: Array
    a: Array


class Engine(Protocol):
    """Integrates lanes."""

    name: str
    requires: tuple[str, ...]
    largest_step: float
    """Seconds; the plan divides sampling intervals into steps not longer than this."""

    def integrate(self, lanes: Lanes) -> Motion:
        """Integrate every lane over its steps."""
        ...

    def refuses(self, system: type[System]) -> str:
        """Why this engine cannot carry the system; empty if it can."""
        ...

    def close(self) -> None:
        """Give back worlds."""
        ...
