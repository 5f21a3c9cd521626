"""A simulator made of a system, an engine and effects: again a simulator, which any tuner tunes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sims import effects as library
from sims.base import Array, InputError, Parameter, Scenario, Simulator
from sims.engines import HIDING, engine_named
from sims.engines.hidden import integrate
from sims.limits import is_number
from sims.plan import Plan, acts, by_object, felt_inputs, make_plan, make_runs
from sims.system import (
    Acting,
    Contact,
    Effect,
    Engine,
    Force,
    Friction,
    Hidden,
    Input,
    Lanes,
    Level,
    Motion,
    Sensor,
    Signal,
    System,
)
from sims.tally import TALLY
from sims.user_toml import shown

BEYOND = 1e6
"""Times its largest plausible value, a coefficient is a slip of the pen."""


class Simulated(Simulator):
    """Base of the simulators of declared systems; a subclass names its `system`.

    Args:
        constants: values for `constants` other than their defaults.
        observe: channels to return, in order (default: all).
        engine: pybullet, mujoco or batch.
        effects: effects whose coefficients are parameters, behind the system's own, in the order in
            which a signal passes them: registered names, or classes that need no registering.
        fixed: effects with known coefficients: a number, or a list where an effect has several.
        settings: the engine's own, e.g. ``time_step``.

    Raises:
        InputError: an unknown name, an effect that the system cannot have, an engine that cannot
            carry it.
    """

    system: ClassVar[type[System]]
    default_engine: ClassVar[str] = "batch"
    own_engine: ClassVar[bool] = False
    """Whether it steps itself, so that there is no engine to choose."""

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
        super().__init__(constants, observe)
        self._declared = self.system()
        self.engine = self._engine(engine, settings)
        _check_given(effects, fixed)
        self.effects = [self._effect(effect) for effect in effects]
        self.fixed = [
            (self._effect(name), _row(name, value)) for name, value in (fixed or {}).items()
        ]
        named = [effect.name for effect in self.effects]
        doubled = [name for name in named if name in (fixed or {}) or named.count(name) > 1]
        if doubled:
            raise InputError(f"effect {doubled[0]} is named twice")
        for effect, values in self.fixed:
            names = [c.name for c in effect.on(self.system)]
            if not 1 <= len(values) <= len(names):
                raise InputError(
                    f"effect {effect.name}: expected up to {len(names)} values"
                    f" ({', '.join(names)}), found {shown(values)}"
                )
            _check_sizes(effect, self.system, values)
        observed = [c.name for c in self.channels]
        extra: list[Parameter] = []
        for effect in self.effects:
            extra += effect_parameters(effect, self.system, observed)
        self.parameters = (*self.system.parameters, *extra)

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        # A simulator says what its system says: it is declared once.
        system = cls.system
        cls.name = system.name
        cls.says = system.says
        cls.parameters = system.parameters
        cls.channels = system.channels
        cls.constants = system.constants
        cls.inputs = system.inputs
        cls.states = system.states

    def _engine(self, name: str | None, settings: Mapping[str, Any]) -> Engine:
        return engine_named(name or self.default_engine, self.system, settings)

    def _effect(self, named: str | type[Effect]) -> Effect:
        effect = library.find(named, self.system) if isinstance(named, str) else named
        # An effect of a place is one that the system itself has made.
        if effect.of:
            return effect()
        if reason := effect.misses(self.system):
            raise InputError(
                f"system {self.system.name} cannot have effect {effect.name}: {reason}"
            )
        if issubclass(effect, Hidden) and self.engine.name not in HIDING:
            raise InputError(
                f"engine {self.engine.name} cannot carry effect {effect.name}, which has a state of"
                f" its own; choose engine {' or '.join(HIDING)}"
            )
        return effect()

    def simulate(self, theta: Array, scenario: Scenario) -> Array:
        """Simulate each row of `theta` (n, dim) in one scenario; returns (n, T, C). See
        `Simulator.simulate`.
        """
        return self.simulate_lanes(theta, [scenario] * len(theta))

    def simulate_lanes(
        self,
        theta: Array,
        scenarios: Sequence[Scenario],
        initial: Mapping[str, Array] | None = None,
    ) -> Array:
        """Simulate each row of `theta` (L, dim) in its own scenario, all in one call of the engine.

        Cheapest where lanes share scenario objects.

        Args:
            theta: physical parameters, then coefficients of effects.
            scenarios: one a lane.
            initial: initial states (L,) by name, in place of the scenarios' own.

        Returns:
            Observations (L, T, C), T that of the longest scenario; behind the end of a shorter one
            stand NaN.

        Raises:
            InputError: a wrong shape, or a scenario that names a constant, input or state that the
                system lacks.
        """
        theta = np.asarray(theta, dtype=np.float64)
        if theta.ndim != 2 or theta.shape != (len(scenarios), len(self.parameters)):
            expected = (len(scenarios), len(self.parameters))
            raise InputError(f"theta must have shape {expected}, found {theta.shape}")
        if not len(theta):
            return np.empty((0, 0, len(self.channels)))
        TALLY.count(len(theta))
        return self._simulated(theta, scenarios, initial or {})

    def _simulated(
        self, theta: Array, scenarios: Sequence[Scenario], initial: Mapping[str, Array]
    ) -> Array:
        """The same of one lane or more, checked."""
        acting = self._acting(theta)
        runs = make_runs(scenarios)
        commands = [self.run_inputs(s) for s in runs.distinct]
        with np.errstate(all="ignore"):  # a lane whose numbers overflow is NaN in the end
            plan = make_plan(runs, commands, _of(acting, (Input, Sensor)), self.engine.largest_step)
            inputs = felt_inputs(plan, runs, commands, _of(acting, Input)) if self.inputs else {}
            sensors = tuple((effect, c) for effect, c in _of(acting, Sensor) if c.any())
            # A filter in a sensor sees every step; the others see the samples alone.
            filtered = any(_filters(effect) for effect, _ in sensors)
            every = 1 if filtered else plan.every
            own = np.ascontiguousarray(theta[:, : len(self.system.parameters)])
            constants, x, v = self._known(scenarios, initial)
            forces = _of(acting, (Force, Friction, Contact, Hidden, Level))
            lanes = Lanes(self._declared, own, constants, x, v, plan.steps, inputs, forces, every)
            clock = np.array([s.times[0] for s in runs.distinct])[runs.of, None]
            motion = integrate(self.engine, lanes)
            observations = self._read(motion, lanes, plan, sensors, clock)
        # A shorter run has waited at its end; what it showed there was no sample.
        sizes = np.array([s.times.size for s in runs.distinct])
        if sizes.min() < sizes.max():
            observations[np.arange(sizes.max()) >= sizes[runs.of, None]] = np.nan
        return observations

    def close(self) -> None:
        """Give back what the engine holds."""
        self.engine.close()

    def _acting(self, theta: Array) -> Acting:
        """Effects with their coefficients (K, L, 1): the tuned ones from `theta`, then the fixed
        ones.

        Those that the system does not have, or that were not given, are zero.
        """
        acting = []
        place = len(self.system.parameters)
        for effect in self.effects:
            count = len(effect.on(self.system))
            rows = theta[:, place : place + count].T
            acting.append((effect, _coefficients(effect, rows)))
            place += count
        for effect, values in self.fixed:
            column = np.array(values)[:, None]
            rows = np.repeat(column, len(theta), axis=1)
            acting.append((effect, _coefficients(effect, rows)))
        return tuple(acting)

    def _known(
        self, scenarios: Sequence[Scenario], initial: Mapping[str, Array]
    ) -> tuple[dict[str, Array], Array, Array]:
        """Constants (L, 1) by name, initial positions and velocities (L, D)."""
        # Checked once for each scenario object and not for each lane: there are hundreds of lanes.
        distinct, of = by_object(scenarios)
        known = [self.run_constants(s) for s in distinct]
        began = [self.run_initial(s) for s in distinct]
        constants = {name: values[of, None] for name, values in _columns(known).items()}
        states = {name: values[of] for name, values in _columns(began).items()}
        states = self._checked("initial state", states, initial)
        x = _stacked(states, self.system.coordinates, of.size)
        v = _stacked(states, self.system.rates, of.size)
        return constants, x, v

    def _read(
        self, motion: Motion, lanes: Lanes, plan: Plan, sensors: Acting, clock: Array
    ) -> Array:
        """What the sensors record: (L, T, C); `clock` (L, 1) is the first stamp of each run."""
        channels = self._declared.observe(motion.x, motion.v, motion.a, lanes.constants)
        names = [c.name for c in self.channels]
        valued = self.system.reading(names)
        times = _kept(plan, lanes.every)
        steps = np.diff(times, axis=1, prepend=0.0)
        # The plan's rows count samples; more states than that are kept where a sensor filters.
        rows = plan.rows * (plan.every // lanes.every)
        observations = np.empty((*rows.shape, len(names)))
        for place, name in enumerate(names):
            values = channels[name]
            # A gain or bias is that of one channel.
            reading = tuple((e, c) for e, c in sensors if _filters(e) or name == valued)
            if reading:
                values = sensed(reading, values, steps, times, clock)
            observations[:, :, place] = _chosen(values, rows)
        observations += 0.0  # no zero is negative: whatever made it, it is the same zero
        return observations


def _filters(effect: Effect) -> bool:
    """Whether a sensor's effect must see every step."""
    return isinstance(effect, Sensor) and effect.filters


def sensed(
    sensors: Acting, values: Array, steps: Array, times: Array, clock: Array | float = 0.0
) -> Array:
    """(L, R) what sensors in a row make of a channel's values (L, R).

    Each reads what the one before gives, also at the start, in which the next begins.
    """
    values = values.copy()
    start = values[:, :1].copy()
    clock = np.broadcast_to(clock, start.shape)
    for effect, c in sensors:
        assert isinstance(effect, Sensor)
        # Of hundreds of lanes an effect may act in a few: the others are not asked.
        lanes = np.flatnonzero(acts(c))
        own, begin = c[:, lanes], start[lanes]
        nothing = np.zeros_like(begin)
        first = clock[lanes]
        signal = Signal(values[lanes], steps[lanes], begin, times[lanes], first)
        values[lanes] = effect.read(own, signal)
        start[lanes] = effect.read(own, Signal(begin, nothing, begin, nothing, first))
    return values


def _kept(plan: Plan, every: int) -> Array:
    """(L, R) instants of the states that an engine keeps, in seconds since the start."""
    start = np.zeros((len(plan.ends), 1))
    return np.concatenate([start, plan.ends[:, every - 1 :: every]], axis=1)


def _chosen(values: Array, rows: NDArray[np.intp]) -> Array:
    """values[l, rows[l, t]], without a copy where all of the first values are chosen."""
    in_order = (rows[:1] == np.arange(rows.shape[1])).all()
    if in_order and (rows.strides[0] == 0 or (rows == rows[:1]).all()):
        return values[:, : rows.shape[1]]
    chosen: Array = np.take_along_axis(values, rows, axis=1)
    return chosen


def effect_parameters(
    effect: Effect | type[Effect], system: type[System], observed: Sequence[str] = ()
) -> tuple[Parameter, ...]:
    """The coefficients of an effect as parameters, named for the effect and searched in their
    plausible range.
    """
    result = []
    there = effect.on(system)
    for c in there:
        name = effect.name if len(there) == 1 else f"{effect.name}.{c.name}"
        low, high = c.range(system.kind)
        unit = c.unit_on(system, observed) or ""
        off = min(max(0.0, low), high)  # nominally it is not there, if that is in its range
        result.append(Parameter(name, unit, off, (low, high), says=effect.says))
    return tuple(result)


def _columns(rows: Sequence[Mapping[str, float]]) -> dict[str, Array]:
    """Rows of numbers by name as one array (N,) a name."""
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def _stacked(states: Mapping[str, Array], names: Sequence[str], count: int) -> Array:
    """The states of these names as columns (L, D)."""
    if not names:
        return np.empty((count, 0))
    columns = [np.broadcast_to(states[name], (count,)) for name in names]
    result: Array = np.stack(columns, axis=1)
    return result


def _check_given(effects: object, fixed: object) -> None:
    """Refuse what an experiment's file may hold in place of names and a table.

    Raises:
        InputError: it does.
    """
    if not isinstance(effects, list | tuple) or not all(map(_names_effect, effects)):
        raise InputError(f"effects: expected a list of names, found {shown(effects)}")
    if fixed is not None and not isinstance(fixed, Mapping):
        wanted = "a table of coefficients by effect"
        raise InputError(f"fixed: expected {wanted}, found {shown(fixed)}")


def _names_effect(value: object) -> bool:
    return isinstance(value, str) or (isinstance(value, type) and issubclass(value, Effect))


def _row(name: str, value: Any) -> tuple[float, ...]:
    """The coefficients of a fixed effect, one or several."""
    several = isinstance(value, list | tuple)
    values = tuple(value) if several else (value,)
    if not all(map(is_number, values)):
        raise InputError(f"effect {name}: expected finite coefficients, found {shown(value)}")
    return tuple(float(v) for v in values)


def _check_sizes(effect: Effect, system: type[System], values: Sequence[float]) -> None:
    """Refuse coefficients beyond all that can be meant.

    Raises:
        InputError: one is.
    """
    for coefficient, value in zip(effect.on(system), values, strict=False):
        largest = max(map(abs, coefficient.range(system.kind)))
        if abs(value) > BEYOND * largest:
            wanted = f"within ±{BEYOND * largest:g} {coefficient.unit_on(system) or ''}".rstrip()
            raise InputError(
                f"effect {effect.name}: expected {coefficient.name} {wanted}, found {value:g}"
            )


def _coefficients(effect: Effect, rows: Array) -> Array:
    """`rows` (k, L) as (K, L, 1), the coefficients behind the first k zero."""
    result = np.zeros((len(effect.coefficients), rows.shape[1], 1))
    result[: len(rows), :, 0] = rows
    return result


def _of(acting: Acting, kind: Any) -> Acting:
    return tuple((effect, c) for effect, c in acting if isinstance(effect, kind))
