"""Simulator of a robot's model file, for tuners and for explain.

MuJoCo uses the time step and the integrator of the model file. Samples of a log may be at any time:
between two steps, positions are interpolated by the cubic with the positions and velocities of both
ends, and other readings linearly. The control of an actuator over a step is the mean of its command
over the step.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np

from sims import effects as library
from sims.core.effect import ActiveEffects, Effect, Sensor
from sims.core.engine import Engine
from sims.core.simulator import Array, InputError, Scenario, make_unknown_name_error
from sims.core.toml_validation import format_value
from sims.engines.scenario_groups import ScenarioGroups, group_scenarios
from sims.robot.dynamics.activation_filters import (
    activation_filters,
    compute_initial_activation,
    select_initial_activations,
)
from sims.robot.dynamics.active_effects import (
    find_active_elements,
    is_evaluated_per_step,
    pad_coefficients,
    slice_active_effects,
)
from sims.robot.dynamics.added_elements import AddedElements, group_by_added_elements
from sims.robot.dynamics.applied_inputs import (
    SAME_INSTANT_SHARE,
    STEP_COUNT_TOLERANCE,
    compute_inputs_over_steps,
)
from sims.robot.dynamics.disabled_drives import compute_off_steps, find_working_servos
from sims.robot.dynamics.drive_force_sensors import DriveSensorModel
from sims.robot.dynamics.effect_force_program import StepForces
from sims.robot.dynamics.effect_forces import compute_time_dependent_forces
from sims.robot.dynamics.mujoco_batch import (
    BATCH_SIZE,
    JointAddresses,
    MujocoBatch,
    RefusedModelError,
    get_batch_cache,
)
from sims.robot.dynamics.run_batches import (
    BatchInputs,
    BatchResult,
    BatchStart,
    RobotRunBatch,
    group_by_run,
    split_into_batches,
)
from sims.robot.dynamics.sensor_sampling import list_last_read_times, sample_readings
from sims.robot.dynamics.stepping_with_forces import step_with_forces
from sims.robot.floating_joints import FloatingJoints, FloatingState
from sims.robot.integrator_settings import (
    INTEGRATOR_IDS,
    RK4_INTEGRATOR_ID,
    IntegratorSettings,
    RobotEngine,
    read_integrator_settings,
)
from sims.robot.model_field_effects import changes_derived_constants, select_model_field_effects
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.robot_model import FrictionForm, RobotModel
from sims.robot.robot_system import RobotSystem, make_robot_system
from sims.system_simulator import SystemSimulator

ENGINE_SETTINGS = ("timestep", "integrator")
"""Settings of the engine that a recording or an experiment may specify."""
LINEARISATION_BATCH_SIZE = 128
"""Batch size for linearisation: number of points of a motion that are evaluated together."""


class RobotSimulator(SystemSimulator):
    """Base class of robot simulators; `make_robot_simulator` makes one from a model file.

    Attributes:
        robot: the robot.
        numerics: time step, integrator and changed options of the solver.
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

        A coefficient, such as a joint's damping, may be freed in the model itself (`free`) or
        belong to an effect that the caller gives, but not both. The arguments are those of
        `SystemSimulator`.

        Raises:
            InputError: a number is a parameter twice.
        """
        super().__init__(*args, **kwargs)
        repeated_names = [
            effect.name for effect in self.effects if self.system.is_free(type(effect))
        ]
        if repeated_names:
            raise InputError(f"effect {repeated_names[0]}: its coefficient is free already")
        # Effects whose coefficients are the free numbers of the model file.
        freed_effects = self.system.freed_effects
        self._freed_effects: list[Effect] = [effect() for effect in freed_effects]
        self.robotic = self.system()
        self.addresses = JointAddresses(self.robot)
        self._floating = FloatingJoints.from_robot(self.robot)

    def _make_engine(self, name: str | None, settings: Mapping[str, Any]) -> Engine:
        """Return MuJoCo as the engine, with checked settings of the time step and the integrator.

        Other engines are refused, since a model file describes a robot for MuJoCo.

        Args:
            name: name of the engine; None for MuJoCo.
            settings: settings by name, such as ``timestep``.
        """
        if name not in (None, "mujoco"):
            raise InputError(f"robot {self.name} steps in MuJoCo; it has no engine '{name}'")
        for setting in settings:
            if setting not in ENGINE_SETTINGS:
                raise make_unknown_name_error("setting of engine mujoco", setting, ENGINE_SETTINGS)
        numerics = self.numerics._replace(**settings)
        if numerics.integrator not in INTEGRATOR_IDS:
            raise make_unknown_name_error(
                "integrator", str(numerics.integrator), list(INTEGRATOR_IDS)
            )
        if not (isinstance(numerics.timestep, float) and numerics.timestep > 0):
            value_text = format_value(numerics.timestep)
            raise InputError(f"timestep must be a positive number of seconds, found {value_text}")
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
    def with_contacts(cls, contacts: tuple[str, ...]) -> type[RobotSimulator]:
        """Make the simulator of the same robot with the contacts of a recording as candidates.

        Args:
            contacts: names of pairs of geoms (`sims.robot.contact_pairs`).
        """
        return make_robot_simulator(cls.robot.with_contacts(contacts), cls.free, cls.numerics)

    @classmethod
    def with_half_step(cls) -> type[RobotSimulator]:
        """Make the simulator of the same robot with half the time step."""
        return cls.with_integrator_settings(
            cls.numerics._replace(timestep=0.5 * cls.numerics.timestep)
        )

    @cached_property
    def _model_options(self) -> dict[str, float]:
        """Options of the model with the settings of the engine."""
        assert isinstance(self.engine, RobotEngine)
        return self.engine.numerics.to_model_options()

    @property
    def time_step(self) -> float:
        """Step length in seconds."""
        return self.engine.largest_step

    def _make_active_effects(self, theta: Array) -> ActiveEffects:
        """Return the effects whose coefficients are not all zero, each at one place.

        Effects of free parameters of the model come first; then those that the simulator was
        created with. The base class takes the latter from the columns of `theta` after those of
        the free parameters. A family, one effect at all places, is divided into its members.

        Args:
            theta: (L, P) P parameters of L batch elements: first the free ones, then coefficients
                of effects.

        Returns:
            Effects with K coefficients each, (K, L, 1).
        """
        effects: list[tuple[Effect, Array]] = []
        column = 0
        for effect in self._freed_effects:
            count = len(effect.coefficients)
            c = theta[:, column : column + count].T[:, :, None]  # (K, L, 1)
            effects.append((effect, c))
            column += count
        effects += super()._make_active_effects(theta)
        placed_effects = [placed for effect, c in effects if c.any() for placed in effect.parts(c)]
        # A member of a family may be zero although the family is not.
        return tuple((effect, c) for effect, c in placed_effects if c.any())

    def get_active_effects(self, theta: Array) -> ActiveEffects:
        """Return the active effects at one place each, for rows of parameters.

        Shapes: L batch elements, K coefficients.

        Args:
            theta: (L, P) values of the P parameters.

        Returns:
            Effects with their coefficients (K, L, 1).
        """
        return self._make_active_effects(theta)

    def _simulate_observations(
        self, theta: Array, scenarios: Sequence[Scenario], initial: Mapping[str, Array]
    ) -> Array:
        """Simulate observations (L, T, C) of L batch elements at T samples of C channels.

        Elements with equal scenarios are one run, whose inputs are computed once.

        Args:
            theta: (L, P) values of the P parameters.
            scenarios: scenario of each element.
            initial: initial states by name, (L,) each.
        """
        acting = self._make_active_effects(theta)
        runs = group_scenarios(scenarios, by_initial=True)
        commands = [self.run_inputs(s) for s in runs.unique_scenarios]
        # Initial positions and velocities (L, D). A robot has no constants, the first result.
        _, x, v = self._collect_known_values(scenarios, initial)
        return self._simulate_elements(acting, runs, commands, x, v)

    def simulate_observations(self, batch: RobotRunBatch) -> Array:
        """Simulate observations (n, T, C) of the batch elements of one run."""
        runs = ScenarioGroups((batch.scenario,), np.zeros(len(batch.x), dtype=np.intp))
        return self._simulate_elements(batch.acting, runs, [batch.commands], batch.x, batch.v)

    def _simulate_elements(
        self,
        acting: ActiveEffects,
        runs: ScenarioGroups,
        commands: Sequence[Mapping[str, Array]],
        x: Array,
        v: Array,
    ) -> Array:
        """Simulate observations (L, T, C) of L batch elements at T samples of C channels.

        Elements are simulated together, up to `BATCH_SIZE`, if their effects need the same model.
        Elements whose model MuJoCo rejects, or whose motion diverges, are NaN; so are samples
        beyond the end of a shorter run.

        Args:
            acting: effects with K coefficients each, (K, L, 1).
            runs: the distinct scenarios (runs), and the index of the scenario of each element.
            commands: values of each input, by name, of each distinct scenario.
            x: (L, D) initial positions of D joints.
            v: (L, D) initial velocities.
        """
        max_samples = max(s.times.size for s in runs.unique_scenarios)
        all_observations = np.full((len(x), max_samples, len(self.channels)), np.nan)
        # A diverging batch element becomes NaN, so floating-point warnings are suppressed.
        with np.errstate(all="ignore"), capture_mujoco_warnings():
            for batch_indices in split_into_batches(acting, runs, BATCH_SIZE):
                groups = group_by_run(runs, batch_indices)
                run_batches = [
                    RobotRunBatch(
                        runs.unique_scenarios[run],
                        commands[run],
                        slice_active_effects(acting, run_indices),
                        x[run_indices],
                        v[run_indices],
                    )
                    for run, run_indices in groups
                ]
                try:
                    run_observations = self._simulate_run_batch(
                        run_batches, slice_active_effects(acting, batch_indices)
                    )
                except RefusedModelError:
                    # These elements stay NaN, like those of a diverging motion; the others are
                    # simulated.
                    continue
                for (_, run_indices), observations in zip(groups, run_observations, strict=True):
                    all_observations[run_indices, : observations.shape[1]] = observations
        # Negative zeros become positive, so that results do not depend on their origin.
        all_observations += 0.0
        return all_observations

    def _simulate_run_batch(
        self, run_batches: Sequence[RobotRunBatch], acting: ActiveEffects
    ) -> list[Array]:
        """Simulate the batch elements of several runs in one batch.

        Args:
            run_batches: batch elements of each run.
            acting: active effects with their coefficients for all batch elements, run after run.

        Returns:
            Observations (n, T, C) of each run: n elements, T samples, C channels.
        """
        # A sensor at the end needs a further step, since MuJoCo computes its reading within the
        # step that begins then. Without sensors no step is added.
        extra_steps = int(self._reads_sensors())
        step_counts = [self.count_steps(list_last_read_times(batch)) for batch in run_batches]
        run_inputs = [
            self.compute_controls(batch, count + extra_steps)
            for batch, count in zip(run_batches, step_counts, strict=True)
        ]
        inputs = BatchInputs.concatenate(run_inputs)
        x = np.concatenate([batch.x for batch in run_batches])
        v = np.concatenate([batch.v for batch in run_batches])
        stepped = self._simulate_steps(
            BatchStart(x, v, acting, self._get_floating_states(run_batches)), inputs
        )
        observations = []
        first = 0
        for batch, count in zip(run_batches, step_counts, strict=True):
            run_elements = slice(first, first + len(batch.x))
            observations.append(
                self._compute_observations(stepped.select(run_elements), batch, batch.times, count)
            )
            first += len(batch.x)
        return observations

    def _get_floating_states(self, run_batches: Sequence[RobotRunBatch]) -> FloatingState:
        """Return the initial poses and velocities of floating bodies, run after run.

        All batch elements of a run begin in the same state, which is repeated for each of them.

        Args:
            run_batches: batch elements of each run.

        Returns:
            Poses (L, P) of P numbers and velocities (L, F) of F numbers, of the L elements of all
            runs.
        """
        poses, rates = zip(*map(self.get_floating_start, run_batches), strict=True)
        sizes = [len(batch.x) for batch in run_batches]
        return FloatingState(np.repeat(poses, sizes, axis=0), np.repeat(rates, sizes, axis=0))

    def get_floating_start(self, batch: RobotRunBatch) -> FloatingState:
        """Return the initial state of floating bodies, from the recording or the model file."""
        return self._floating.get_initial_state(
            self.run_initial(batch.scenario) if self._floating else {}
        )

    def count_steps(self, times: Array) -> int:
        """Return the number of steps to the last of some times since the start."""
        return max(int(np.ceil(times[-1] / self.time_step - STEP_COUNT_TOLERANCE)), 1)

    @cached_property
    def _records_drive_forces(self) -> bool:
        """True if drive forces are recorded."""
        return any(c.name.startswith("tau.") for c in self.channels)

    @cached_property
    def _rate_controlled_actuators(self) -> frozenset[int]:
        """Actuators whose second control is the rate of their command."""
        return frozenset(
            a.id for a in self.robot.actuators if a.name in self.robot.rate_controlled_actuators
        )

    def _reads_sensors(self) -> bool:
        """Return whether a recorded channel is computed by MuJoCo within a step."""
        return any(c.name.startswith(("tau.", "s.")) for c in self.channels)

    def compute_controls(self, batch: RobotRunBatch, steps: int) -> BatchInputs:
        """Compute the inputs of the batch elements of one run over all steps.

        The steps are:

        1. Compute the applied inputs, the commands after effects such as a delay: their means over
           the steps, which move the robot. If drive forces are recorded, also compute their values
           at the beginnings of the steps, which a sensor of the drive force shows.
        2. Write them into the controls of the actuators.
        3. Add up the generalised forces on the joints that do not depend on the state.
        4. Compute the activations of the filters before actuators.
        5. Find the steps in which actuators are switched off.

        Args:
            batch: batch elements of the run.
            steps: number of steps.

        Returns:
            For n batch elements and S steps: mean controls (n, S, nu), forces (n, S, nv), applied
            inputs (n, S) by name, controls at the beginnings of the steps, initial activations
            (n, na), and whether each of K actuators is off (n, S, K).
        """
        # 1. Applied inputs (n, S) by name.
        batch_size = len(batch.x)
        compute_inputs = partial(
            compute_inputs_over_steps,
            self.time_step,
            batch.scenario,
            batch.commands,
            batch.acting,
            batch_size,
            steps,
        )
        applied_inputs = compute_inputs()
        initial_inputs = (
            compute_inputs(SAME_INSTANT_SHARE) if self._records_drive_forces else applied_inputs
        )
        # 2. Controls: means over the steps, and values at their beginnings. Without recorded drive
        # forces the latter are not used, and are the same array.
        model = self.robot.compiled
        controls = np.zeros((batch_size, steps, model.nu))
        instant_controls = np.zeros_like(controls) if self._records_drive_forces else controls
        for actuator in self.robot.actuators:
            name = f"u.{actuator.name}"
            controls[:, :, actuator.control] = applied_inputs[name]
            if self._records_drive_forces:
                instant_controls[:, :, actuator.control] = initial_inputs[name]
            # A derivative gain on the error's rate needs the rate of the command.
            if actuator.id in self._rate_controlled_actuators:
                rate = (
                    np.diff(applied_inputs[name], axis=1, prepend=applied_inputs[name][:, :1])
                    / self.time_step
                )
                controls[:, :, actuator.control + 1] = rate
                instant_controls[:, :, actuator.control + 1] = rate
        # 3. Forces: those that are inputs, and those of effects that depend on time alone.
        forces = np.zeros((batch_size, steps, model.nv))
        for joint in self.robot.joints:
            if joint.has_one_coordinate:
                forces[:, :, joint.velocity] = applied_inputs[f"force.{joint.name}"]
        dofs = self.addresses.velocities
        step_starts: Array = self.time_step * np.arange(float(steps))
        forces[:, :, dofs] += compute_time_dependent_forces(
            self.robotic, batch.acting, step_starts, len(dofs), batch_size
        )
        # 4. Activations. A filter's state at the start may follow from commands before the run.
        is_rk4 = self._model_options["integrator"] == RK4_INTEGRATOR_ID

        def compute_past_inputs(scenario: Scenario, steps: int) -> Mapping[str, Array]:
            """Compute the applied inputs (n, S) of a scenario that begins before the run."""
            commands = self.run_inputs(scenario)
            return compute_inputs_over_steps(
                self.time_step, scenario, commands, batch.acting, batch_size, steps
            )

        initial_activations = np.zeros((batch_size, model.na))
        for activation_filter in activation_filters(self.robot):
            filter_controls = controls[:, :, activation_filter.actuator.control]
            initial = compute_initial_activation(
                activation_filter,
                batch.scenario,
                filter_controls,
                self.time_step,
                is_rk4,
                compute_past_inputs,
            )
            initial_activations[:, activation_filter.address] = initial
            # The servo's effective set point is the activation instead of the command.
            activations = activation_filter.compute_activations(
                filter_controls, initial, self.time_step, is_rk4
            )
            applied_inputs[f"u.{activation_filter.actuator.name}"] = activations[:, :-1]
        # 5. Switched actuators.
        off_mask = compute_off_steps(self.robot, batch.scenario, self.time_step, steps)
        return BatchInputs(
            controls,
            forces,
            applied_inputs,
            instant_controls,
            initial_activations,
            np.broadcast_to(off_mask, (batch_size, *off_mask.shape)),
        )

    def run_initial(self, scenario: Scenario) -> dict[str, float]:
        """Return the initial states of a run by name, see `Simulator`.

        Activations of filters, which a recording may state too, are left out, since they are not
        states of the system.

        Args:
            scenario: scenario of the run.
        """
        activations = select_initial_activations(self.robot, scenario.initial)
        state_values = {name: v for name, v in scenario.initial.items() if name not in activations}
        return super().run_initial(replace(scenario, initial=state_values))

    def make_linearisation_batch(self, acting: ActiveEffects = ()) -> MujocoBatch:
        """Return the batch for linearisation, with the elements that effects add to the model.

        Its elements are points of one motion, so all of them have the same effects. The effects may
        change masses, so MuJoCo derives constants from them again.

        Args:
            acting: effects active in the motion, with K coefficients each, (K, 1, 1).
        """
        # One batch element makes one group.
        (added,) = group_by_added_elements(acting, 1)
        return self._get_batch(derived=True, count=LINEARISATION_BATCH_SIZE, added=added)

    def make_half_step_batch(self, acting: ActiveEffects = ()) -> MujocoBatch:
        """Return the batch of `make_linearisation_batch` with half the time step."""
        (added,) = group_by_added_elements(acting, 1)
        settings = self._model_options | {"timestep": 0.5 * self.time_step}
        return get_batch_cache(self.robot).get_batch(
            added, True, LINEARISATION_BATCH_SIZE, settings
        )

    def step_batch(
        self, batch: RobotRunBatch, inputs: BatchInputs, extra_fields: Sequence[str] = ()
    ) -> BatchResult:
        """Step batch elements of one run, whose effects must add the same elements to the model.

        Args:
            batch: batch elements of the run.
            inputs: inputs over the steps.
            extra_fields: additional fields of MuJoCo's data to record.
        """
        start = BatchStart(batch.x, batch.v, batch.acting, self._get_floating_states([batch]))
        return self._simulate_steps(start, inputs, extra_fields)

    def _simulate_steps(
        self, start: BatchStart, inputs: BatchInputs, extra_fields: Sequence[str] = ()
    ) -> BatchResult:
        """Simulate a batch of n elements over all steps, and return its states and readings.

        1. Select a batch of MuJoCo simulations whose model has the elements that effects add.
        2. Write effects that are numbers of the model into it, and set the initial states.
        3. Make the steps. Effects whose force depends on the state are evaluated in each of them.
        4. Collect the states, and correct the readings of drive-force sensors.

        Args:
            start: initial states, and the active effects, which must all add the same elements to
                the model.
            inputs: controls, forces and activations over the steps.
            extra_fields: additional fields of MuJoCo's data to record.

        Returns:
            Positions and velocities (n, S + 1, D) of the D joints at the beginnings of S steps and
            at the end, recorded fields (n, S, ...) by name, initial activations, which elements
            have failed (n,), and the states of joints in series.
        """
        # 1. Batch. All elements need the same added elements, so that there is one group.
        batch_size = len(start.x)
        changes_constants = bool(
            find_active_elements(start.acting, batch_size, changes_derived_constants).any()
        )
        (added,) = group_by_added_elements(start.acting, batch_size)
        # A single simulation uses a small batch, so that constants need not be derived for a whole
        # one.
        mujoco_batch = self._get_batch(
            changes_constants, 1 if batch_size == 1 else BATCH_SIZE, added
        )
        joints, series_joints = mujoco_batch.file_joints, mujoco_batch.series_joints
        # 2. Effects and initial states. Elements of the batch that are not in use have no effects.
        mujoco_batch.write_effects(
            pad_coefficients(
                select_model_field_effects(start.acting), batch_size, mujoco_batch.count
            )
        )
        initial_series = mujoco_batch.set_initial_state(start.x, start.v, start.floating_state)
        mujoco_batch.activate(inputs.activations)
        # 3. Steps.
        field_names = ["qpos", "qvel", *extra_fields]
        if self._reads_sensors():
            field_names.append("sensordata")
        field_names = list(dict.fromkeys(field_names))
        forces = mujoco_batch.map_forces(inputs.forces)
        if find_active_elements(start.acting, batch_size, is_evaluated_per_step).any():
            working_servos = None  # all of them in all steps
            if inputs.off.any():
                working_servos = find_working_servos(
                    mujoco_batch.robot, joints.velocities, inputs.off
                )
            step_forces = StepForces(
                self.robotic,
                start.acting,
                inputs.applied_inputs,
                joints,
                mujoco_batch.get_servo_stiffness(joints)[:batch_size],
                self.time_step,
                working=working_servos,
            )
            recorded_fields = step_with_forces(
                mujoco_batch, inputs.controls, forces, step_forces, field_names, inputs.off
            )
        else:
            recorded_fields = mujoco_batch.step(inputs.controls, forces, field_names, inputs.off)
        # 4. States and readings. Recorded fields begin after the first step.
        x = np.concatenate(
            [start.x[:, None], recorded_fields["qpos"][:, :, joints.positions]], axis=1
        )
        v = np.concatenate(
            [start.v[:, None], recorded_fields["qvel"][:, :, joints.velocities]], axis=1
        )
        # MuJoCo no longer moves failed elements, such as those whose motion diverges.
        x[mujoco_batch.failed] = np.nan
        if self._records_drive_forces:
            sensor_model = DriveSensorModel(
                self.robot, self.robotic, mujoco_batch, inputs, self.time_step
            )
            sensor_model.shift_to_step_begin(recorded_fields["sensordata"])
            sensor_model.add_drive_effects(recorded_fields["sensordata"], x, v, start.acting)
        series_x, series_v = initial_series
        later_x = recorded_fields["qpos"][:, :, series_joints.positions]
        later_v = recorded_fields["qvel"][:, :, series_joints.velocities]
        series_states = (
            np.concatenate([series_x[:, None], later_x], axis=1),
            np.concatenate([series_v[:, None], later_v], axis=1),
        )
        return BatchResult(
            x, v, recorded_fields, inputs.activations, mujoco_batch.failed, series_states
        )

    def _get_batch(self, derived: bool, count: int, added: AddedElements = ()) -> MujocoBatch:
        """Return the batch for this time step and integrator, from the robot's cache.

        Args:
            derived: whether effects change constants that MuJoCo derives.
            count: number of batch elements.
            added: elements that effects add to the model.
        """
        cache = get_batch_cache(self.robot)
        return cache.get_batch(added, derived, count, self._model_options)

    def _compute_observations(
        self, result_of_batch: BatchResult, batch: RobotRunBatch, times: Array, steps: int
    ) -> Array:
        """Compute the recorded observations (n, T, C) of one run, including sensor effects.

        Each of the C channels is interpolated from the steps to its T sample times, after the time
        shifts of its sensor effects. Positions are interpolated with their slopes.

        Args:
            result_of_batch: states and readings of the run's elements; failed ones become NaN.
            batch: the n batch elements of the run.
            times: (T,) sample times in seconds since the start.
            steps: number of steps of the run; the batch may have more.
        """
        columns = []
        clock = float(batch.scenario.times[0])  # time stamp of the start
        for channel in self.channels:
            values, slopes = self._get_channel_values(result_of_batch, channel.name, steps)
            # An effect without a signal acts on all channels.
            sensors = tuple(
                (e, c)
                for e, c in batch.acting
                if isinstance(e, Sensor) and e.signal in ("", channel.name)
            )
            columns.append(sample_readings(values, slopes, self.time_step, times, sensors, clock))
        result = np.stack(columns, axis=2)
        result[result_of_batch.failed] = np.nan
        return result

    def _get_channel_values(
        self, result: BatchResult, name: str, steps: int
    ) -> tuple[Array, Array | None]:
        """Return the values (n, S + 1) of a channel at the beginning and after each of S steps.

        Args:
            result: motion and recorded fields of n batch elements.
            name: name of the channel, such as ``q.elbow``.
            steps: number S of steps.

        Returns:
            The values, and for a position their slopes (n, S + 1), the velocities; otherwise None.
        """
        kind, _, element_name = name.partition(".")
        steps_of_run = slice(steps + 1)  # the batch may have more
        if kind in ("q", "qd"):
            number = self.system.coordinates.index(f"q.{element_name}")
            velocities = result.v[:, steps_of_run, number]
            if kind == "q":
                return result.x[:, steps_of_run, number], velocities
            return velocities, None
        return result.fields["sensordata"][:, steps_of_run, self.get_sensor_address(name)], None

    def get_sensor_address(self, channel: str) -> int:
        """Return the column in MuJoCo's sensor data of a channel that is not a state."""
        kind, _, element_name = channel.partition(".")
        if kind == "tau":
            return self._get_batch(False, 1).drives[element_name]
        return next(s for s in self.robot.sensors if s.name == element_name).address


def make_robot_simulator(
    robot: RobotModel, free: Sequence[str] = (), numerics: IntegratorSettings | None = None
) -> type[RobotSimulator]:
    """Make the simulator class of a robot.

    Args:
        robot: robot as read from its model file.
        free: numbers of the model file that become parameters, such as ``damping@*`` (of all
            joints) or ``mass@forearm``.
        numerics: time step and integrator; those of the file if None.

    Raises:
        InputError: the robot has no joint with one coordinate, or a name in `free` does not exist.
    """
    numerics = numerics or read_integrator_settings(robot)
    # The class is created at run time, so its source text does not identify the robot; the digest
    # does.
    identity_text = repr((robot.digest, tuple(free), tuple(numerics)))
    # "stiff" is the default. It adds nothing, so that digests from before this option stay valid.
    identity_text += "" if robot.friction_form == "stiff" else robot.friction_form
    identity_text += "".join(robot.contacts)
    system = make_robot_system(robot, free)
    attributes = {
        "system": system,
        "robot": robot,
        "numerics": numerics,
        "free": tuple(free),
        # Classes whose source code the digest of this class includes: the effects of the values
        # in `free`.
        "made_of": tuple(
            library.get_effect(n) for n in dict.fromkeys(e.of for e in system.freed_effects)
        ),
        "source_digest": hashlib.sha256(identity_text.encode()).hexdigest(),
        "__module__": __name__,
        "__doc__": f"The robot of {robot.path.name}.",
    }
    return type("RobotOfFile", (RobotSimulator,), attributes)
