"""A user's own model in PyBullet, MuJoCo or anything else that steps, as a simulator; see
docs/own-simulator.md.

Subclass `OwnSimulator`, declare what it is, and give `reset`, `step` and `observe`. Effects on
inputs and sensors then act on it as on any other; effects that are forces and dry frictions do if
it takes forces (`apply_force`, `inertia`).
"""

from __future__ import annotations

import weakref
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np

from sims.base import Array, Channel, InputError, Parameter
from sims.bullet import engine
from sims.limits import cut, is_number
from sims.own_engine import OwnEngine
from sims.own_levels import at_levels, named
from sims.simulated import Simulated
from sims.system import (
    KINDS,
    Contact,
    Effect,
    Engine,
    Force,
    Friction,
    Hidden,
    Kind,
    Level,
    Moment,
    System,
)


class OwnSystem(System):
    """The declaration behind an own simulator, made from its class attributes."""

    name = "own"
    says = "a user's own simulator"
    kind: ClassVar[Kind] = "linear"
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    channels: ClassVar[tuple[Channel, ...]] = ()
    coordinates: ClassVar[tuple[str, ...]] = ()
    rates: ClassVar[tuple[str, ...]] = ()
    states: ClassVar[Mapping[str, float]] = {}
    sensed: ClassVar[tuple[str, ...]] = ()
    simulator: ClassVar[type[OwnSimulator]]

    @classmethod
    def placed(cls, effect: type[Effect]) -> Sequence[type[Effect]]:
        """An effect on levels at each of them, any other as it is."""
        if issubclass(effect, Level) and not effect.misses(cls):
            return at_levels(effect, cls)
        return super().placed(effect)

    @classmethod
    def effect(cls, name: str) -> type[Effect] | None:
        """The effect of a name such as ``state.overflow@upper``."""
        return named(name, cls)

    @classmethod
    def refuses(cls, effect: type[Effect]) -> str:
        """A force needs the simulator's hook; dry friction its inertia besides; an impact is out of
        reach.
        """
        if issubclass(effect, Contact):
            return "an own simulator does not say when it strikes something"
        if issubclass(effect, Level) and cls.simulator.put is OwnSimulator.put:
            return "its levels cannot be set (it has no method put)"
        if issubclass(effect, Hidden):
            return "an own simulator takes forces and no states beside its own"
        if not issubclass(effect, Force | Friction):
            return ""
        if cls.simulator.apply_force is OwnSimulator.apply_force:
            return "it takes no forces (it has no method apply_force)"
        if issubclass(effect, Friction) and cls.simulator.inertia is OwnSimulator.inertia:
            return "it does not say its inertia (it has no method inertia)"
        try:
            _ask(effect, cls)
        except _UnsaidError as reason:
            return str(reason)
        return ""

    def mass(self, theta: Array, constants: Mapping[str, Array]) -> Array:
        """Not known outside the simulator."""
        raise _UnsaidError("it does not say its mass")

    def weight(self, moment: Moment) -> Array:
        """Not known outside the simulator."""
        raise _UnsaidError("it does not say what gravity does to it")

    def drive(self, moment: Moment) -> Array:
        """Not known outside the simulator."""
        raise _UnsaidError("it does not say what its inputs do to it")

    def observe(
        self, x: Array, v: Array, a: Array, constants: Mapping[str, Array]
    ) -> dict[str, Array]:
        """The motion of an own simulator is what it observes."""
        return {c.name: x[:, :, i] for i, c in enumerate(self.channels)}


class _UnsaidError(InputError):
    """Something that an effect asks for and the simulator does not say."""


def _ask(effect: type[Effect], system: type[OwnSystem]) -> None:
    """Let the effect ask the system once for all it needs."""
    # With coefficients of zero at rest at zero: what it asks for counts, not what comes out.
    one = np.ones((1, 1))
    d = len(system.coordinates)
    constants = {c.name: c.value * one for c in system.constants}
    inputs = {c.name: 0.0 * one for c in system.inputs}
    theta = np.array([[p.nominal for p in system.parameters]])
    nothing = np.zeros((1, d))
    moment = Moment(system(), theta, constants, 0 * one, nothing, nothing, inputs)
    c = np.zeros((len(effect.coefficients), 1, 1))
    if issubclass(effect, Force):
        effect().force(c, moment)
    elif issubclass(effect, Friction):
        effect().limit(c, moment)


class OwnSimulator(Simulated):
    """Base of a user's own simulator.

    Declare the attributes of `Simulator` (name, says, parameters, channels, constants, inputs,
    states, requires), then those below where they apply, and write `reset`, `step` and `observe`.

    Attributes:
        time_step: the longest step in seconds; `step` is called with this or less, so that every
            sample is hit.
        kind: how its forces count: ``linear`` in N, ``rotary`` in N m, ``point`` per unit mass.
        coordinates: states that are its generalised position, for effects that are forces.
        rates: states that are their rates, in the same order.
        levels: states that are stores, such as a tank's level, which may spill over; each is a
            channel, too.

    Raises:
        InputError: the declaration contradicts itself.
    """

    system = OwnSystem
    own_engine = True
    time_step: ClassVar[float] = 1 / 240
    kind: ClassVar[Kind] = "linear"
    coordinates: ClassVar[tuple[str, ...]] = ()
    rates: ClassVar[tuple[str, ...]] = ()
    levels: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        _check(cls)
        forced = {*cls.coordinates, *cls.rates}
        # Whatever else has a start travels with the rates, since an engine hands on two vectors.
        others = [name for name in cls.states if name not in forced]
        summary = " ".join((cls.__doc__ or cls.says).split("\n\n")[0].split())
        shared = ("name", "parameters", "channels", "constants", "inputs", "states")
        declared = {
            **{name: getattr(cls, name) for name in shared},
            "says": cls.__dict__.get("says") or summary,
            "kind": cls.kind,
            "coordinates": cls.coordinates,
            "rates": (*cls.rates, *others),
            "levels": cls.levels,
            "sensed": tuple(c.name for c in cls.channels),
            "simulator": cls,
        }
        # A system for each simulator: effects ask the class, not an instance, what it can have.
        system: Any = type(f"{cls.__name__}System", (OwnSystem,), declared)
        cls.system = system
        super().__init_subclass__(**kwargs)

    def __setattr__(self, name: str, value: object) -> None:
        # A user's `self.engine = ...` would otherwise break the base class far from its cause.
        if name in _TAKEN and name in self.__dict__:
            raise InputError(
                f"simulator {self.name}: the attribute '{name}' is the base class's; name yours"
                " otherwise"
            )
        super().__setattr__(name, value)

    @abstractmethod
    def reset(
        self,
        theta: Mapping[str, float],
        constants: Mapping[str, float],
        initial: Mapping[str, float],
    ) -> None:
        """Start a run: parameters, constants and initial state by name.

        It must set all that a run may have changed, so that a run depends on nothing before it.
        """

    @abstractmethod
    def step(self, inputs: Mapping[str, float], seconds: float) -> None:
        """Go on by `seconds` with these inputs."""

    @abstractmethod
    def observe(self) -> Mapping[str, float]:
        """What the sensors give now, at least every channel; for force effects the coordinates and
        rates as well.
        """

    def apply_force(self, force: Array) -> None:
        """Optional: add a generalised force to the next step, and to that step alone.

        Args:
            force: (D,) one value for each coordinate: N, N m, or m/s^2 for ``point``.
        """
        raise NotImplementedError

    def inertia(self) -> float | Array:
        """Optional: return the generalised inertia now, which dry friction needs to hold still.

        Returns:
            The inertia matrix (D, D) of the coordinates, or a number where every coordinate has
            the same inertia and none acts on another; kg, kg m^2, or 1 for ``point``.
        """
        raise NotImplementedError

    def put(self, levels: Mapping[str, float]) -> None:
        """Optional: give these levels these values and go on from there; the others stay."""
        raise NotImplementedError

    def _engine(self, name: str | None, settings: Mapping[str, Any]) -> Engine:
        if name is not None:
            raise InputError(f"simulator {self.name} steps itself; it has no engine '{name}'")
        step = dict(settings).pop("time_step", self.time_step)
        if extra := [key for key in settings if key != "time_step"]:
            raise InputError(
                f"simulator {self.name} has no setting '{extra[0]}'; there is: time_step"
            )
        if not (is_number(step) and step > 0):
            found = cut(str(step))
            raise InputError(f"time_step must be a positive number of seconds, found {found}")
        return OwnEngine(self, step)

    def close(self) -> None:
        """Give back what the simulator holds."""


_TAKEN = ("channels", "columns", "constant_values", "effects", "engine", "fixed", "parameters")
"""Attributes that are set once, by the base classes."""


def _check(cls: type[OwnSimulator]) -> None:
    if not isinstance(getattr(cls, "name", None), str) or cls.name == OwnSystem.name:
        raise InputError(f'class {cls.__name__}: expected name = "..."')
    if not cls.channels or not cls.parameters:
        raise InputError(f"simulator {cls.name}: expected at least one parameter and one channel")
    if cls.kind not in KINDS:
        kinds = ", ".join(KINDS)
        raise InputError(f"simulator {cls.name}: kind: expected {kinds}, found {cls.kind!r:.40}")
    if len(cls.coordinates) != len(cls.rates):
        raise InputError(
            f"simulator {cls.name}: expected a rate for each of {cls.coordinates}, found"
            f" {cls.rates}"
        )
    for name in (*cls.coordinates, *cls.rates):
        if name not in cls.states:
            known = ", ".join(cls.states) or "(none)"
            raise InputError(f"simulator {cls.name}: {name} is not among its states {known}")
    shown = [c.name for c in cls.channels]
    for name in cls.levels:
        if name not in cls.states or name not in shown:
            raise InputError(f"simulator {cls.name}: level {name} must be a state and a channel")


class BulletWorld:
    """A world in PyBullet, whose functions are its methods; it prints nothing and ends with its
    last reference.
    """

    def __init__(self) -> None:
        self._engine = engine()
        self._client: int = self._engine.connect(self._engine.DIRECT)
        # Not `__del__`, which may run when the interpreter has lost the module already.
        weakref.finalize(self, self._engine.disconnect, self._client)

    def __getattr__(self, name: str) -> Any:
        member = getattr(self._engine, name)  # a function, or a constant such as JOINT_REVOLUTE
        return partial(member, physicsClientId=self._client) if callable(member) else member
