"""Interface of systems, and the state at which their forces are evaluated.

A *system* is declared once (`System`): names, units, and its generalised forces as array functions.
An *engine* integrates it (`sims.core.engine`), many batch elements at once. An *effect*
(`sims.core.effect`) adds one contribution. They are independent of each other's implementation and
communicate through `StateSnapshot`, the state at which forces are evaluated.

Shapes: L batch elements (each a parameter vector in a run), D coordinates, S steps, K coefficients.
Numbers per batch element are (L, 1), so that they can be multiplied with generalised vectors
(L, D). With the mass M, the drive U and the passive force P that it works against (gravity alone in
most systems: `passive`),

    M x'' = U(x, v, u) - P(x, v) + forces of effects                       (1)

minus dry friction, whose limits are added over all effects and which opposes the motion as one
force.
"""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np

from sims.core.simulator import Array, Channel, Constant, Parameter

EffectClass = type[Any]
"""Class of an effect; see `sims.core.effect.Effect`, which depends on this module."""

SystemKind = Literal["point", "linear", "rotary"]
"""Unit of a system's forces: `point` per unit mass (m/s^2), `linear` in N, `rotary` in N*m."""
SYSTEM_KINDS: tuple[SystemKind, ...] = ("point", "linear", "rotary")
"""All kinds, in the order of a coefficient's units and ranges."""
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
        primary = slice(self.system.primary, self.system.primary + 1)
        return self.system.drive(self)[:, primary], self.system.passive(self)[:, primary]

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

        Effects inside a servo, such as its dead band, are expressed as such a shift.

        Shapes: L batch elements, D coordinates.

        Args:
            shift: (L, 1) shift of the set point.
        """
        name = self.system.servo
        shifted_moment = replace(self, inputs={**self.inputs, name: self.inputs[name] + shift})
        difference: Array = self.system.drive(shifted_moment) - self.system.drive(self)
        return difference

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
        notes: Properties that the file cannot express, one clause each.
    """

    text: str
    joint: str
    actuator: str
    signals: Mapping[str, str]
    notes: tuple[str, ...] = ()


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
        floating_state_units: Units by name of the poses and velocities of floating bodies, which
            are states but no coordinates.
        required_state_units: Those of them that do not follow from closed loops: they are known at
            the beginning of a run, where a recording has to state them, but not at the beginning of
            a part of a run.
        base_orientations: Orientation (w, x, y, z) in the model file of each floating body whose
            pose is recorded, by the name of its joint.
        loops: Coordinates that constraints couple, such as those of a four-bar linkage, as sets of
            indices.
        sensed: Channels on which sensor effects may act, in order of preference.
        primary: Index of the coordinate on which biases and springs act.
        servo: Input that is the set point of the servo of the primary coordinate; empty without a
            servo.
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
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    constants: ClassVar[tuple[Constant, ...]] = ()
    inputs: ClassVar[tuple[Channel, ...]] = ()
    channels: ClassVar[tuple[Channel, ...]] = ()
    coordinates: ClassVar[tuple[str, ...]] = ()
    rates: ClassVar[tuple[str, ...]] = ()
    states: ClassVar[Mapping[str, float]] = MappingProxyType({})
    sensed: ClassVar[tuple[str, ...]] = ()
    primary: ClassVar[int] = 0
    servo: ClassVar[str] = ""
    bounces: ClassVar[bool] = False
    floating_state_units: ClassVar[Mapping[str, str]] = {}
    required_state_units: ClassVar[Mapping[str, str]] = {}
    base_orientations: ClassVar[Mapping[str, tuple[float, ...]]] = {}
    loops: ClassVar[Sequence[frozenset[int]]] = ()
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
    def close_loops(
        cls,
        states: Mapping[str, float],
        measured: Collection[str],  # noqa: ARG003
    ) -> dict[str, float]:
        """Return states that satisfy the constraints of closed loops, such as a four-bar linkage.

        By default, a system has no loops, and the states are returned unchanged.

        Args:
            states: States by name.
            measured: Names of the states that stay; the other coordinates of a loop are moved.
        """
        return dict(states)

    @classmethod
    def gear(cls, coordinate: int) -> float:  # noqa: ARG003
        """Return the gear ratio: the servo's travel per unit of a coordinate."""
        return 1.0

    @classmethod
    def placed(cls, effect: EffectClass) -> Sequence[EffectClass]:
        """Return the forms of a registered effect that this system can have; empty if none.

        This is the effect itself in a system with one place, and a class for each place and family
        in a robot.
        """
        return (effect,) if effect.fits(cls) else ()

    @classmethod
    def effect(cls, name: str) -> EffectClass | None:  # noqa: ARG003
        """Return the effect with a name that only this system defines, such as those of its places.

        The result is None for registered effects.
        """
        return None

    @classmethod
    def refuses(cls, effect: EffectClass) -> str:  # noqa: ARG003
        """Return why the system cannot have an effect although it has all that the effect `needs`.

        The result is empty if it can.
        """
        return ""

    def mass(self, theta: Array, constants: Mapping[str, Array]) -> Array:
        """Return the generalised inertia (L, 1); 1 for a system that counts force per unit mass.

        There is no default: a system does not define it if its engine computes inertia and gravity.

        Shapes: L batch elements, p parameters.

        Args:
            theta: (L, p) parameters.
            constants: Constants (L, 1) by name.
        """
        raise NotImplementedError

    def weight(self, moment: StateSnapshot) -> Array:
        """Return the generalised force (L, D) of gravity; see `mass`."""
        raise NotImplementedError

    def drive(self, moment: StateSnapshot) -> Array:
        """Return the generalised force (L, D) of the inputs, applied by the actuator."""
        return np.zeros_like(moment.x)

    def passive(self, moment: StateSnapshot) -> Array:
        """Return minus all generalised forces (L, D) of the system except the drive.

        This is the force that the drive works against.
        """
        return -self.weight(moment)

    def force(self, moment: StateSnapshot) -> Array:
        """Return the generalised force (L, D) of the system itself, without effects.

        With the mass M, M x'' = U(x, v, u) - P(x, v) + forces of effects (1).
        """
        return self.drive(moment) - self.passive(moment)  # (1)

    def push(self, moment: StateSnapshot, axis: Literal["x", "y"]) -> Array:
        """Return the generalised force (L, D) of a horizontal acceleration of 1 m/s^2.

        Args:
            moment: State of all batch elements.
            axis: Direction of the acceleration.
        """
        raise NotImplementedError

    def observe(
        self,
        x: Array,
        v: Array,
        a: Array,  # noqa: ARG002
        constants: Mapping[str, Array],  # noqa: ARG002
    ) -> dict[str, Array]:
        """Return the channels (L, S) by name; unless overridden, each of them is a state.

        Shapes: L batch elements, S steps, D coordinates.

        Args:
            x: (L, S, D) positions.
            v: (L, S, D) velocities.
            a: (L, S, D) accelerations.
            constants: Constants (L, 1) by name.
        """
        # Transposed, the last axis comes first: one array (S, L) for each coordinate.
        motion = dict(zip(self.coordinates + self.rates, [*x.T, *v.T], strict=True))
        return {channel.name: motion[channel.name].T for channel in self.channels}

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
