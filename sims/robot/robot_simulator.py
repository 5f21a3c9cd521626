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
from sims.core.effect import ActiveEffects, Effect, Sensor
from sims.core.engine import Engine
from sims.core.simulator import Array, InputError, Scenario, make_unknown_name_error
from sims.core.toml_validation import format_value
from sims.engines.time_grid import ScenarioGroups, group_scenarios
from sims.robot.dynamics.activation_filters import (
    ActivationFilter,
    activation_filters,
    is_fourth_order,
    stated_activations,
    with_history,
)
from sims.robot.dynamics.active_effects import (
    changes_derived_constants,
    find_active_elements,
    is_evaluated_per_step,
    pad_coefficients,
    select_model_field_effects,
    slice_active_effects,
)
from sims.robot.dynamics.applied_inputs import (
    SAME_INSTANT_SHARE,
    STEP_COUNT_TOLERANCE,
    compute_inputs_over_steps,
)
from sims.robot.dynamics.batch_cache import RefusedModelError, bench_cache
from sims.robot.dynamics.batch_work import (
    BatchInputs,
    BatchResult,
    BatchStart,
    RobotRunBatch,
    group_by_run,
    list_last_read_times,
)
from sims.robot.dynamics.callback_stepping import step_in_callback
from sims.robot.dynamics.compiled_forces import compile_forces
from sims.robot.dynamics.disabled_drives import off_steps, working_servos
from sims.robot.dynamics.drive_sensors import DriveSensorModel
from sims.robot.dynamics.effect_forces import EffectForces, compute_time_dependent_forces
from sims.robot.dynamics.midpoint_state import Mask, Places
from sims.robot.dynamics.mujoco_batch import BATCH_SIZE, JointAddresses, MujocoBatch
from sims.robot.dynamics.sensor_sampling import sample_readings
from sims.robot.dynamics.series_joints import SeriesJoints, group_by_series_joints
from sims.robot.floating_joints import FloatingJoints, FloatingState
from sims.robot.friction_form import FrictionForm
from sims.robot.integrator_settings import (
    INTEGRATOR_IDS,
    IntegratorSettings,
    RobotEngine,
    read_integrator_settings,
)
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.robot_model import RobotModel
from sims.robot.robot_system import RobotSystem, make_robot_system
from sims.system_simulator import SystemSimulator

LINEARISATION_BATCH_SIZE = 128
"""Batch size for linearisation: number of points of a motion that are evaluated together."""


class RobotSimulator(SystemSimulator):
    """Base class of robot simulators; `make_robot_simulator` makes one from a model file.

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
    robot: ClassVar[RobotModel]
    numerics: ClassVar[IntegratorSettings]
    free: ClassVar[tuple[str, ...]] = ()

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Create the simulator, and check that no number of the model is a parameter twice.

        A coefficient may be freed in the model itself (`free`) or belong to a given effect,
        but not both.
        """
        super().__init__(*args, **kwargs)
        twice = [effect.name for effect in self.effects if self.system.is_free(type(effect))]
        if twice:
            raise InputError(f"effect {twice[0]}: its coefficient is free already")
        freed = self.system.freed_effects
        self._freed: list[Effect] = [effect() for effect in freed]
        self.robotic = self.system()
        self.addresses = JointAddresses(self.robot)
        self._floating = FloatingJoints.from_robot(self.robot)

    def _engine(self, name: str | None, settings: Mapping[str, Any]) -> Engine:
        """Return MuJoCo as the engine, with checked settings of the time step and the integrator.

        Other engines are refused, since a model file describes a robot for MuJoCo.
        """
        if name not in (None, "mujoco"):
            raise InputError(f"robot {self.name} steps in MuJoCo; it has no engine '{name}'")
        for setting in settings:
            if setting not in IntegratorSettings._fields:
                raise make_unknown_name_error(
                    "setting of engine mujoco", setting, IntegratorSettings._fields
                )
        numerics = self.numerics._replace(**settings)
        if numerics.integrator not in INTEGRATOR_IDS:
            raise make_unknown_name_error(
                "integrator", str(numerics.integrator), list(INTEGRATOR_IDS)
            )
        if not (isinstance(numerics.timestep, float) and numerics.timestep > 0):
            found = format_value(numerics.timestep)
            raise InputError(f"timestep must be a positive number of seconds, found {found}")
        return RobotEngine(numerics)

    @classmethod
    def with_integrator_settings(cls, numerics: IntegratorSettings) -> type[RobotSimulator]:
        """Make the simulator of the same robot with other integrator settings."""
        # The robot keeps the settings of its file, so that a result can state what to change there.
        return make_robot_simulator(cls.robot, cls.free, numerics)

    @classmethod
    def with_friction_form(cls, form: FrictionForm) -> type[RobotSimulator]:
        """Make the simulator of the same robot with another form of the dry friction of effects.

        Args:
            form: ``stiff`` for Coulomb friction; ``soft`` for the solver parameters of the model
                file, or MuJoCo's defaults if the file specifies none.
        """
        return make_robot_simulator(cls.robot.with_friction_form(form), cls.free, cls.numerics)

    @classmethod
    def with_half_step(cls) -> type[RobotSimulator]:
        """Make the simulator of the same robot with half the time step."""
        return cls.with_integrator_settings(
            cls.numerics._replace(timestep=0.5 * cls.numerics.timestep)
        )

    @property
    def time_step(self) -> float:
        """Step length in seconds."""
        return self.engine.largest_step

    def _acting(self, theta: Array) -> ActiveEffects:
        """Return active effects (`SystemSimulator`): free parameters first, families expanded."""
        acting: list[tuple[Effect, Array]] = []
        place = 0
        for effect in self._freed:
            count = len(effect.coefficients)
            acting.append((effect, theta[:, place : place + count].T[:, :, None]))
            place += count
        acting += super()._acting(theta)
        parts = [part for effect, c in acting if c.any() for part in effect.parts(c)]
        return tuple((effect, c) for effect, c in parts if c.any())

    def get_active_effects(self, theta: Array) -> ActiveEffects:
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
        """Simulate observations, see `SystemSimulator`."""
        acting = self._acting(theta)
        runs = group_scenarios(scenarios, by_initial=True)
        commands = [self.run_inputs(s) for s in runs.unique_scenarios]
        _, x, v = self._known(scenarios, initial)
        return self._lanes(acting, runs, commands, x, v)

    def simulate_observations(self, work: RobotRunBatch) -> Array:
        """Simulate observations (n, T, C) of the batch elements of one run."""
        runs = ScenarioGroups((work.scenario,), np.zeros(len(work.x), dtype=np.intp))
        return self._lanes(work.acting, runs, [work.commands], work.x, work.v)

    def _lanes(
        self,
        acting: ActiveEffects,
        runs: ScenarioGroups,
        commands: Sequence[Mapping[str, Array]],
        x: Array,
        v: Array,
    ) -> Array:
        """Simulate observations (L, T, C) of batch elements that begin at x and v (L, D)."""
        longest = max(s.times.size for s in runs.unique_scenarios)
        result = np.full((len(x), longest, len(self.channels)), np.nan)
        derived = find_active_elements(acting, len(x), changes_derived_constants)
        asked = find_active_elements(acting, len(x), is_evaluated_per_step)
        # A diverging batch element becomes NaN, so floating-point warnings are suppressed.
        with np.errstate(all="ignore"), capture_mujoco_warnings():
            for series, kind, lanes in _alike(acting, derived, asked):
                # Batch elements are sorted by run, so that data common to a run are computed once.
                lanes = lanes[np.argsort(runs.scenario_index[lanes], kind="stable")]
                for part in np.array_split(lanes, max(-(-lanes.size // BATCH_SIZE), 1)):
                    works = [
                        RobotRunBatch(
                            runs.unique_scenarios[run],
                            commands[run],
                            slice_active_effects(acting, own),
                            x[own],
                            v[own],
                        )
                        for run, own in group_by_run(runs, part)
                    ]
                    bits = bool(kind & 1), bool(kind & 2)
                    try:
                        done = self._simulate(
                            works, slice_active_effects(acting, part), *bits, series
                        )
                    except RefusedModelError:
                        # These elements stay NaN, like those of a diverging motion; the others are
                        # simulated.
                        continue
                    for (_, own), seen in zip(group_by_run(runs, part), done, strict=True):
                        result[own, : seen.shape[1]] = seen
        # Negative zeros become positive, so that results do not depend on their origin.
        result += 0.0
        return result

    def _simulate(
        self,
        works: Sequence[RobotRunBatch],
        acting: ActiveEffects,
        derived: bool,
        asked: bool,
        series: SeriesJoints = (),
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
        extra_steps = int(self._reads_sensors())
        sizes = [self.count_steps(list_last_read_times(work)) for work in works]
        given = [
            self.compute_controls(work, size + extra_steps)
            for work, size in zip(works, sizes, strict=True)
        ]
        whole = BatchInputs.concatenate(given)
        x = np.concatenate([work.x for work in works])
        v = np.concatenate([work.v for work in works])
        made = self._stepped(
            BatchStart(x, v, acting, self._afloat(works)), whole, derived, asked, series=series
        )
        seen = []
        first = 0
        for work, size in zip(works, sizes, strict=True):
            own = slice(first, first + len(work.x))
            seen.append(self._shown(made.select(own), work, work.times, size))
            first += len(work.x)
        return seen

    def _afloat(self, works: Sequence[RobotRunBatch]) -> FloatingState:
        """Return the initial states of floating bodies for all batch elements."""
        begun = [self.get_floating_start(work) for work in works]
        sizes = [len(work.x) for work in works]
        return FloatingState(*(np.repeat(rows, sizes, axis=0) for rows in zip(*begun, strict=True)))

    def get_floating_start(self, work: RobotRunBatch) -> FloatingState:
        """Return the initial state of floating bodies, from the recording or the model file."""
        return self._floating.get_initial_state(
            self.run_initial(work.scenario) if self._floating else {}
        )

    def count_steps(self, times: Array) -> int:
        """Return the number of steps to the last of some times since the start."""
        return max(int(np.ceil(times[-1] / self.time_step - STEP_COUNT_TOLERANCE)), 1)

    @cached_property
    def _drives(self) -> bool:
        """Whether drive forces are recorded."""
        return any(c.name.startswith("tau.") for c in self.channels)

    @cached_property
    def _rated(self) -> frozenset[int]:
        """Actuators whose second control is the rate of their command."""
        return frozenset(
            a.id for a in self.robot.actuators if a.name in self.robot.rate_controlled_actuators
        )

    def _reads_sensors(self) -> bool:
        """Return whether a recorded channel is computed by MuJoCo within a step."""
        return any(c.name.startswith(("tau.", "s.")) for c in self.channels)

    def compute_controls(self, work: RobotRunBatch, steps: int) -> BatchInputs:
        """Compute the inputs of the batch elements of one run over all steps.

        They are the controls of the actuators, the generalised forces on the joints that do
        not depend on the state, and the activations of the filters before actuators.

        Args:
            work: batch elements of the run.
            steps: number of steps.
        """
        n = len(work.x)
        of_run = self.time_step, work.scenario, work.commands, work.acting, n, steps
        applied_inputs = compute_inputs_over_steps(*of_run)
        instant = (
            compute_inputs_over_steps(*of_run, SAME_INSTANT_SHARE)
            if self._drives
            else applied_inputs
        )
        begins: Array = self.time_step * np.arange(float(steps))
        model = self.robot.compiled
        controls = np.zeros((n, steps, model.nu))
        forces = np.zeros((n, steps, model.nv))
        given = np.zeros_like(controls) if self._drives else controls
        for actuator in self.robot.actuators:
            name = f"u.{actuator.name}"
            controls[:, :, actuator.control] = applied_inputs[name]
            if self._drives:
                given[:, :, actuator.control] = instant[name]
            # A derivative gain on the error's rate needs the rate of the command.
            if actuator.id in self._rated:
                rate = (
                    np.diff(applied_inputs[name], axis=1, prepend=applied_inputs[name][:, :1])
                    / self.time_step
                )
                controls[:, :, actuator.control + 1] = rate
                given[:, :, actuator.control + 1] = rate
        for joint in self.robot.joints:
            if joint.has_one_coordinate:
                forces[:, :, joint.velocity] = applied_inputs[f"force.{joint.name}"]
        dofs = self.addresses.velocities
        forces[:, :, dofs] += compute_time_dependent_forces(
            self.robotic, work.acting, begins, len(dofs), n
        )
        begun = np.zeros((n, model.na))
        for one in activation_filters(self.robot):
            taken = controls[:, :, one.actuator.control]
            begun[:, one.address] = self._first_activation(one, work, taken)
            # The servo's effective set point is the activation instead of the command.
            activations = self._activations(one, taken, begun[:, one.address])
            applied_inputs = {**applied_inputs, f"u.{one.actuator.name}": activations[:, :-1]}
        off = off_steps(self.robot, work.scenario, self.time_step, steps)
        return BatchInputs(
            controls, forces, applied_inputs, given, begun, np.broadcast_to(off, (n, *off.shape))
        )

    def _first_activation(
        self, one: ActivationFilter, work: RobotRunBatch, controls: Array
    ) -> Array:
        """Return the activation (n,) of a filter at the start of a run.

        It is the value that the recording states; otherwise the result of the filter for
        the known commands before the run; otherwise that of a filter that has settled at
        the first command.

        Args:
            one: the filter.
            work: batch elements of the run.
            controls: (n, S) controls of the filter.
        """
        stated = stated_activations(self.robot, work.scenario.initial)
        if one.state in stated:
            return np.full(len(work.x), stated[one.state])
        settled: Array = np.clip(one.clipped(controls[:, 0]), *one.limits)
        history = with_history(work.scenario, self.time_step)
        if history is None:
            return settled
        scenario, steps = history
        commands = self.run_inputs(scenario)
        n = len(work.x)
        applied_inputs = compute_inputs_over_steps(
            self.time_step, scenario, commands, work.acting, n, steps
        )
        earlier = applied_inputs[f"u.{one.actuator.name}"]
        last: Array = self._activations(one, earlier, one.clipped(earlier[:, 0]))[:, -1]
        return last

    def _activations(self, one: ActivationFilter, controls: Array, begun: Array) -> Array:
        """Integrate an activation filter over the steps, as MuJoCo's integrator does.

        Args:
            one: the filter.
            controls: (n, S) controls over the steps.
            begun: (n,) activations at the beginning.

        Returns:
            (n, S + 1) activations at the beginnings of steps, and at the end.
        """
        engine = self.engine
        assert isinstance(engine, RobotEngine)
        fourth = is_fourth_order(int(engine.numerics.to_model_options()["integrator"]))
        return one.activations(controls, begun, self.time_step, fourth)

    def run_initial(self, scenario: Scenario) -> dict[str, float]:
        """Return initial states, see `Simulator`; filter activations are not estimated states."""
        stated = stated_activations(self.robot, scenario.initial)
        own = {name: v for name, v in scenario.initial.items() if name not in stated}
        return super().run_initial(replace(scenario, initial=own))

    def make_linearisation_batch(self, acting: ActiveEffects = ()) -> MujocoBatch:
        """Return the batch for linearisation, with the joints in series that effects need.

        Args:
            acting: effects active in the motion.
        """
        (series,) = group_by_series_joints(acting, 1)
        return self._bench(True, LINEARISATION_BATCH_SIZE, series)

    def half_steps(self, acting: ActiveEffects = ()) -> MujocoBatch:
        """Return the batch of `make_linearisation_batch` with half the time step."""
        (series,) = group_by_series_joints(acting, 1)
        engine = self.engine
        assert isinstance(engine, RobotEngine)
        settings = dict(engine.numerics.to_model_options())
        settings["timestep"] *= 0.5
        return bench_cache(self.robot).bench(series, True, LINEARISATION_BATCH_SIZE, settings)

    def step_batch(
        self, work: RobotRunBatch, given: BatchInputs, more: Sequence[str] = ()
    ) -> BatchResult:
        """Step the batch elements of one run.

        It finds out what the effects need (derived constants, evaluation in each step,
        joints in series), and simulates all elements together; they must have the same
        joints in series.

        Args:
            work: batch elements of the run.
            given: inputs over the steps.
            more: additional fields of MuJoCo's data to record.
        """
        n = len(work.x)
        derived = bool(find_active_elements(work.acting, n, changes_derived_constants).any())
        asked = bool(find_active_elements(work.acting, n, is_evaluated_per_step).any())
        (series,) = group_by_series_joints(work.acting, n)
        start = BatchStart(work.x, work.v, work.acting, self._afloat([work]))
        return self._stepped(start, given, derived, asked, more, series)

    def _stepped(
        self,
        start: BatchStart,
        given: BatchInputs,
        derived: bool,
        asked: bool,
        more: Sequence[str] = (),
        series: SeriesJoints = (),
    ) -> BatchResult:
        """Simulate a batch of n elements over all steps, and return its states and readings.

        Effects are evaluated in MuJoCo's callback if they can be compiled, otherwise between steps.

        Args:
            start: initial states, and the active effects.
            given: controls, forces and activations over the steps.
            derived: whether masses or armatures change, from which MuJoCo derives constants.
            asked: whether an effect depends on the state, so that it is evaluated in each step.
            more: additional fields of MuJoCo's data to record.
            series: joints in series that effects add to the robot.
        """
        n = len(start.x)
        # A single simulation uses a small batch, so that constants need not be derived for a whole
        # one.
        bench = self._bench(derived, 1 if n == 1 else BATCH_SIZE, series)
        places, second = bench.places, bench.second
        bench.write_effects(
            pad_coefficients(select_model_field_effects(start.acting), n, bench.count)
        )
        behind = bench.set_initial_state(start.x, start.v, start.floating_state)
        bench.activate(given.activations)
        record = ["qpos", "qvel", *more]
        if self._reads_sensors():
            record.append("sensordata")
        record = list(dict.fromkeys(record))
        if asked:
            stiffness = bench.get_servo_stiffness(places)[:n]
            effect_forces = EffectForces(
                self.robotic, start.acting, given.applied_inputs, places, stiffness, self.time_step
            )
            forces = bench.map_forces(given.forces)
            compiled = done = None
            if given.off.any():
                # Compiled effects assume a constant servo stiffness over all steps.
                effect_forces.working = working_servos(bench.robot, places.velocities, given.off)
            else:
                compiled = compile_forces(effect_forces)
            if compiled is not None:
                done = step_in_callback(bench, given.controls, forces, compiled, record)
            if done is None:
                done = bench.step_with_forces(
                    given.controls, forces, compiled or effect_forces, record, given.off
                )
        else:
            forces = bench.map_forces(given.forces)
            done = bench.step(given.controls, forces, record, given.off)
        x = np.concatenate([start.x[:, None], done["qpos"][:, :, places.positions]], axis=1)
        v = np.concatenate([start.v[:, None], done["qvel"][:, :, places.velocities]], axis=1)
        x[bench.failed] = np.nan
        if self._drives:
            shown = DriveSensorModel(self.robot, self.robotic, bench, given, self.time_step)
            shown.shift_to_step_begin(done["sensordata"])
            shown.add_drive_effects(done["sensordata"], x, v, start.acting)
        after = done["qpos"][:, :, second.positions], done["qvel"][:, :, second.velocities]
        hidden = [
            np.concatenate([first[:, None], rest], axis=1)
            for first, rest in zip(behind, after, strict=True)
        ]
        return BatchResult(x, v, done, given.activations, bench.failed, (hidden[0], hidden[1]))

    def _bench(self, derived: bool, count: int, series: SeriesJoints = ()) -> MujocoBatch:
        """Return the batch for this time step and integrator, from the robot's cache."""
        engine = self.engine
        assert isinstance(engine, RobotEngine)
        settings = engine.numerics.to_model_options()
        return bench_cache(self.robot).bench(series, derived, count, settings)

    def _shown(self, made: BatchResult, work: RobotRunBatch, times: Array, steps: int) -> Array:
        """Compute the recorded observations (n, T, C) of one run, including sensor effects.

        Args:
            made: states and readings of the batch; failed elements become NaN.
            work: the n batch elements of the run.
            times: (T,) sample times in seconds since the start.
            steps: number of steps of the run; the batch may have more.
        """
        columns = []
        for channel in self.channels:
            values, slopes = self._signal(made, channel.name, steps)
            sensors = tuple(
                (e, c)
                for e, c in work.acting
                if isinstance(e, Sensor) and e.signal in ("", channel.name)
            )
            clock = float(work.scenario.times[0])
            columns.append(sample_readings(values, slopes, self.time_step, times, sensors, clock))
        result = np.stack(columns, axis=2)
        result[made.failed] = np.nan
        return result

    def _signal(self, made: BatchResult, name: str, steps: int) -> tuple[Array, Array | None]:
        """Return the values (n, S + 1) of a channel at all steps, and their slopes if known."""
        kind, _, of = name.partition(".")
        upto = slice(steps + 1)
        if kind in ("q", "qd"):
            number = self.system.coordinates.index(f"q.{of}")
            if kind == "q":
                return made.x[:, upto, number], made.v[:, upto, number]
            return made.v[:, upto, number], None
        return made.fields["sensordata"][:, upto, self.get_sensor_address(name)], None

    def get_sensor_address(self, channel: str) -> int:
        """Return the column in MuJoCo's sensor data of a channel that is not a state."""
        kind, _, of = channel.partition(".")
        if kind == "tau":
            return self._bench(False, 1).drives[of]
        return next(s for s in self.robot.sensors if s.name == of).address


def _alike(
    acting: ActiveEffects, derived: Mask, asked: Mask
) -> Iterator[tuple[SeriesJoints, int, Places]]:
    """Group batch elements that can be simulated together.

    Yields:
        Effects in series with joints, a bit field (1: derived constants change, 2: forces are
        evaluated in every step), and the indices of the batch elements.
    """
    for series, own in group_by_series_joints(acting, len(derived)).items():
        there = np.zeros(len(derived), dtype=bool)
        there[own] = True
        for kind in range(4):
            of_kind = there & (derived == bool(kind & 1)) & (asked == bool(kind & 2))
            yield series, kind, np.flatnonzero(of_kind)


def make_robot_simulator(
    robot: RobotModel, free: Sequence[str] = (), numerics: IntegratorSettings | None = None
) -> type[RobotSimulator]:
    """Make the simulator class of a robot.

    Args:
        robot: robot as read from its model file.
        free: numbers of the file to tune, such as ``damping@*`` or ``mass@forearm``.
        numerics: time step and integrator; those of the file if None.

    Raises:
        InputError: the robot has no joint with one coordinate, or a name in `free` does not exist.
    """
    numerics = numerics or read_integrator_settings(robot)
    # The class is created at run time, so its source text does not identify the robot; the digest
    # does.
    told = repr((robot.digest, tuple(free), tuple(numerics)))
    told += "" if robot.friction_form == "stiff" else robot.friction_form
    system = make_robot_system(robot, free)
    declared = {
        "system": system,
        "robot": robot,
        "numerics": numerics,
        "free": tuple(free),
        "made_of": tuple(library.get_effect(n) for n in {e.of: 0 for e in system.freed_effects}),
        "source_digest": hashlib.sha256(told.encode()).hexdigest(),
        "__module__": __name__,
        "__doc__": f"The robot of {robot.path.name}.",
    }
    return type("RobotOfFile", (RobotSimulator,), declared)
