"""Base class of user-defined simulators in PyBullet, MuJoCo or any other engine.

Subclass `OwnSimulator`, declare its attributes, and implement `reset`, `step` and `observe`; see
docs/own-simulator.md. `OwnSimulatorEngine` steps such a simulator, and applies effects to it.
Effects on inputs and sensors are supported for any simulator. Forces need the method `apply_force`,
limits of levels need `put`, and dry friction also needs `inertia`.

Dry friction is the force that would stop the motion within the next step of length h, up to
its limit L. With the inertia matrix M (D, D), the velocity v (D,), the forces F (D,) of
effects and the simulator's own force P, which is unknown and estimated from the previous step,

    P = M (v - v_before) / h_before - F_before                             (1)
    S = -(M v / h + P + F)                                                 (2)
    friction = S where |S| <= L, else L S / |S|                            (3)
"""

from __future__ import annotations

import sys
import traceback
import weakref
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from sims.core.argument_checks import check_positive
from sims.core.effect import Contact, Effect, Force, Friction, HiddenStateEffect, Level
from sims.core.engine import Engine, IntegrationBatch, Trajectories
from sims.core.simulator import Array, InputError
from sims.core.system import SYSTEM_KINDS, StateSnapshot, System, SystemKind
from sims.effects.state_limits import find_level_effect, make_level_effects
from sims.engines.external.bullet_world import import_pybullet
from sims.engines.time_grid import equalise_steps
from sims.system_simulator import SystemSimulator

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


class OwnSimulatorEngine:
    """Engine that steps a user-defined simulator, one batch element after another."""

    name = "own"

    def __init__(self, world: OwnSimulator, step: float) -> None:
        self.world = world
        self.largest_step = float(step)

    def close(self) -> None:
        """Do nothing, because there are no resources."""

    def integrate(self, batch: IntegrationBatch) -> Trajectories:
        """Return readings (L, R, C) of all channels, in place of positions and their derivatives.

        There is one row before the first step, and one after each `batch.steps_per_sample` steps.
        An element with a number that is not finite is all NaN. Positions, velocities and
        accelerations are the same array: the system reads only the first.

        Shapes: L batch elements, R rows, C channels.

        Args:
            batch: Batch of the system that was made from the user's class.

        Raises:
            InputError: A method of the simulator raised an exception or returned a wrong value.
        """
        count = batch.steps.shape[1] // batch.steps_per_sample + 1
        width = len(batch.system.channels)
        shape = len(batch.theta), count, width
        readings = np.full(shape, np.nan)
        for element in range(len(batch.theta)):
            try:
                rows = self._run(batch.select(np.array([element])))
            except InputError:
                raise
            except Exception as error:
                raise _make_simulator_error(self.world, error) from error
            if rows is not None and np.isfinite(rows).all():
                readings[element] = rows
        return Trajectories(readings, readings, readings)

    def _run(self, batch: IntegrationBatch) -> Array | None:
        """Simulate one batch element with the user's simulator.

        Before each step the forces of effects are applied. After it, effects limit the levels, such
        as that of a tank, which overflows at its rim.

        Args:
            batch: Batch of this element alone.

        Returns:
            (N, C) N readings of C channels, at the start and after each `steps_per_sample` steps.
            None if a parameter, constant or initial state is not finite.
        """
        system = batch.system
        world = self.world
        # The arrays of this batch have one row, that of its only element.
        names = [p.name for p in system.parameters]
        theta = dict(zip(names, batch.theta[0].tolist(), strict=True))
        constants = {name: float(value[0, 0]) for name, value in batch.constants.items()}
        states = (*system.coordinates, *system.rates)
        start = [*batch.x[0].tolist(), *batch.v[0].tolist()]
        initial = dict(zip(states, start, strict=True))
        # Never pass NaN to a user's model: it may hang or never recover.
        arguments = [*theta.values(), *constants.values(), *initial.values()]
        if not np.isfinite(arguments).all():
            return None
        world.reset(theta, constants, initial)
        forces = _Forces(batch, world)
        level_limits = _LevelLimits(batch, world)
        level_limits.keep()
        steps = batch.steps[0].copy()
        # Steps of zero length, in which this batch element waits for others, are skipped.
        moving = steps > 0
        steps[moving] = equalise_steps(steps[moving], batch.steps_per_sample)
        sample = self._row(system)
        time = 0.0
        has_moved = False  # whether a step was made after the last reading
        samples = [sample]
        for step_index, seconds in enumerate(steps.tolist()):
            if seconds > 0:
                inputs = {name: float(u[0, step_index]) for name, u in batch.inputs.items()}
                if forces.acts:
                    world.apply_force(forces.at(time, inputs, seconds))
                world.step(inputs, seconds)
                level_limits.keep()
                time = time + seconds
                has_moved = True
            # Without a step, the previous row is still valid.
            if (step_index + 1) % batch.steps_per_sample == 0:
                sample = self._row(system) if has_moved else sample
                has_moved = False
                samples.append(sample)
        return np.array(samples)

    def _row(self, system: System) -> list[float]:
        """Return the present reading of each channel of the user's simulator."""
        observation = self.world.observe()
        return [get_observed_value(self.world, observation, c.name) for c in system.channels]


class _LevelLimits:
    """Limits of the levels of one batch element."""

    def __init__(self, batch: IntegrationBatch, world: OwnSimulator) -> None:
        """Select the effects that limit a level of this element, with coefficients (K, 1, 1).

        An effect without a place limits the first level of the system.

        Shapes: K coefficients.

        Args:
            batch: Batch of this element alone.
            world: Simulator whose levels are limited.
        """
        self.acting = [
            (effect, c, effect.place or batch.system.levels[0])
            for effect, c in batch.effects
            if isinstance(effect, Level) and c.any()
        ]
        self.world = world

    def keep(self) -> None:
        """Limit the levels after a step, such as that of a tank which overflows at its rim."""
        if not self.acting:
            return
        observation = self.world.observe()
        for effect, c, name in self.acting:
            level = np.array([[get_observed_value(self.world, observation, name)]])
            limited_level = float(effect.keep(c, level)[0, 0])
            if limited_level != level[0, 0]:
                self.world.put({name: limited_level})


class _Forces:
    """Forces of the effects on one batch element."""

    def __init__(self, batch: IntegrationBatch, world: OwnSimulator) -> None:
        """Select the forces and dry frictions of this element, with coefficients (K, 1, 1).

        `_last_step` holds velocity, forces and length (s) of the previous step, from which the
        simulator's own force is estimated; it is None before the first step.

        Args:
            batch: Batch of this element alone, with effects of K coefficients each.
            world: Simulator to which the forces are applied.
        """
        active_effects = [(effect, c) for effect, c in batch.effects if c.any()]
        self.forces = [(effect, c) for effect, c in active_effects if isinstance(effect, Force)]
        self.frictions = [
            (effect, c) for effect, c in active_effects if isinstance(effect, Friction)
        ]
        self.acts = bool(self.forces or self.frictions)
        self.world = world
        self.batch = batch
        self._last_step: tuple[Array, Array, float] | None = None

    def at(self, t: float, inputs: Mapping[str, float], seconds: float) -> Array:
        """Return the sum (D,) of the effects' forces for the next step of the user's simulator.

        Friction is added last, since it must know the other forces to hold a resting coordinate.

        Shapes: D coordinates.

        Args:
            t: Time since the start of the run, s.
            inputs: Inputs by name.
            seconds: Length of the step, s.
        """
        # The arrays of one element have a single row, hence (1, D) here and [0] below.
        observation = self.world.observe()
        x = self._read_state(observation, self.world.coordinates)
        v = self._read_state(observation, self.world.rates)
        applied_inputs = {name: np.array([[value]]) for name, value in inputs.items()}
        time = np.array([[t]])
        system, theta, constants = self.batch.system, self.batch.theta, self.batch.constants
        moment = StateSnapshot(system, theta, constants, time, x, v, applied_inputs)
        force = np.zeros(x.shape[1])
        for effect, c in self.forces:
            force = force + effect.force(c, moment)[0]
        if self.frictions:
            force = force + self._compute_friction(moment, force, seconds)
        return force

    def _compute_friction(self, moment: StateSnapshot, force: Array, seconds: float) -> Array:
        """Return the force (D,) that stops the motion within the step, up to the limit L.

        With the inertia M, the velocity v, the step h and the other effects' forces F: the
        simulator's own force is estimated from the last step, P = M (v - v_before) / h_before -
        F_before (1), zero in the first step. The stopping force is S = -(M v / h + P + F) (2), and
        friction is S where |S| <= L, else L S / |S| (3).

        Shapes: D coordinates.

        Args:
            moment: state of the simulator.
            force: (D,) sum of the other effects' forces.
            seconds: length of the step, s.
        """
        inertia = get_checked_inertia(self.world)
        v = moment.v[0]
        own_force = np.zeros_like(force)
        if self._last_step is not None:
            last_velocity, applied, last_seconds = self._last_step
            own_force = np.dot(inertia, v - last_velocity) / last_seconds - applied  # (1)
        limit = sum(float(effect.limit(c, moment)[0, 0]) for effect, c in self.frictions)
        stop = -(np.dot(inertia, v) / seconds + own_force + force)  # (2)
        size = float(np.linalg.norm(stop))
        friction: Array = stop if size <= limit else stop * (limit / size)  # (3)
        self._last_step = v, force + friction, seconds
        return friction

    def _read_state(self, observation: Mapping[str, float], names: Sequence[str]) -> Array:
        """Return numbers of an observation as an array (1, D).

        Shapes: D coordinates.

        Args:
            observation: what `observe` returned.
            names: names of the numbers.
        """
        values = [get_observed_value(self.world, observation, name) for name in names]
        state: Array = np.array([values])
        return state


def get_checked_inertia(simulator: OwnSimulator) -> float | Array:
    """Return the current generalised inertia of a simulator, after checking its shape.

    A user wrote the simulator, so its method `inertia` may return anything. The inertia is needed
    to find the dry friction that stops the motion in the next step.

    Shapes: D generalised coordinates.

    Returns:
        A number, which applies to every coordinate, or a matrix (D, D).

    Raises:
        InputError: `inertia` returned neither.
    """
    inertia = simulator.inertia()
    if isinstance(inertia, float):
        return float(inertia)
    coordinate_count = len(simulator.coordinates)
    try:
        matrix = np.asarray(inertia, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"simulator {simulator.name}: inertia: expected numbers; {error}"
        ) from None
    if not matrix.shape:
        return float(matrix)
    if matrix.shape == (coordinate_count, coordinate_count):
        return matrix
    coordinates = ", ".join(simulator.coordinates)
    raise InputError(
        f"simulator {simulator.name}: inertia: expected shape "
        f"{(coordinate_count, coordinate_count)} (coordinates × coordinates; here: "
        f"{coordinates}) or a number, found {matrix.shape}"
    )


def _make_simulator_error(world: OwnSimulator, error: Exception) -> InputError:
    """Make the error for an exception in the simulator's code, with its line.

    Args:
        world: simulator that a user has written, stepped in time.
        error: the exception.
    """
    # Prefer the last line in the user's own file to one in a library that it calls.
    frames = traceback.extract_tb(error.__traceback__)
    module = sys.modules.get(type(world).__module__)
    module_frames = [
        frame for frame in frames if frame.filename == getattr(module, "__file__", None)
    ]
    frame = (module_frames or list(frames))[-1]  # the innermost call is the last one
    description = f"{type(error).__name__}: {error}"
    location = f"{Path(frame.filename).name}, line {frame.lineno}, in {frame.name}"
    return InputError(f"simulator {world.name}: {description} ({location})")


def get_observed_value(world: OwnSimulator, observation: Mapping[str, float], name: str) -> float:
    """Return one number from what the user's `observe` returned, checked.

    Args:
        world: Simulator.
        observation: Result of its `observe`.
        name: Name of a channel, coordinate, rate or level.

    Raises:
        InputError: The value is missing, or not a number.
    """
    try:
        value = observation[name]
    except (KeyError, TypeError, IndexError):
        raise _make_unobserved_error(world, observation, name) from None
    if isinstance(value, float):  # shortcut (NumPy floats, too), because the general test is slow
        return float(value)
    if shape := np.shape(value):
        raise InputError(
            f"simulator {world.name}: observe(), {name}: expected a number, found shape {shape}"
        )
    try:
        return float(value)
    except (TypeError, ValueError):
        raise InputError(
            f"simulator {world.name}: observe(), {name}: expected a number, found {value!r:.40}"
        ) from None


def _make_unobserved_error(world: OwnSimulator, observation: object, name: str) -> InputError:
    """Make the error for a value that `observe` did not return.

    Args:
        world: simulator that a user has written, stepped in time.
        observation: what `observe` returned.
        name: name of the value.
    """
    if not isinstance(observation, Mapping):
        type_name = type(observation).__name__
        return InputError(
            f"simulator {world.name}: observe(): expected a dictionary, found {type_name}"
        )
    return InputError(
        f"simulator {world.name}: observe() gave no '{name}'; it gave: {', '.join(observation)}"
    )


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
