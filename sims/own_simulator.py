"""Base class of user-defined simulators in PyBullet, MuJoCo or any other engine.

Subclass `OwnSimulator`, declare its attributes, and implement `reset`, `step` and `observe`; see
docs/own-simulator.md. Effects on inputs and sensors are then supported as for any simulator; forces
and dry friction are supported if it implements `apply_force` and `inertia`.
"""

from __future__ import annotations

import weakref
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np

from sims.core.argument_checks import check_positive
from sims.core.effect import Contact, Effect, Force, Friction, HiddenStateEffect, Level
from sims.core.engine import Engine
from sims.core.simulator import Array, InputError
from sims.core.system import SYSTEM_KINDS, StateSnapshot, System, SystemKind
from sims.effects.state_limits import find_level_effect, make_level_effects
from sims.engines.external.bullet_world import import_pybullet
from sims.own_simulator_engine import OwnSimulatorEngine
from sims.system_simulator import SystemSimulator


class OwnSimulatorSystem(System):
    """System of a user-defined simulator, made from its class attributes."""

    name = "own"
    says = "a user's own simulator"
    kind: ClassVar[SystemKind] = "linear"
    simulator: ClassVar[type[OwnSimulator]]

    @classmethod
    def placed(cls, effect: type[Effect]) -> Sequence[type[Effect]]:
        """Return an effect on levels once for each level, and any other effect unchanged."""
        if issubclass(effect, Level) and not effect.misses(cls):
            return make_level_effects(effect, cls)
        return super().placed(effect)

    @classmethod
    def effect(cls, name: str) -> type[Effect] | None:
        """Return the effect with a name such as ``state.overflow@upper``; None if there is none."""
        return find_level_effect(name, cls)

    @classmethod
    def refuses(cls, effect: type[Effect]) -> str:
        """Return why the simulator cannot have an effect; empty if it can.

        Forces need the method `apply_force`, dry friction also needs `inertia`, levels need `put`;
        effects on impacts and hidden-state effects are not possible.
        """
        if issubclass(effect, Contact):
            return "an own simulator does not report contacts"
        if issubclass(effect, Level) and cls.simulator.put is OwnSimulator.put:
            return "its levels cannot be set (it has no method put)"
        if issubclass(effect, HiddenStateEffect):
            return "an own simulator takes forces, but no additional states"
        if not issubclass(effect, Force | Friction):  # an effect on an input, a sensor or a level
            return ""
        if cls.simulator.apply_force is OwnSimulator.apply_force:
            return "it takes no forces (it has no method apply_force)"
        if issubclass(effect, Friction) and cls.simulator.inertia is OwnSimulator.inertia:
            return "it does not define its inertia (it has no method inertia)"
        try:
            _evaluate_once(effect, cls)
        except _NotDeclaredError as reason:
            return str(reason)
        return ""

    def mass(self, theta: Array, constants: Mapping[str, Array]) -> Array:
        """Raise an error, because the mass is unknown outside the simulator.

        Args:
            theta: unused.
            constants: unused.
        """
        raise _NotDeclaredError("it does not define its mass")

    def weight(self, moment: StateSnapshot) -> Array:
        """Raise an error, because gravity is unknown outside the simulator."""
        raise _NotDeclaredError("it does not define the effect of gravity")

    def drive(self, moment: StateSnapshot) -> Array:
        """Raise an error, because the effect of inputs is unknown outside the simulator."""
        raise _NotDeclaredError("it does not define the effect of its inputs")

    def observe(
        self, x: Array, v: Array, a: Array, constants: Mapping[str, Array]
    ) -> dict[str, Array]:
        """Return the channels, which are the motion that a user-defined simulator returns.

        Shapes: L batch elements, T samples, C channels.

        Args:
            x: (L, T, C) values of the channels.
            v: unused.
            a: unused.
            constants: unused.
        """
        return {c.name: x[:, :, i] for i, c in enumerate(self.channels)}


class _NotDeclaredError(InputError):
    """Error for a quantity that an effect needs and the simulator does not provide."""


def _evaluate_once(effect: type[Effect], system: type[OwnSimulatorSystem]) -> None:
    """Evaluate an effect once, which fails if the system lacks a quantity that it needs.

    So a missing quantity is reported before a simulation starts.

    Args:
        effect: Force or dry friction.
        system: System of the user's simulator.

    Raises:
        _NotDeclaredError: The effect uses a mass, gravity or drive that the system does not define.
    """
    # Coefficients, positions and inputs are zero: only whether they exist matters, not the result.
    ones = np.ones((1, 1))
    d = len(system.coordinates)
    constants = {c.name: c.value * ones for c in system.constants}
    inputs = {c.name: 0.0 * ones for c in system.inputs}
    theta = np.array([[p.nominal for p in system.parameters]])
    zeros = np.zeros((1, d))
    moment = StateSnapshot(system(), theta, constants, 0 * ones, zeros, zeros, inputs)
    c = np.zeros((len(effect.coefficients), 1, 1))
    if issubclass(effect, Force):
        effect().force(c, moment)
    elif issubclass(effect, Friction):
        effect().limit(c, moment)


class OwnSimulator(SystemSimulator):
    """Base class of a user-defined simulator.

    Declare the attributes of `Simulator` (name, says, parameters, channels, constants, inputs,
    states, requires), then those below where they apply, and implement `reset`, `step` and
    `observe`.

    Attributes:
        time_step: Maximum step, s; `step` is called with this or less, so that each sample time is
            reached exactly.
        kind: Unit of forces: ``linear`` in N, ``rotary`` in N m, ``point`` per unit mass.
        coordinates: States that are the generalised position, for effects that are forces.
        rates: States that are the rates of the coordinates, in the same order.
        levels: States that are stored quantities, such as a tank's level, which may overflow; each
            is also a channel.

    Raises:
        InputError: The declaration is contradictory.
    """

    system = OwnSimulatorSystem
    own_engine = True
    time_step: ClassVar[float] = 1 / 240
    kind: ClassVar[SystemKind] = "linear"
    coordinates: ClassVar[tuple[str, ...]] = ()
    rates: ClassVar[tuple[str, ...]] = ()
    levels: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Check a user's class, and make a system from its declaration.

        Engines and effects work with systems, so the system describes the simulator to
        them. The first paragraph of the class docstring is its description, unless it states
        `says`.
        """
        _check_declaration(cls)
        # States that are positions or velocities.
        motion_states = {*cls.coordinates, *cls.rates}
        # Engines pass two vectors of states only, positions and rates: others follow the rates.
        other_states = [name for name in cls.states if name not in motion_states]
        summary = " ".join((cls.__doc__ or cls.says).split("\n\n")[0].split())
        shared = ("name", "parameters", "channels", "constants", "inputs", "states")
        attributes = {
            **{name: getattr(cls, name) for name in shared},
            "says": cls.__dict__.get("says") or summary,
            "kind": cls.kind,
            "coordinates": cls.coordinates,
            "rates": (*cls.rates, *other_states),
            "levels": cls.levels,
            "sensed": tuple(c.name for c in cls.channels),
            "simulator": cls,
        }
        # Each simulator has its own system class: effects query the class, not an instance.
        system: Any = type(f"{cls.__name__}System", (OwnSimulatorSystem,), attributes)
        cls.system = system
        super().__init_subclass__(**kwargs)

    def __setattr__(self, name: str, value: object) -> None:
        """Set an attribute, unless the base class already uses this name.

        Args:
            name: name of the attribute.
            value: its value.

        Raises:
            InputError: the name is taken.
        """
        # Otherwise a user's `self.engine = ...` would break the base class far from its cause. Each
        # of these attributes is set once.
        if name in _RESERVED_ATTRIBUTES and name in self.__dict__:
            raise InputError(
                f"simulator {self.name}: the attribute '{name}' belongs to the base class;"
                " rename yours"
            )
        super().__setattr__(name, value)

    @abstractmethod
    def reset(
        self,
        theta: Mapping[str, float],
        constants: Mapping[str, float],
        initial: Mapping[str, float],
    ) -> None:
        """Start a run.

        All that an earlier run may have changed must be set, so that runs are independent.

        Args:
            theta: Parameters by name.
            constants: Constants by name.
            initial: Initial state by name.
        """

    @abstractmethod
    def step(self, inputs: Mapping[str, float], seconds: float) -> None:
        """Advance the simulation.

        Args:
            inputs: Inputs by name, constant during the step.
            seconds: Length of the step, s.
        """

    @abstractmethod
    def observe(self) -> Mapping[str, float]:
        """Return the current sensor values by name.

        They must include every channel; for effects that are forces, also the coordinates and
        rates.
        """

    def apply_force(self, force: Array) -> None:
        """Add a generalised force to the next step only (optional).

        Args:
            force: (D,) one value for each coordinate: N, N m, or m/s^2 for ``point``.
        """
        raise NotImplementedError

    def inertia(self) -> float | Array:
        """Return the current generalised inertia, which dry friction needs (optional).

        Returns:
            The inertia matrix (D, D) of the coordinates, or a number if all coordinates have the
            same inertia and are not coupled; kg, kg m^2, or 1 for ``point``.
        """
        raise NotImplementedError

    def put(self, levels: Mapping[str, float]) -> None:
        """Set some levels to new values and continue from there; other states stay (optional)."""
        raise NotImplementedError

    def _make_engine(self, name: str | None, settings: Mapping[str, Any]) -> Engine:
        """Return the engine that calls the user's `step`, with the given or declared time step.

        Args:
            name: name of an engine; only None is possible.
            settings: settings by name; ``time_step`` in seconds is the only one.

        Raises:
            InputError: an engine is named, or a setting is unknown or not positive.
        """
        if name is not None:
            raise InputError(f"simulator {self.name} steps itself; it has no engine '{name}'")
        step = dict(settings).pop("time_step", self.time_step)
        if extra := [key for key in settings if key != "time_step"]:
            raise InputError(
                f"simulator {self.name} has no setting '{extra[0]}'; there is: time_step"
            )
        return OwnSimulatorEngine(self, check_positive("time_step", step))

    def close(self) -> None:
        """Release resources of the simulator."""


_RESERVED_ATTRIBUTES = (
    "channels",
    "columns",
    "constant_values",
    "effects",
    "engine",
    "fixed",
    "parameters",
)
"""Attributes that are set once, by the base classes."""


def _check_declaration(cls: type[OwnSimulator]) -> None:
    """Check the declaration of a user's simulator when its class is created.

    Raises:
        InputError: the declaration is incomplete or contradictory; the message names the fault.
    """
    if not isinstance(getattr(cls, "name", None), str) or cls.name == OwnSimulatorSystem.name:
        raise InputError(f'class {cls.__name__}: expected name = "..."')
    if not cls.channels or not cls.parameters:
        raise InputError(f"simulator {cls.name}: expected at least one parameter and one channel")
    if cls.kind not in SYSTEM_KINDS:
        kinds = ", ".join(SYSTEM_KINDS)
        raise InputError(f"simulator {cls.name}: kind: expected {kinds}, found {cls.kind!r:.40}")
    if len(cls.coordinates) != len(cls.rates):
        raise InputError(
            f"simulator {cls.name}: expected a rate for each of {cls.coordinates}, found"
            f" {cls.rates}"
        )
    for name in (*cls.coordinates, *cls.rates):
        if name not in cls.states:
            state_names = ", ".join(cls.states) or "(none)"
            raise InputError(f"simulator {cls.name}: {name} is not among its states {state_names}")
    channel_names = [c.name for c in cls.channels]
    for name in cls.levels:
        if name not in cls.states or name not in channel_names:
            raise InputError(f"simulator {cls.name}: level {name} must be a state and a channel")


class BulletWorld:
    """PyBullet world with the functions of ``pybullet`` as methods.

    It prints nothing, and is disconnected when its last reference is deleted.
    """

    def __init__(self) -> None:
        """Connect to a new Bullet world without a window."""
        self._engine = import_pybullet()
        self._client: int = self._engine.connect(self._engine.DIRECT)
        # Not `__del__`, which may run after the interpreter has unloaded the module.
        weakref.finalize(self, self._engine.disconnect, self._client)

    def __getattr__(self, name: str) -> Any:
        member = getattr(self._engine, name)  # a function, or a constant such as JOINT_REVOLUTE
        return partial(member, physicsClientId=self._client) if callable(member) else member
