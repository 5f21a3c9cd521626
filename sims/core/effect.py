"""Interface of effects: physical causes that a simulator may lack.

An *effect* (`Effect`) adds one contribution to a system through one hook: a force, dry friction, a
hidden state, contact, an input or a sensor. It knows neither the engine nor the other effects. The
shapes of its arrays are those of `sims.core.system`.
"""

from __future__ import annotations

from abc import ABCMeta, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any, ClassVar, Literal

import numpy as np

from sims.core.simulator import Array, Parameter
from sims.core.system import SYSTEM_KINDS, StateSnapshot, System, SystemKind

PlaceKind = Literal["joint", "actuator", "body", "channel", "contact", "geom", "world", "level"]
"""Kinds of places where an effect acts; `level` exists only in user-defined simulators."""
ALL_PLACES = "*"
"""Place of an effect that acts at all places of its kind."""


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
    "shift",
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
            ``give`` is a compliance; ``rotor`` is an inertia that a model file may state itself;
            ``shift`` is a time by which a signal that may jump comes later.
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

        If `of` names the input or the reading (the channel on which sensor effects act), its unit
        replaces that word: ``input/s`` becomes ``N/s`` for a force as input. An ``error`` of a
        servo has the unit of its input, the set point.

        Args:
            system: System on which the effect acts.
            observed: Names of the recorded channels (default: all).
        """
        # The coefficients at the places of a robot have the units of their own places.
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


class EffectType(ABCMeta):
    """Type of effect classes: abstract base classes without virtual subclasses.

    Each robot has hundreds of effect classes, one for each place. `ABCMeta` checks all of
    them for virtual subclasses, which took 5 % of the time of an explanation.
    """

    __instancecheck__ = type.__instancecheck__
    __subclasscheck__ = type.__subclasscheck__


class Effect(metaclass=EffectType):
    """Physical cause that a simulator may lack. Subclass one of the hook classes below instead.

    A coefficient vector `c` has the shape (K, L, 1): ``c[0]`` is the first coefficient of all batch
    elements.

    Attributes:
        name: Name, ``family.form``.
        noun: Noun with article for reports, such as ``linear drag`` or ``a sensor bias``; if empty,
            the name and the beginning of `says` are used.
        says: Description in one sentence, as the end of "the data say that ...".
        noun_at_place: Noun at a place of a robot, if the effect has another meaning there.
        says_at_place: Description at a place of a robot, if the effect has another meaning there.
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
        is_traceable: Whether its force can be compiled; False if it selects by the values of its
            coefficients, so that NumPy evaluates it.
        pairs: For an effect at a contact of a robot, the pairs of geoms whose contacts get
            parameters of their own.
    """

    name: ClassVar[str]
    noun: ClassVar[str] = ""
    says: ClassVar[str]
    noun_at_place: ClassVar[str] = ""
    says_at_place: ClassVar[str] = ""
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
    is_traceable: ClassVar[bool] = True
    pairs: ClassVar[tuple[str, ...]] = ()

    def parts(self, c: Array) -> ActiveEffects:
        """Return the effects of which this effect is the sum, with their coefficients.

        A family, such as friction in all joints of a robot, returns its members; other effects
        return themselves.

        Args:
            c: (K, L, 1) the K coefficients of L batch elements.
        """
        return ((self, c),)

    def taking(self, c: Array, simpler: str, given: Array) -> Array:  # noqa: ARG002
        """Return coefficients with which this effect also does the work of a simpler one.

        It is called where this effect replaces the simpler one in a model.

        Args:
            c: (k,) coefficients of this effect.
            simpler: Name of the simpler effect, one of `contains`.
            given: (m,) coefficients of the simpler effect.

        Returns:
            Coefficients (k,); the default implementation returns `c` unchanged.
        """
        return c

    def probe_points(self) -> Sequence[Array]:
        """Return small coefficients (k,) whose changes of the motion add up (`combine`).

        They replace the small change of each coefficient where the effect is not linear in them,
        such as a mass at a position. By default, there are none.
        """
        return ()

    def combine(self, points: Array, weights: Array) -> Array:
        """Return the coefficients (k,) whose change is nearly a weighted sum of changes.

        Args:
            points: (n, k) coefficients of `probe_points`.
            weights: (n,) multiple of each.
        """
        raise NotImplementedError

    @classmethod
    def fits(cls, system: System | type[System]) -> bool:
        """Return whether the system can have this effect."""
        return not cls.misses(system)

    @classmethod
    def misses(cls, system: System | type[System]) -> str:
        """Return why the system cannot have this effect; empty if it can.

        The reason is the first of these that applies: the system lacks the property `needs` of the
        effect; no coefficient is defined for this kind of system; the system itself refuses it.

        Args:
            system: System, or class of a system.
        """
        system_class = system if isinstance(system, type) else type(system)
        has_gravity = any(c.name == "gravity" for c in system.constants)
        defines_push = system_class.push is not System.push
        has_three_coordinates = len(system.coordinates) == 3
        # For each property that an effect may need, why the system lacks it; empty if it has it.
        reason = {
            "": "",
            "input": "" if system.inputs else "it has no input",
            "ground": "" if system.bounces else "it has no contact with a ground",
            # A bouncing body flies freely: dry friction and springs would act against nothing.
            "guide": "it flies freely" if system.bounces else "",
            "joint": "" if _is_joint(system) else "it is not a single joint",
            "servo": "" if system_class.servo else "it has no servo that follows a set point",
            "gravity": "" if has_gravity else "it states no gravity",
            "push": ""
            if defines_push
            else "it does not define the effect of horizontal acceleration",
            "space": "" if has_three_coordinates else "it does not move in three dimensions",
            "model": ""
            if system_class.has_model
            else "it has no model file whose numbers may be wrong",
            "level": "" if system_class.levels else "it declares no level that could overflow",
        }[cls.needs]
        undefined = "" if cls.on(system) else f"it is not defined for a {system.kind} system"
        return reason or undefined or system.refuses(cls)

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


def is_dry_friction(effect: Effect | type[Effect]) -> bool:
    """Return whether an effect, or a member of a family, is dry friction."""
    kinds = (member if isinstance(member, type) else type(member) for member in members_of(effect))
    return any(issubclass(kind, Friction) for kind in kinds)


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

        Shapes: L batch elements, D coordinates, K coefficients.

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

        Shapes: L batch elements, K coefficients.

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
    """True if its first coefficient is the share of the opposite interpolation between samples.

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
    """True if `read` needs every step of the integration instead of the samples only."""

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


def make_effect_parameters(
    effect: Effect | type[Effect], system: type[System], observed: Sequence[str] = ()
) -> tuple[Parameter, ...]:
    """Return the coefficients of an effect as parameters with their plausible ranges as bounds.

    A parameter is called ``EFFECT.COEFFICIENT``, or ``EFFECT`` if there is only one coefficient.

    Args:
        effect: Effect.
        system: System on which it acts.
        observed: Names of the observed channels, which may determine units; all if empty.
    """
    parameters = []
    coefficients = effect.on(system)
    for coefficient in coefficients:
        name = effect.name if len(coefficients) == 1 else f"{effect.name}.{coefficient.name}"
        low, high = coefficient.range(system.kind)
        unit = coefficient.unit_on(system, observed) or ""
        nominal = min(max(0.0, low), high)  # zero, or the nearest value of the range
        parameters.append(Parameter(name, unit, nominal, (low, high), says=effect.says))
    return tuple(parameters)
