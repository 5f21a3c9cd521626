"""Engine that steps a user-defined simulator and applies effects to it and to its levels.

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
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from sims.core.effect import Force, Friction, Level
from sims.core.engine import IntegrationBatch, Trajectories
from sims.core.simulator import Array, InputError
from sims.core.system import StateSnapshot, System
from sims.engines.time_grid import equalise_steps


class SteppableSimulator(Protocol):
    """Protocol of a steppable simulator; `own_simulator.OwnSimulator` describes the methods."""

    @property
    def name(self) -> str: ...

    @property
    def coordinates(self) -> tuple[str, ...]: ...

    @property
    def rates(self) -> tuple[str, ...]: ...

    def reset(
        self,
        theta: Mapping[str, float],
        constants: Mapping[str, float],
        initial: Mapping[str, float],
    ) -> None:
        """Start a run in the given initial state; see `own_simulator.OwnSimulator.reset`.

        Args:
            theta: parameters by name.
            constants: constants by name.
            initial: initial states by name.
        """
        ...

    def step(self, inputs: Mapping[str, float], seconds: float) -> None: ...

    def observe(self) -> Mapping[str, float]: ...

    def apply_force(self, force: Array) -> None: ...

    def inertia(self) -> float | Array: ...

    def put(self, levels: Mapping[str, float]) -> None: ...


class OwnSimulatorEngine:
    """Engine that steps a user-defined simulator, one batch element after another."""

    name = "own"

    def __init__(self, world: SteppableSimulator, step: float) -> None:
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
            (N, C) readings of C channels, at the start and after each `steps_per_sample` steps.
            None if a parameter, constant or initial state is not finite.
        """
        system = batch.system
        world = self.world
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
        has_moved = False
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
        return [observed(self.world, observation, c.name) for c in system.channels]


def _make_simulator_error(world: SteppableSimulator, error: Exception) -> InputError:
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
    frame = (module_frames or list(frames))[-1]
    description = f"{type(error).__name__}: {error}"
    location = f"{Path(frame.filename).name}, line {frame.lineno}, in {frame.name}"
    return InputError(f"simulator {world.name}: {description} ({location})")


def observed(world: SteppableSimulator, observation: Mapping[str, float], name: str) -> float:
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


def _make_unobserved_error(world: SteppableSimulator, observation: object, name: str) -> InputError:
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


def get_checked_inertia(simulator: SteppableSimulator) -> float | Array:
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


class _LevelLimits:
    """Limits of the levels of one batch element."""

    def __init__(self, batch: IntegrationBatch, world: SteppableSimulator) -> None:
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
            level = np.array([[observed(self.world, observation, name)]])
            limited_level = float(effect.keep(c, level)[0, 0])
            if limited_level != level[0, 0]:
                self.world.put({name: limited_level})


class _Forces:
    """Forces of the effects on one batch element."""

    def __init__(self, batch: IntegrationBatch, world: SteppableSimulator) -> None:
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
        values = [observed(self.world, observation, name) for name in names]
        state: Array = np.array([values])
        return state
