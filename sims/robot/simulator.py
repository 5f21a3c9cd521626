"""Simulator of a robot's model file, for tuners and for explain.

MuJoCo uses the time step and the integrator of the model file. Samples of a log may be at any time:
between two steps, positions are interpolated by the cubic with the positions and velocities of both
ends, and other readings linearly. The control of an actuator over a step is the mean of its command
over the step.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from sims import effects as library
from sims.base import Array, InputError, Scenario, unknown
from sims.plan import Runs, make_runs
from sims.robot.acting import derives, filled, is_asked, lanes_with, natives, part_of
from sims.robot.activation_filters import (
    ActivationFilter,
    activation_filters,
    is_fourth_order,
    stated_activations,
    with_history,
)
from sims.robot.bench_cache import RefusedModelError, bench_cache
from sims.robot.compiled import compiled
from sims.robot.drives import Shown
from sims.robot.felt import INSTANT, SHARE
from sims.robot.felt import felt as felt_over
from sims.robot.floating import Afloat, Floating
from sims.robot.forces import Forces, over_time
from sims.robot.friction_form import FrictionForm
from sims.robot.lanes import LANES, Addresses, Bench
from sims.robot.midway import Mask, Places
from sims.robot.model import Robot
from sims.robot.numerics import INTEGRATORS, Numerics, RobotEngine, own_numerics
from sims.robot.quiet import quiet
from sims.robot.sampling import sampled
from sims.robot.series import Added, by_series
from sims.robot.switched_off import off_steps, working_servos
from sims.robot.system import RobotSystem, system_of
from sims.robot.work import Given, Made, Start, Work, by_run, instants
from sims.simulated import Simulated
from sims.system import Acting, Effect, Engine, Sensor
from sims.user_toml import shown

WIDTH = 128
"""Batch size for linearisation: number of points of a motion that are evaluated together."""


class RobotSimulator(Simulated):
    """Base class of robot simulators; `robot_simulator` makes one from a model file.

    Attributes:
        robot: the robot.
        numerics: time step and integrator, from the model file or changed.
        free: numbers of the model file that are parameters.
    """

    system: ClassVar[type[RobotSystem]] = RobotSystem
    default_engine = "mujoco"
    own_engine = True
    has_model = True
    requires = ("mujoco",)
    robot: ClassVar[Robot]
    numerics: ClassVar[Numerics]
    free: ClassVar[tuple[str, ...]] = ()

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        twice = [effect.name for effect in self.effects if self.system.is_free(type(effect))]
        if twice:
            raise InputError(f"effect {twice[0]}: its coefficient is free already")
        freed = self.system.freed_effects
        self._freed: list[Effect] = [effect() for effect in freed]
        self.robotic = self.system()
        self.addresses = Addresses(self.robot)
        self._floating = Floating.of(self.robot)

    def _engine(self, name: str | None, settings: Mapping[str, Any]) -> Engine:
        if name not in (None, "mujoco"):
            raise InputError(f"robot {self.name} steps in MuJoCo; it has no engine '{name}'")
        for setting in settings:
            if setting not in Numerics._fields:
                raise unknown("setting of engine mujoco", setting, Numerics._fields)
        numerics = self.numerics._replace(**settings)
        if numerics.integrator not in INTEGRATORS:
            raise unknown("integrator", str(numerics.integrator), list(INTEGRATORS))
        if not (isinstance(numerics.timestep, float) and numerics.timestep > 0):
            found = shown(numerics.timestep)
            raise InputError(f"timestep must be a positive number of seconds, found {found}")
        return RobotEngine(numerics)

    @classmethod
    def stepped_by(cls, numerics: Numerics) -> type[RobotSimulator]:
        """Make the simulator of the same robot with other integrator settings."""
        # The robot keeps the settings of its file, so that a result can state what to change there.
        return robot_simulator(cls.robot, cls.free, numerics)

    @classmethod
    def with_friction_form(cls, form: FrictionForm) -> type[RobotSimulator]:
        """Make the simulator of the same robot with another form of the dry friction of effects.

        Args:
            form: ``stiff`` for Coulomb friction; ``soft`` for the solver parameters of the model
                file, or MuJoCo's defaults if the file specifies none.
        """
        return robot_simulator(cls.robot.with_friction_form(form), cls.free, cls.numerics)

    @classmethod
    def halved(cls) -> type[RobotSimulator]:
        """Make the simulator of the same robot with half the time step."""
        return cls.stepped_by(cls.numerics._replace(timestep=0.5 * cls.numerics.timestep))

    @property
    def step(self) -> float:
        """Step length in seconds."""
        return self.engine.largest_step

    def _acting(self, theta: Array) -> Acting:
        """Return active effects, see `Simulated`: free parameters first, families expanded."""
        acting: list[tuple[Effect, Array]] = []
        place = 0
        for effect in self._freed:
            count = len(effect.coefficients)
            acting.append((effect, theta[:, place : place + count].T[:, :, None]))
            place += count
        acting += super()._acting(theta)
        parts = [part for effect, c in acting if c.any() for part in effect.parts(c)]
        return tuple((effect, c) for effect, c in parts if c.any())

    def acting(self, theta: Array) -> Acting:
        """Return the active effects at one place each, for rows of parameters.

        Args:
            theta: (L, p) parameters.

        Returns:
            Effects with their coefficients (K, L, 1).
        """
        return self._acting(theta)

    def _simulated(
        self, theta: Array, scenarios: Sequence[Scenario], initial: Mapping[str, Array]
    ) -> Array:
        """Simulate observations, see `Simulated`."""
        acting = self._acting(theta)
        runs = make_runs(scenarios, by_initial=True)
        commands = [self.run_inputs(s) for s in runs.distinct]
        _, x, v = self._known(scenarios, initial)
        return self._lanes(acting, runs, commands, x, v)

    def observed(self, work: Work) -> Array:
        """Simulate observations (n, T, C) of the batch elements of one run."""
        runs = Runs((work.scenario,), np.zeros(len(work.x), dtype=np.intp))
        return self._lanes(work.acting, runs, [work.commands], work.x, work.v)

    def _lanes(
        self,
        acting: Acting,
        runs: Runs,
        commands: Sequence[Mapping[str, Array]],
        x: Array,
        v: Array,
    ) -> Array:
        """Simulate observations (L, T, C) of batch elements that begin at x and v (L, D)."""
        longest = max(s.times.size for s in runs.distinct)
        result = np.full((len(x), longest, len(self.channels)), np.nan)
        derived = lanes_with(acting, len(x), derives)
        asked = lanes_with(acting, len(x), is_asked)
        # A diverging batch element becomes NaN, so floating-point warnings are suppressed.
        with np.errstate(all="ignore"), quiet():
            for series, kind, lanes in _alike(acting, derived, asked):
                # Batch elements are sorted by run, so that data common to a run are computed once.
                lanes = lanes[np.argsort(runs.of[lanes], kind="stable")]
                for part in np.array_split(lanes, max(-(-lanes.size // LANES), 1)):
                    works = [
                        Work(
                            runs.distinct[run],
                            commands[run],
                            part_of(acting, own),
                            x[own],
                            v[own],
                        )
                        for run, own in by_run(runs, part)
                    ]
                    bits = bool(kind & 1), bool(kind & 2)
                    try:
                        done = self._simulate(works, part_of(acting, part), *bits, series)
                    except RefusedModelError:
                        # These elements stay NaN, like those of a diverging motion; the others are
                        # simulated.
                        continue
                    for (_, own), seen in zip(by_run(runs, part), done, strict=True):
                        result[own, : seen.shape[1]] = seen
        # Negative zeros become positive, so that results do not depend on their origin.
        result += 0.0
        return result

    def _simulate(
        self,
        works: Sequence[Work],
        acting: Acting,
        derived: bool,
        asked: bool,
        series: Added = (),
    ) -> list[Array]:
        """Simulate observations (n, T, C) of the batch elements of each run, in one batch.

        Args:
            works: batch elements of each run.
            acting: effects active on all of them.
            derived: whether effects change constants that MuJoCo derives.
            asked: whether forces are evaluated in every step.
            series: effects in series with joints.
        """
        if not works:
            return []
        # A sensor at the end needs a further step, since MuJoCo computes its reading within the
        # step that begins then.
        felt = self._feels()
        sizes = [self.steps_of(instants(work)) for work in works]
        given = [self.controls(work, size + felt) for work, size in zip(works, sizes, strict=True)]
        whole = Given.of(given)
        x = np.concatenate([work.x for work in works])
        v = np.concatenate([work.v for work in works])
        made = self._stepped(
            Start(x, v, acting, self._afloat(works)), whole, derived, asked, series=series
        )
        seen = []
        first = 0
        for work, size in zip(works, sizes, strict=True):
            own = slice(first, first + len(work.x))
            seen.append(self._shown(made.of(own), work, work.times, size))
            first += len(work.x)
        return seen

    def _afloat(self, works: Sequence[Work]) -> Afloat:
        """Return the initial states of floating bodies for all batch elements."""
        begun = [self.begins_afloat(work) for work in works]
        sizes = [len(work.x) for work in works]
        return Afloat(*(np.repeat(rows, sizes, axis=0) for rows in zip(*begun, strict=True)))

    def begins_afloat(self, work: Work) -> Afloat:
        """Return the initial state of floating bodies, from the recording or the model file."""
        return self._floating.begun(self.run_initial(work.scenario) if self._floating else {})

    def steps_of(self, times: Array) -> int:
        """Return the number of steps to the last of some times since the start."""
        return max(int(np.ceil(times[-1] / self.step - SHARE)), 1)

    @cached_property
    def _drives(self) -> bool:
        """Whether drive forces are recorded."""
        return any(c.name.startswith("tau.") for c in self.channels)

    @cached_property
    def _rated(self) -> frozenset[int]:
        """Actuators whose second control is the rate of their command."""
        return frozenset(a.id for a in self.robot.actuators if a.name in self.robot.rated)

    def _feels(self) -> bool:
        """Return whether a recorded channel is computed by MuJoCo within a step."""
        return any(c.name.startswith(("tau.", "s.")) for c in self.channels)

    def controls(self, work: Work, steps: int) -> Given:
        """Compute the inputs of the batch elements of one run over all steps.

        Args:
            work: batch elements of the run.
            steps: number of steps.
        """
        n = len(work.x)
        of_run = self.step, work.scenario, work.commands, work.acting, n, steps
        felt = felt_over(*of_run)
        instant = felt_over(*of_run, INSTANT) if self._drives else felt
        begins: Array = self.step * np.arange(float(steps))
        model = self.robot.compiled
        controls = np.zeros((n, steps, model.nu))
        forces = np.zeros((n, steps, model.nv))
        given = np.zeros_like(controls) if self._drives else controls
        for actuator in self.robot.actuators:
            name = f"u.{actuator.name}"
            controls[:, :, actuator.control] = felt[name]
            if self._drives:
                given[:, :, actuator.control] = instant[name]
            # A derivative gain on the error's rate needs the rate of the command.
            if actuator.id in self._rated:
                rate = np.diff(felt[name], axis=1, prepend=felt[name][:, :1]) / self.step
                controls[:, :, actuator.control + 1] = rate
                given[:, :, actuator.control + 1] = rate
        for joint in self.robot.joints:
            if joint.single:
                forces[:, :, joint.velocity] = felt[f"force.{joint.name}"]
        dofs = self.addresses.velocities
        forces[:, :, dofs] += over_time(self.robotic, work.acting, begins, len(dofs), n)
        begun = np.zeros((n, model.na))
        for one in activation_filters(self.robot):
            taken = controls[:, :, one.actuator.control]
            begun[:, one.address] = self._first_activation(one, work, taken)
            # The servo's effective set point is the activation instead of the command.
            activations = self._activations(one, taken, begun[:, one.address])
            felt = {**felt, f"u.{one.actuator.name}": activations[:, :-1]}
        off = off_steps(self.robot, work.scenario, self.step, steps)
        return Given(controls, forces, felt, given, begun, np.broadcast_to(off, (n, *off.shape)))

    def _first_activation(self, one: ActivationFilter, work: Work, controls: Array) -> Array:
        """Return the activation (n,) of a filter at the start of a run.

        Args:
            one: the filter.
            work: batch elements of the run.
            controls: (n, S) controls of the filter.
        """
        stated = stated_activations(self.robot, work.scenario.initial)
        if one.state in stated:
            return np.full(len(work.x), stated[one.state])
        settled: Array = np.clip(one.clipped(controls[:, 0]), *one.limits)
        history = with_history(work.scenario, self.step)
        if history is None:
            return settled
        scenario, steps = history
        commands = self.run_inputs(scenario)
        n = len(work.x)
        felt = felt_over(self.step, scenario, commands, work.acting, n, steps)
        earlier = felt[f"u.{one.actuator.name}"]
        last: Array = self._activations(one, earlier, one.clipped(earlier[:, 0]))[:, -1]
        return last

    def _activations(self, one: ActivationFilter, controls: Array, begun: Array) -> Array:
        """Return the activations (n, S + 1) of a filter."""
        engine = self.engine
        assert isinstance(engine, RobotEngine)
        fourth = is_fourth_order(int(engine.numerics.settings()["integrator"]))
        return one.activations(controls, begun, self.step, fourth)

    def run_initial(self, scenario: Scenario) -> dict[str, float]:
        """Return initial states, see `Simulator`; filter activations are not estimated states."""
        stated = stated_activations(self.robot, scenario.initial)
        own = {name: v for name, v in scenario.initial.items() if name not in stated}
        return super().run_initial(replace(scenario, initial=own))

    def wide(self, acting: Acting = ()) -> Bench:
        """Return the batch for linearisation, with the joints in series that effects need.

        Args:
            acting: effects active in the motion.
        """
        (series,) = by_series(acting, 1)
        return self._bench(True, WIDTH, series)

    def half_steps(self, acting: Acting = ()) -> Bench:
        """Return the batch of `wide` with half the time step."""
        (series,) = by_series(acting, 1)
        engine = self.engine
        assert isinstance(engine, RobotEngine)
        settings = dict(engine.numerics.settings())
        settings["timestep"] *= 0.5
        return bench_cache(self.robot).bench(series, True, WIDTH, settings)

    def stepped(self, work: Work, given: Given, more: Sequence[str] = ()) -> Made:
        """Step the batch elements of one run.

        Args:
            work: batch elements of the run.
            given: inputs over the steps.
            more: additional fields of MuJoCo's data to record.
        """
        n = len(work.x)
        derived = bool(lanes_with(work.acting, n, derives).any())
        asked = bool(lanes_with(work.acting, n, is_asked).any())
        (series,) = by_series(work.acting, n)
        start = Start(work.x, work.v, work.acting, self._afloat([work]))
        return self._stepped(start, given, derived, asked, more, series)

    def _stepped(
        self,
        start: Start,
        given: Given,
        derived: bool,
        asked: bool,
        more: Sequence[str] = (),
        series: Added = (),
    ) -> Made:
        n = len(start.x)
        # A single simulation uses a small batch, so that constants need not be derived for a whole
        # one.
        bench = self._bench(derived, 1 if n == 1 else LANES, series)
        places, second = bench.places, bench.second
        bench.load(filled(natives(start.acting), n, bench.count))
        behind = bench.begin(start.x, start.v, start.afloat)
        bench.activate(given.activations)
        record = ["qpos", "qvel", *more]
        if self._feels():
            record.append("sensordata")
        record = list(dict.fromkeys(record))
        if asked:
            stiffness = bench.stiffness(places)[:n]
            asking = Forces(self.robotic, start.acting, given.felt, places, stiffness, self.step)
            forces = bench.spread(given.forces)
            asked_of = None
            if given.off.any():
                # Compiled effects assume a constant servo stiffness over all steps.
                asking.working = working_servos(bench.robot, places.velocities, given.off)
            else:
                asked_of = compiled(asking)
            done = bench.ask(given.controls, forces, asked_of or asking, record, given.off)
        else:
            forces = bench.spread(given.forces)
            done = bench.run(given.controls, forces, record, given.off)
        x = np.concatenate([start.x[:, None], done["qpos"][:, :, places.positions]], axis=1)
        v = np.concatenate([start.v[:, None], done["qvel"][:, :, places.velocities]], axis=1)
        x[bench.failed] = np.nan
        if self._drives:
            shown = Shown(self.robot, self.robotic, bench, given, self.step)
            shown.as_given(done["sensordata"])
            shown.as_exerted(done["sensordata"], x, v, start.acting)
        after = done["qpos"][:, :, second.positions], done["qvel"][:, :, second.velocities]
        hidden = [
            np.concatenate([first[:, None], rest], axis=1)
            for first, rest in zip(behind, after, strict=True)
        ]
        return Made(x, v, done, given.activations, bench.failed, (hidden[0], hidden[1]))

    def _bench(self, derived: bool, count: int, series: Added = ()) -> Bench:
        engine = self.engine
        assert isinstance(engine, RobotEngine)
        settings = engine.numerics.settings()
        return bench_cache(self.robot).bench(series, derived, count, settings)

    def _shown(self, made: Made, work: Work, times: Array, steps: int) -> Array:
        """Compute the recorded observations (n, T, C), including sensor effects."""
        columns = []
        for channel in self.channels:
            values, slopes = self._signal(made, channel.name, steps)
            sensors = tuple(
                (e, c)
                for e, c in work.acting
                if isinstance(e, Sensor) and e.signal in ("", channel.name)
            )
            clock = float(work.scenario.times[0])
            columns.append(sampled(values, slopes, self.step, times, sensors, clock))
        result = np.stack(columns, axis=2)
        result[made.failed] = np.nan
        return result

    def _signal(self, made: Made, name: str, steps: int) -> tuple[Array, Array | None]:
        """Return the values (n, S + 1) of a channel at all steps, and their slopes if known."""
        kind, _, of = name.partition(".")
        upto = slice(steps + 1)
        if kind in ("q", "qd"):
            number = self.system.coordinates.index(f"q.{of}")
            if kind == "q":
                return made.x[:, upto, number], made.v[:, upto, number]
            return made.v[:, upto, number], None
        return made.fields["sensordata"][:, upto, self.column(name)], None

    def column(self, channel: str) -> int:
        """Return the column in MuJoCo's sensor data of a channel that is not a state."""
        kind, _, of = channel.partition(".")
        if kind == "tau":
            return self._bench(False, 1).drives[of]
        return next(s for s in self.robot.sensors if s.name == of).address


def _alike(acting: Acting, derived: Mask, asked: Mask) -> Iterator[tuple[Added, int, Places]]:
    """Group batch elements that can be simulated together.

    Yields:
        Effects in series with joints, a bit field (1: derived constants change, 2: forces are
        evaluated in every step), and the indices of the batch elements.
    """
    for series, own in by_series(acting, len(derived)).items():
        there = np.zeros(len(derived), dtype=bool)
        there[own] = True
        for kind in range(4):
            of_kind = there & (derived == bool(kind & 1)) & (asked == bool(kind & 2))
            yield series, kind, np.flatnonzero(of_kind)


def robot_simulator(
    robot: Robot, free: Sequence[str] = (), numerics: Numerics | None = None
) -> type[RobotSimulator]:
    """Make the simulator class of a robot.

    Args:
        robot: robot as read from its model file.
        free: numbers of the file to tune, such as ``damping@*`` or ``mass@forearm``.
        numerics: time step and integrator; those of the file if None.

    Raises:
        InputError: the robot has no joint with one coordinate, or a name in `free` does not exist.
    """
    numerics = numerics or own_numerics(robot)
    # The class is created at run time, so its source text does not identify the robot; the digest
    # does.
    told = repr((robot.digest, tuple(free), tuple(numerics)))
    told += "" if robot.friction_form == "stiff" else robot.friction_form
    system = system_of(robot, free)
    declared = {
        "system": system,
        "robot": robot,
        "numerics": numerics,
        "free": tuple(free),
        "made_of": tuple(library.get(n) for n in {e.of: 0 for e in system.freed_effects}),
        "source_digest": hashlib.sha256(told.encode()).hexdigest(),
        "__module__": __name__,
        "__doc__": f"The robot of {robot.path.name}.",
    }
    return type("RobotOfFile", (RobotSimulator,), declared)
