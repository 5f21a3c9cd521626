"""Simulator composed of a system, an engine and effects, which any tuner can tune."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from sims import effects as library
from sims.core.effect import (
    ActiveEffects,
    Contact,
    Effect,
    Force,
    Friction,
    HiddenStateEffect,
    Input,
    Level,
    Sensor,
    make_effect_parameters,
)
from sims.core.engine import Engine, IntegrationBatch, Trajectories
from sims.core.simulation_counter import SIMULATION_COUNTER
from sims.core.simulator import Array, Indices, InputError, Parameter, Scenario, Simulator
from sims.core.system import System
from sims.core.toml_validation import format_value
from sims.effects.coefficient_validation import (
    check_coefficient_sizes,
    check_effect_types,
    read_coefficients,
)
from sims.effects.sensor_effects import apply_sensor_effects, needs_every_step
from sims.engines.engine_lookup import HIDDEN_STATE_ENGINES, make_engine
from sims.engines.scenario_groups import ScenarioGroups, group_by_identity, group_scenarios
from sims.engines.step_inputs import compute_applied_inputs
from sims.engines.time_grid import Commands, TimeGrid, build_time_grid, shifts_time

MAX_STORED_TIME_GRIDS = 8
"""Maximum number of sets of scenarios whose steps and inputs are stored."""
MAX_STORED_NUMBERS = 2_000_000
"""Maximum number of steps, and of each input's values, of a set that is stored (16 MB)."""
_StepsAndInputs = tuple[TimeGrid, dict[str, Array]]
"""Time grid, and applied inputs (L, S) by name."""


class SystemSimulator(Simulator):
    """Base class of the simulators of declared systems; a subclass sets `system`.

    Raises:
        InputError: A name is unknown, the system cannot have an effect, or the engine does not
            support it.
    """

    system: ClassVar[type[System]]
    default_engine: ClassVar[str] = "batch"
    own_engine: ClassVar[bool] = False
    """True if the simulator steps itself, so that no engine can be chosen."""

    def __init__(
        self,
        constants: Mapping[str, float] | None = None,
        observe: Sequence[str] | None = None,
        *,
        engine: str | None = None,
        effects: Sequence[str | type[Effect]] = (),
        fixed: Mapping[str, float | Sequence[float]] | None = None,
        **settings: Any,
    ) -> None:
        """Create engine and effects, and append the effects' coefficients to the parameters.

        Effects that are fitted (`effects`) have coefficients that vary between simulations of one
        batch; those of known effects (`fixed`) are the same in all.

        Args:
            constants: Values of `constants` that differ from their defaults.
            observe: Channels to return, in order (default: all).
            engine: Name of the engine: pybullet, mujoco or batch.
            effects: Effects whose coefficients are parameters after the system's own, in the order
                in which a signal passes them: registered names, or classes, which need not be
                registered.
            fixed: Effects with known coefficients: a number, or a list if an effect has several.
            settings: Settings of the engine, e.g. ``time_step``.

        Raises:
            InputError: A name is unknown, an effect is named twice or not possible, or a known
                coefficient is not plausible.
        """
        super().__init__(constants, observe)
        # Instance of the system; names and units are read from its class, `self.system`.
        self._declared_system = self.system()
        self._stored_steps: dict[tuple[object, ...], _StepsAndInputs] = {}
        self.engine = self._make_engine(engine, settings)
        check_effect_types(effects, fixed)
        self.effects = [self._effect(effect) for effect in effects]
        self.fixed = [
            (self._effect(name), read_coefficients(name, value))
            for name, value in (fixed or {}).items()
        ]
        effect_names = [effect.name for effect in self.effects]
        for name in effect_names:
            if name in (fixed or {}) or effect_names.count(name) > 1:
                raise InputError(f"effect {name} is named twice")
        for effect, values in self.fixed:
            names = [c.name for c in effect.on(self.system)]
            if not 1 <= len(values) <= len(names):
                raise InputError(
                    f"effect {effect.name}: expected up to {len(names)} values"
                    f" ({', '.join(names)}), found {format_value(values)}"
                )
            check_coefficient_sizes(effect, self.system, values)
        observed = [c.name for c in self.channels]
        extra: list[Parameter] = []
        for effect in self.effects:
            extra += make_effect_parameters(effect, self.system, observed)
        self.parameters = (*self.system.parameters, *extra)

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Copy the declaration of the system to the new simulator class."""
        super().__init_subclass__(**kwargs)
        # The declaration is copied from the system.
        system = cls.system
        cls.name = system.name
        cls.says = system.says
        cls.parameters = system.parameters
        cls.channels = system.channels
        cls.constants = system.constants
        cls.inputs = system.inputs
        cls.states = system.states

    def _make_engine(self, name: str | None, settings: Mapping[str, Any]) -> Engine:
        return make_engine(name or self.default_engine, self.system, settings)

    def _effect(self, named: str | type[Effect]) -> Effect:
        """Make an effect from its name or class, if the system and the engine support it.

        Raises:
            InputError: the effect is unknown or not supported; the message states the reason.
        """
        effect = library.find_effect(named, self.system) if isinstance(named, str) else named
        # Effects at a place of a robot are made by the system itself and need no check.
        if effect.of:
            return effect()
        if reason := effect.misses(self.system):
            raise InputError(
                f"system {self.system.name} cannot have effect {effect.name}: {reason}"
            )
        if issubclass(effect, HiddenStateEffect) and self.engine.name not in HIDDEN_STATE_ENGINES:
            raise InputError(
                f"engine {self.engine.name} cannot simulate effect {effect.name}, which has a"
                f" hidden state; choose engine {' or '.join(HIDDEN_STATE_ENGINES)}"
            )
        return effect()

    def simulate(self, theta: Array, scenario: Scenario) -> Array:
        """Simulate each parameter vector in one scenario; see `Simulator.simulate`.

        Shapes: n parameter vectors, T samples, C channels.

        Args:
            theta: Parameter vectors (n, dim), physical units.
            scenario: Conditions of the run.

        Returns:
            Observations (n, T, C), SI units.
        """
        return self.simulate_batch(theta, [scenario] * len(theta))

    def simulate_batch(
        self,
        theta: Array,
        scenarios: Sequence[Scenario],
        initial: Mapping[str, Array] | None = None,
    ) -> Array:
        """Simulate each parameter vector in its own scenario, all in one call of the engine.

        This is fastest if batch elements share scenario objects.

        Shapes: L batch elements, C channels.

        Args:
            theta: Parameter vectors (L, dim): physical parameters, then coefficients of effects.
            scenarios: Scenario of each batch element.
            initial: Initial states (L,) by name, which replace those of the scenarios.

        Returns:
            Observations (L, T, C), with T of the longest scenario; NaN after the end of a shorter
            one.

        Raises:
            InputError: A shape is wrong, or a scenario names a constant, input or state that the
                system does not have.
        """
        theta = np.asarray(theta, dtype=np.float64)
        expected = (len(scenarios), len(self.parameters))
        if theta.shape != expected:
            raise InputError(f"theta must have shape {expected}, found {theta.shape}")
        if not len(theta):
            return np.empty((0, 0, len(self.channels)))
        SIMULATION_COUNTER.count(len(theta))
        return self._simulate_observations(theta, scenarios, initial or {})

    def _simulate_observations(
        self, theta: Array, scenarios: Sequence[Scenario], initial: Mapping[str, Array]
    ) -> Array:
        """Simulate a batch of at least one element, from inputs to sensors.

        The steps are: time grid, effects on inputs, integration by the engine, effects on
        sensors.

        Shapes: L batch elements, P parameters, T samples, C channels.

        Args:
            theta: (L, P) parameters, including the effects' coefficients.
            scenarios: L scenarios, which may be the same object.
            initial: (L,) initial states that replace those of the scenarios, by name.

        Returns:
            (L, T, C) observations; NaN after the end of shorter runs and for failed elements.
        """
        active_effects = self._make_active_effects(theta)
        runs = group_scenarios(scenarios)  # scenarios with equal content count as one
        commands = [self.run_inputs(s) for s in runs.unique_scenarios]
        with np.errstate(all="ignore"):  # batch elements that overflow become NaN
            grid, inputs = self._compute_steps_and_inputs(
                runs, commands, _select_effects(active_effects, (Input, Sensor))
            )
            sensors = tuple(
                (effect, c) for effect, c in _select_effects(active_effects, Sensor) if c.any()
            )
            # A sensor filter needs the state after every step; other sensor effects need the states
            # at the samples only.
            is_filtered = any(needs_every_step(effect) for effect, _ in sensors)
            steps_per_state = 1 if is_filtered else grid.steps_per_sample
            base_theta = np.ascontiguousarray(theta[:, : len(self.system.parameters)])
            constants, x, v = self._collect_known_values(scenarios, initial)
            forces = _select_effects(
                active_effects, (Force, Friction, Contact, HiddenStateEffect, Level)
            )
            batch = IntegrationBatch(
                self._declared_system,
                base_theta,
                constants,
                x,
                v,
                grid.steps,
                inputs,
                forces,
                steps_per_state,
            )
            start_stamps = np.array([s.times[0] for s in runs.unique_scenarios])
            clock = start_stamps[runs.scenario_index, None]
            motion = self.engine.integrate(batch)
            observations = self._read(motion, batch, grid, sensors, clock)
        # Readings of a shorter run while it waits at its end are not samples.
        sizes = np.array([s.times.size for s in runs.unique_scenarios])
        if sizes.min() < sizes.max():
            observations[np.arange(sizes.max()) >= sizes[runs.scenario_index, None]] = np.nan
        return observations

    def _compute_steps_and_inputs(
        self, runs: ScenarioGroups, commands: Commands, acting: ActiveEffects
    ) -> _StepsAndInputs:
        """Return the time grid, and the applied inputs (L, S) by name.

        A search simulates the same runs thousands of times. Without effects on inputs and without
        shifts of time, steps and inputs depend only on the scenarios. Then they are computed once
        for each distinct scenario, stored, and repeated for its batch elements.

        Shapes: L batch elements, S steps.

        Args:
            runs: Scenarios of the batch elements.
            commands: Inputs of each distinct scenario.
            acting: Effects on inputs and sensors.
        """

        def compute(groups: ScenarioGroups, effects: ActiveEffects) -> _StepsAndInputs:
            grid = build_time_grid(groups, commands, effects, self.engine.largest_step)
            if not self.inputs:
                return grid, {}
            input_effects = _select_effects(effects, Input)
            return grid, compute_applied_inputs(grid, groups, commands, input_effects)

        has_effect = any(
            c.any() and (isinstance(effect, Input) or shifts_time(effect)) for effect, c in acting
        )
        has_shift = any(scenario.offset for scenario in runs.unique_scenarios)
        # `runs.contents`, the content of the distinct scenarios, is the key of the stored steps; it
        # is empty if unknown.
        if has_effect or has_shift or not runs.contents:
            return compute(runs, acting)
        stored = self._stored_steps.get(runs.contents)
        if stored is None:
            # `runs.one_each` has each distinct scenario once. Effects are left out, as none of them
            # acts here.
            grid, _ = stored = compute(runs.one_each, ())
            if len(self._stored_steps) >= MAX_STORED_TIME_GRIDS:  # the oldest makes room
                del self._stored_steps[next(iter(self._stored_steps))]
            if grid.steps.size <= MAX_STORED_NUMBERS:
                self._stored_steps[runs.contents] = stored
        grid, inputs = stored
        expanded_grid = replace(
            grid,
            steps=runs.expand_rows(grid.steps),
            ends=runs.expand_rows(grid.ends),
            rows=runs.expand_rows(grid.rows),
        )
        return expanded_grid, {name: runs.expand_rows(values) for name, values in inputs.items()}

    def close(self) -> None:
        """Release the resources of the engine."""
        self.engine.close()

    def _make_active_effects(self, theta: Array) -> ActiveEffects:
        """Return the effects with their coefficients (K, L, 1): tuned ones, then fixed ones.

        Coefficients that the system does not have, or that were not given, are zero.

        Shapes: L batch elements, K coefficients.
        """
        active_effects = []
        # The coefficients follow the parameters of the system.
        first = len(self.system.parameters)
        for effect in self.effects:
            count = len(effect.on(self.system))
            tuned = theta[:, first : first + count].T
            active_effects.append((effect, _expand_coefficients(effect, tuned)))
            first += count
        for effect, values in self.fixed:
            column = np.array(values)[:, None]
            repeated = np.repeat(column, len(theta), axis=1)
            active_effects.append((effect, _expand_coefficients(effect, repeated)))
        return tuple(active_effects)

    def _collect_known_values(
        self, scenarios: Sequence[Scenario], initial: Mapping[str, Array]
    ) -> tuple[dict[str, Array], Array, Array]:
        """Return constants (L, 1) by name, and initial positions and velocities (L, D).

        Shapes: D coordinates.

        Args:
            scenarios: scenario of each of L batch elements.
            initial: initial states (L,) by name, in place of those of the scenarios.
        """
        # Check each scenario object once, not each of hundreds of batch elements.
        distinct, object_index = group_by_identity(scenarios)
        run_constants = _expand_rows([self.run_constants(s) for s in distinct], object_index)
        constants = {name: values[:, None] for name, values in run_constants.items()}
        states = _expand_rows([self.run_initial(s) for s in distinct], object_index)
        states = self._check_values("initial state", states, initial)
        x = _stack_states(states, self.system.coordinates, object_index.size)
        v = _stack_states(states, self.system.rates, object_index.size)
        return constants, x, v

    def _read(
        self,
        motion: Trajectories,
        batch: IntegrationBatch,
        grid: TimeGrid,
        sensors: ActiveEffects,
        clock: Array,
    ) -> Array:
        """Return the sensor readings of a simulation, after the sensor effects.

        A gain or a bias changes one channel, the first observed one of the system's `sensed`. A
        filter changes all channels, and needs the state after every step of the integration.

        Shapes: L batch elements, T samples, C channels.

        Args:
            motion: Result of the engine.
            batch: Batch that the engine integrated.
            grid: Time grid.
            sensors: Active sensor effects.
            clock: (L, 1) first time stamp of each run, s.

        Returns:
            Observations (L, T, C).
        """
        channels = self._declared_system.observe(motion.x, motion.v, motion.a, batch.constants)
        names = [c.name for c in self.channels]
        affected_name = self.system.reading(names)
        times = grid.compute_state_times(batch.steps_per_sample)
        steps = np.diff(times, axis=1, prepend=0.0)
        # (L, T) numbers of the stored states at the samples. With a filter, a state is stored after
        # every step, so that the numbers of the grid are multiplied by the steps per sample.
        sample_rows = grid.rows * (grid.steps_per_sample // batch.steps_per_sample)
        observations = np.empty((*sample_rows.shape, len(names)))
        for column, name in enumerate(names):
            values = channels[name]
            acting = tuple(
                (e, c) for e, c in sensors if needs_every_step(e) or name == affected_name
            )
            if acting:
                values = apply_sensor_effects(acting, values, steps, times, clock)
            observations[:, :, column] = _select_rows(values, sample_rows)
        observations += 0.0  # turn negative zeros into positive ones
        return observations


def _select_rows(values: Array, rows: Indices) -> Array:
    """Return values[l, rows[l, t]], (L, T), of values (L, R) and rows (L, T).

    Shapes: L batch elements, R stored states, T samples.

    There is no copy if the first values are selected in order in all L batch elements.

    Args:
        values: (L, R) values of a channel in the stored states.
        rows: (L, T) number of the stored state of each sample. If all elements have the same, the
            rows share their memory (stride zero).
    """
    in_order = (rows[:1] == np.arange(rows.shape[1])).all()
    if in_order and (rows.strides[0] == 0 or (rows == rows[:1]).all()):
        return values[:, : rows.shape[1]]
    selected: Array = np.take_along_axis(values, rows, axis=1)
    return selected


def _expand_rows(rows: Sequence[Mapping[str, float]], index: Indices) -> dict[str, Array]:
    """Convert rows of numbers by name to one array per name, of the rows at `index` (L,)."""
    return {name: np.array([row[name] for row in rows])[index] for name in rows[0]}


def _stack_states(states: Mapping[str, Array], names: Sequence[str], count: int) -> Array:
    """Return the states with these names as columns, (L, D) for L = `count` batch elements."""
    if not names:
        return np.empty((count, 0))
    columns = [np.broadcast_to(states[name], (count,)) for name in names]
    result: Array = np.stack(columns, axis=1)
    return result


def _expand_coefficients(effect: Effect, values: Array) -> Array:
    """Extend coefficients of L batch elements to (K, L, 1), with zeros for missing ones.

    Args:
        effect: the effect, with K coefficients.
        values: (k, L) its first coefficients; a kind of system may lack the last ones.
    """
    count, batch_size = values.shape
    result = np.zeros((len(effect.coefficients), batch_size, 1))
    result[:count, :, 0] = values
    return result


def _select_effects(active_effects: ActiveEffects, kind: Any) -> ActiveEffects:
    return tuple((effect, c) for effect, c in active_effects if isinstance(effect, kind))
