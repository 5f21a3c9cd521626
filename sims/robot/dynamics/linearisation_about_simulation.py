"""Linearise a robot's model about a simulated run: responses of its observations to effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sims.core.effect import ActiveEffects, Effect, Input, Sensor
from sims.core.simulator import Array, Scenario
from sims.robot.dynamics.applied_inputs import (
    SAME_INSTANT_SHARE,
    RunInputs,
    compute_changed_inputs,
)
from sims.robot.dynamics.joint_scales import compute_floating_forces, compute_joint_scales
from sims.robot.dynamics.linearisation_points import (
    LINEARISATION_INTERVAL_SECONDS,
    TRANSMISSION_FORCE_FIELDS,
    LinearisationPoints,
    RobotMotion,
)
from sims.robot.dynamics.midpoint_state import compute_midpoint_loads, forces_are_at_step_end
from sims.robot.dynamics.run_batches import BatchInputs, RobotRunBatch
from sims.robot.dynamics.sensor_sampling import (
    apply_effects_to_readings,
    find_sample_steps,
    preserves_time,
    sample_readings,
)
from sims.robot.dynamics.series_joints import is_series_effect
from sims.robot.dynamics.step_jacobians import DifferenceQuotients
from sims.robot.dynamics.tangent_propagation import (
    MAX_SIMULTANEOUS_CHANGES,
    Perturbation,
    TangentModel,
)
from sims.robot.floating_joints import FloatingState
from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.robot_simulator import RobotSimulator
from sims.system_simulator import SystemSimulator

EffectWithCoefficients = tuple[Effect, Array]
"""An effect with its coefficients (k,)."""
FORCE_EVALUATED_EFFECTS = frozenset({"drag.linear", "drag.quadratic", "friction.coulomb"})
"""Model-field effects whose force the effect library computes as well, so that it is used here."""
GEOMETRY_DIFFERENCE_SHARE = 1e-4
"""Share of a change of a geom's size that is used as a finite difference."""
SPRING_EFFECTS = frozenset({"spring.linear", "spring.cubic"})
"""Model-field effects whose force the library computes if the joint's spring rests at zero."""


class RunLinearisation:
    """Linearisation of one run of a robot.

    Attributes:
        held: time in seconds for which difference quotients are reused.
        quotients: difference quotients of another motion nearby, to be reused.
        observed: (T, C) observations of the run.
    """

    held = LINEARISATION_INTERVAL_SECONDS
    quotients: DifferenceQuotients | None = None

    def __init__(
        self, simulator: SystemSimulator, theta: Array, scenario: Scenario, x: Array, v: Array
    ) -> None:
        """Simulate the run, and prepare the tangent linear model about its motion.

        Args:
            simulator: simulator of the robot.
            theta: (P,) values of the P parameters.
            scenario: scenario of the run.
            x: (D,) initial positions of D joints.
            v: (D,) initial velocities.
        """
        assert isinstance(simulator, RobotSimulator), "a robot"
        self._simulator = simulator
        self._clock = float(scenario.times[0])  # time stamp of the first sample
        self._times = scenario.times - self._clock
        self._step_count = simulator.count_steps(self._times)
        acting = simulator.get_active_effects(theta[None])
        commands = simulator.run_inputs(scenario)
        # The run as a batch of one element, with its active effects.
        self._run_batch = RobotRunBatch(scenario, commands, acting, x[None], v[None])
        # Channels that observe MuJoCo's sensors: drive forces (tau.) and sensors (s.).
        self._sensor_channels = [
            c.name for c in simulator.channels if c.name.startswith(("tau.", "s."))
        ]
        with np.errstate(all="ignore"), capture_mujoco_warnings():
            self._motion = self._simulate_nominal_motion()
            self._tangent = self._make_tangent_model()
            # Batch elements that the preparation took, which are part of the cost.
            self._preparation_count = self._tangent.placed_element_count
        # Forces and readings of `_list_perturbations`, by name and coefficients of the effect.
        self._perturbation_cache: dict[tuple[str, bytes], tuple[Array, Array]] = {}
        self.observed = self._observe_nominal_motion()
        # Number of the joints of the file, which come first; joints in series follow them.
        self._joint_count = len(simulator.addresses.positions)

    def _observe_nominal_motion(self) -> Array:
        """Return the observations (T, C) of the motion without perturbations."""
        steps = len(self._motion.x)
        states = np.zeros((1, steps, self._tangent.state_size))
        readings = np.zeros((1, steps, len(self._sensor_channels)))
        observed: Array = self._compute_observations(states, readings, [()])[0]
        return observed

    def _simulate_nominal_motion(self) -> RobotMotion:
        """Simulate the motion of the run, about which the model is linearised.

        One more step is added, so that the state at the run's end is the beginning of a step like
        all others. The motion includes the forces on both sides of the transmissions, on which some
        effects depend. The sensors' readings (S,) at the beginnings of the S steps are stored in
        `_readings`, by channel.
        """
        simulator = self._simulator
        steps = self._step_count + 1
        inputs = simulator.compute_controls(self._run_batch, steps)
        simulated = simulator.step_batch(
            self._run_batch, inputs, (*TRANSMISSION_FORCE_FIELDS, "act")
        )
        mujoco_batch = simulator.make_linearisation_batch(self._run_batch.acting)
        # The batch has one element.
        fields = {name: values[0] for name, values in simulated.fields.items()}
        dofs = mujoco_batch.all_joints.velocities
        # Forces (2, S, D) on both sides of the transmissions: those of the actuators, and those of
        # gravity and motion. After a step, MuJoCo's data has the forces of its beginning, or with
        # Runge-Kutta those of its end, which are converted to those of its middle.
        carried = np.stack([fields[name][:, dofs] for name in TRANSMISSION_FORCE_FIELDS])
        if forces_are_at_step_end(mujoco_batch.model):
            carried = compute_midpoint_loads(carried, inputs.controls[0])
        self._readings = {
            name: fields["sensordata"][:, simulator.get_sensor_address(name)]
            for name in self._sensor_channels
        }
        series_x, series_v = simulated.series
        return RobotMotion(
            x=np.concatenate([simulated.x[0], series_x[0]], axis=1),
            v=np.concatenate([simulated.v[0], series_v[0]], axis=1),
            # Recorded fields begin after the first step, so the initial value is prepended.
            act=np.concatenate([simulated.initial_activations[:1], fields["act"][:-1]]),
            compute_loads=lambda: carried,
            floating_state=self._get_floating_states(simulated.fields),
            step=simulator.time_step,
            **self._compute_command_fields(inputs),
        )

    def _compute_command_fields(self, inputs: BatchInputs) -> dict[str, Any]:
        """Return the fields of a motion that follow from the commands of the run.

        Args:
            inputs: inputs of a batch with one element.

        Returns:
            Arguments of `RobotMotion` by name: mean controls over the steps, forces, controls at
            the beginnings of steps, applied inputs, and whether actuators are off.
        """
        return {
            "controls": inputs.controls[0],
            "forces": self._simulator.make_linearisation_batch(self._run_batch.acting).map_forces(
                inputs.forces[0]
            ),
            "instant": inputs.instant[0],
            "inputs": {name: u[0] for name, u in inputs.applied_inputs.items()},
            "off": inputs.off[0],
        }

    def _get_floating_states(self, fields: Mapping[str, Array]) -> FloatingState:
        """Return poses and velocities of floating bodies at the beginnings of steps and at the end.

        Args:
            fields: recorded `qpos` and `qvel` after each step, (1, S, ...).

        Returns:
            Poses (S + 1, P) of P numbers and velocities (S + 1, F) of F numbers, over S steps.
        """
        start = self._simulator.get_floating_start(self._run_batch)
        floating = self._simulator.make_linearisation_batch(self._run_batch.acting).floating
        pose = fields["qpos"][0][:, floating.positions]
        rate = fields["qvel"][0][:, floating.velocities]
        return FloatingState(
            np.concatenate([start.pose[None], pose]), np.concatenate([start.rate[None], rate])
        )

    def _make_tangent_model(self) -> TangentModel:
        """Make the tangent linear model about the motion of the run (first-order propagation)."""
        simulator = self._simulator
        outputs = [
            ("sensordata", simulator.get_sensor_address(name)) for name in self._sensor_channels
        ]
        mujoco_batch = simulator.make_linearisation_batch(self._run_batch.acting)
        # Typical forces in N or N m, for finite differences: of the joints of the file, of joints
        # in series (the second joints of flexible drives), and of floating bodies. A joint in
        # series transmits the force of its joint.
        file_forces = compute_joint_scales(simulator.robot).force
        series_joints = [self._find_series_joint(name) for name in mujoco_batch.robot.series]
        forces = np.concatenate(
            [file_forces, file_forces[series_joints], compute_floating_forces(simulator.robot)]
        )
        points = LinearisationPoints(
            mujoco_batch,
            simulator.robotic,
            self._motion,
            self._run_batch.acting,
            outputs,
            mujoco_batch.all_joints,
            [self._find_driven_joint(name) for name in self._sensor_channels],
            self.held,
        )
        return TangentModel(points, forces, self.quotients)

    def _find_driven_joint(self, channel: str) -> int:
        """Return the number of the joint whose drive force a channel observes; -1 if none."""
        kind, _, joint = channel.partition(".")
        return self._simulator.system.coordinates.index(f"q.{joint}") if kind == "tau" else -1

    def _find_series_joint(self, second: str) -> int:
        """Return the number of the joint with which a joint is in series."""
        # Its name is that of the joint and an ending.
        joint, _, _ = second.rpartition("_")
        return self._simulator.system.coordinates.index(f"q.{joint}")

    def compute_effect_responses(
        self, added: Sequence[EffectWithCoefficients]
    ) -> tuple[Array, int]:
        """Compute how each of K effects alone would change the run's observations, to first order.

        1. Simulate the run with each effect in series with a joint. Such an effect, for example
           backlash, changes the motion much however small it is.
        2. All others are perturbations of forces, controls or numbers of the model. Propagate them
           along the motion together, up to `MAX_SIMULTANEOUS_CHANGES` at a time.

        Args:
            added: effects with their coefficients.

        Returns:
            (K, T, C) changes of the observations at T samples of C channels; and the approximate
            cost as a number of simulations of the run, including the linearisation itself.
        """
        # Cost of earlier calls, as a number of batch elements. The cost of the preparation counts
        # in each call.
        earlier_count = self._tangent.placed_element_count - self._preparation_count
        # Without cached results of earlier calls, the cost does not depend on them.
        self._perturbation_cache.clear()
        responses = np.zeros((len(added), *self.observed.shape))
        (control_changes,) = compute_control_changes([self], added)
        # 1. Simulations.
        in_series = [i for i, (effect, _) in enumerate(added) if is_series_effect(effect)]
        if in_series:
            responses[in_series] = (
                self._simulate_with_effects([added[i] for i in in_series]) - self.observed
            )
        # 2. Propagation.
        for begin in range(0, len(added), MAX_SIMULTANEOUS_CHANGES):
            block = range(begin, min(begin + MAX_SIMULTANEOUS_CHANGES, len(added)))
            changes, sensors = self._list_changes(added, block, control_changes)
            # A change that overflows is one that a fit could not follow.
            with np.errstate(all="ignore"):
                states, readings = self._tangent.propagate(changes, len(block))
                observations = self._compute_observations(states, readings, sensors)
            not_in_series = np.setdiff1d(block, in_series).astype(np.intp)
            rows_of_block = not_in_series - block.start
            responses[not_in_series] = (observations - self.observed)[rows_of_block]
        # One simulation of S steps costs as much as S batch elements that make one step.
        placed_count = self._tangent.placed_element_count - earlier_count
        simulations = placed_count // len(self._motion.controls)
        return responses, 1 + len(in_series) + simulations

    def _list_changes(
        self,
        added: Sequence[EffectWithCoefficients],
        effect_indices: range,
        control_changes: Mapping[int, Sequence[Perturbation]],
    ) -> tuple[list[Perturbation], list[ActiveEffects]]:
        """Divide some added effects into perturbations of the motion and effects on sensors.

        A family, one effect at all places, may have both. Effects in series with joints have no
        perturbation.

        Args:
            added: effects with their coefficients.
            effect_indices: indices in `added` of the effects to divide; the first owns the
                perturbations with owner 0, the second those with owner 1, and so on.
            control_changes: changes of the controls by effects on inputs, by index in `added`.

        Returns:
            Perturbations of the motion by all these effects, and the sensor effects of each one.
        """
        changes: list[Perturbation] = []
        sensors: list[ActiveEffects] = []
        for owner, effect_index in enumerate(effect_indices):
            effect, c = added[effect_index]
            # The effect at each of its places, with coefficients (k, 1, 1).
            parts = effect.parts(c[:, None, None])
            sensors.append(
                tuple((part, part_c) for part, part_c in parts if isinstance(part, Sensor))
            )
            for part, part_c in parts:
                is_handled_otherwise = isinstance(part, (Sensor, Input)) or is_series_effect(part)
                if not is_handled_otherwise and part_c.any():
                    changes += self._list_perturbations(owner, part, part_c)
            # Their owners are indices in `added`, which are replaced by those among these effects.
            input_changes = control_changes.get(effect_index, ())
            changes += [change._replace(owner=owner) for change in input_changes]
        return changes, sensors

    def _simulate_with_effects(self, added: Sequence[EffectWithCoefficients]) -> Array:
        """Simulate observations (K, T, C) of the run with each of K effects added, one at a time.

        All are simulated in one batch, in which each element has the effects of the run and one
        more. An added effect that contains a simpler one of the run, as Stribeck friction contains
        Coulomb friction, takes its coefficient over and replaces it. The result has T samples of C
        channels.
        """
        count, run = len(added), self._run_batch
        # Coefficients (k, K, 1) of the effects of the run, in all elements.
        run_effects = [(e, np.repeat(c, count, axis=1)) for e, c in run.acting]
        # Each added effect has coefficients in its own element, and zeros in all others.
        added_effects = []
        for element, (effect, c) in enumerate(added):
            for simpler, run_c in run_effects:
                if simpler.name in effect.contains and run_c[:, element].any():
                    c = effect.taking(c, simpler.name, run_c[:, element, 0].copy())
                    run_c[:, element] = 0.0
            coefficients = np.zeros((len(c), count, 1))
            coefficients[:, element, 0] = c
            added_effects.append((effect, coefficients))
        acting = (*run_effects, *added_effects)
        x, v = np.repeat(run.x, count, axis=0), np.repeat(run.v, count, axis=0)
        return self._simulator.simulate_observations(run._replace(acting=acting, x=x, v=v))

    def compute_initial_state_responses(self) -> Array:
        """Compute the derivatives of observations by initial positions and velocities.

        Returns:
            (2 D, T, C) derivatives by D initial positions, then by D initial velocities, of C
            channels at T samples.
        """
        with np.errstate(all="ignore"):
            states, readings = self._tangent.propagate_initial_state()
        # The changes are small enough for nonlinear sensor effects to be linear.
        small_change = 1e-4
        observations = self._compute_observations(
            small_change * states, small_change * readings, [()] * len(states)
        )
        derivatives: Array = (observations - self.observed) / small_change
        by_position, by_velocity = np.split(derivatives, 2)
        # Joints in series, which come last, are left out.
        return np.concatenate([by_position[: self._joint_count], by_velocity[: self._joint_count]])

    def _list_perturbations(self, owner: int, effect: Effect, c: Array) -> list[Perturbation]:
        """Return the perturbations by an effect that acts on neither inputs nor sensors.

        The cases are:

        * An added armature (inertia of a rotor) is the force -c times the joint's acceleration.
        * An effect whose force can be computed is that force along the motion.
        * Any other effect changes numbers of MuJoCo's model. The accelerations with and without it
          are compared, and the result is cached.

        Args:
            owner: number of the candidate to which the perturbations belong.
            effect: effect at one place.
            c: (K, 1, 1) its K coefficients.
        """
        # Name of the registered effect, without a place; index of its joint, or None.
        name = effect.of or effect.name
        joint = effect.coordinate
        if name == "inertia.armature" and joint is not None:
            series = -float(c[0, 0, 0]) * self._tangent.accelerations[:, joint]
            return [Perturbation(owner, joint=joint, series=series)]
        if (
            name not in MODEL_FIELD_EFFECTS
            or name in FORCE_EVALUATED_EFFECTS
            or self._is_centred_spring(name, joint)
        ):
            return self._tangent.perturb_by_force(owner, effect, c)
        key = effect.name, c.tobytes()
        if key not in self._perturbation_cache:
            # The whole change could press a geom into another one, or end a contact. So only a
            # small share of it is made, and the result is divided by the share.
            is_geometry = "geom_size" in MODEL_FIELD_EFFECTS[name].fields
            share = GEOMETRY_DIFFERENCE_SHARE if is_geometry else 1.0
            acting = (*self._run_batch.acting, (effect, share * c))
            with capture_mujoco_warnings():
                mujoco_batch = self._simulator.make_linearisation_batch(acting)
                self._perturbation_cache[key] = self._tangent.perturb_model_numbers(
                    acting, share, mujoco_batch
                )
        forces, readings = self._perturbation_cache[key]
        return [Perturbation(owner, forces=forces, readings=readings)]

    def _is_centred_spring(self, name: str, joint: int | None) -> bool:
        """Return whether an effect is a spring at a joint whose rest position is zero.

        The library's springs have the rest position zero, but a joint stiffness in MuJoCo has the
        rest position `qpos_spring`. Only where both agree can the change be computed from the
        effect's force, which is cheaper than a changed model.

        Args:
            name: name of the effect, without its place.
            joint: index of its joint; None if it acts elsewhere.
        """
        if name not in SPRING_EFFECTS or joint is None:
            return False
        simulator = self._simulator
        rest = simulator.robot.compiled.qpos_spring[simulator.addresses.positions[joint]]
        return bool(rest == 0.0)

    def _get_inputs_with_effects(self, input_effects: ActiveEffects) -> RunInputs:
        """Return the inputs of the run for n batch elements, each with one more input effect.

        So the responses to all input effects are computed together. If the run itself has the same
        effect, its coefficients are replaced in that element.

        Args:
            input_effects: the further effect of each of the n batch elements, with its K
                coefficients, (K, 1, 1).
        """
        count = len(input_effects)
        # Effects by name, with coefficients (K, n, 1): those of the run in all elements, then one
        # further effect in each element.
        acting: dict[str, tuple[Effect, Array]] = {}
        for run_effect, run_c in self._run_batch.acting:
            if isinstance(run_effect, Input):
                acting[run_effect.name] = run_effect, np.repeat(run_c, count, axis=1)
        for element, (effect, c) in enumerate(input_effects):
            _, coefficients = acting.setdefault(effect.name, (effect, np.zeros((len(c), count, 1))))
            coefficients[:, element] = c[:, 0]
        steps = len(self._motion.controls)
        scenario, commands = self._run_batch.scenario, self._run_batch.commands
        return RunInputs(scenario, commands, tuple(acting.values()), count, steps)

    def _compute_observations(
        self, states: Array, readings: Array, sensors: Sequence[ActiveEffects]
    ) -> Array:
        """Compute observations (n, T, C) of n perturbed motions, with further sensor effects.

        Positions and velocities are those of the motion plus their changes; other channels are
        sensor readings plus their changes. Then the sensor effects act on them. The C channels are
        sampled at the T times of the run.

        Args:
            states: (n, S, Z) changes of the Z state components at the beginnings of S steps.
            readings: (n, S, M) changes of the readings of M sensor channels.
            sensors: further sensor effects of each of the n motions.
        """
        simulator, count = self._simulator, len(states)
        instants = self._step_count + 1  # beginnings of the steps of the run, and its end
        position_count = self._motion.x.shape[1]
        run_effects = tuple((e, np.repeat(c, count, axis=1)) for e, c in self._run_batch.acting)
        columns = []
        # Steps (T,) at whose beginnings the samples are; None if a sample is within a step.
        sample_steps = find_sample_steps(simulator.time_step, self._times, instants)
        for channel in simulator.channels:
            acting = _select_sensor_effects(channel.name, run_effects, sensors)
            # If all samples are at beginnings of steps, only these steps are needed. A sensor
            # effect that shifts time or filters needs all steps, which None stands for.
            needed_steps = sample_steps if preserves_time(acting) else None
            rows: slice | NDArray[np.intp] = (
                slice(instants) if needed_steps is None else needed_steps
            )
            kind, _, joint_name = channel.name.partition(".")
            slopes = None
            if kind in ("q", "qd"):
                # Velocities follow the positions in a state.
                j = simulator.system.coordinates.index(f"q.{joint_name}")
                velocity_column = position_count + j
                column = j if kind == "q" else velocity_column
                motion = self._motion.x if kind == "q" else self._motion.v
                values = motion[rows, j] + states[:, rows, column]
                # Positions are interpolated between steps with their velocities.
                if kind == "q" and needed_steps is None:
                    slopes = self._motion.v[rows, j] + states[:, rows, velocity_column]
            else:
                column = self._sensor_channels.index(channel.name)
                values = self._readings[channel.name][rows] + readings[:, rows, column]
            if needed_steps is None:
                step, times = simulator.time_step, self._times
                columns.append(sample_readings(values, slopes, step, times, acting, self._clock))
            else:
                columns.append(apply_effects_to_readings(values, self._times, acting, self._clock))
        return np.stack(columns, axis=2)


def compute_control_changes(
    runs: Sequence[RunLinearisation], added: Sequence[EffectWithCoefficients]
) -> list[dict[int, list[Perturbation]]]:
    """Compute the changes of controls by added input effects, such as a gain or a delay.

    Input effects act before the robot, so their changes of the controls are exact; only the
    response of the motion to them is linearised, later. The steps are:

    1. List the input effects at one place each. Each is an element of a batch.
    2. Compute the changed inputs of all runs together: their means over the steps, which move the
       robot; and, if drive forces are observed, their values at the beginnings of the steps, which
       a sensor of the drive force shows.
    3. Subtract the controls of the run's motion.

    Args:
        runs: linearisations of runs of one simulator.
        added: effects with their coefficients; those that do not act on inputs are ignored.

    Returns:
        For each run, the changes by index of the effect in `added`.
    """
    # 1. Input effects.
    changes_by_run: list[dict[int, list[Perturbation]]] = [{} for _ in runs]
    effect_indices: list[int] = []  # index in `added` of each of the input effects
    input_effects: list[tuple[Effect, Array]] = []
    for effect_index, (effect, c) in enumerate(added):
        for part, part_c in effect.parts(c[:, None, None]):
            if isinstance(part, Input) and part_c.any():
                effect_indices.append(effect_index)
                input_effects.append((part, part_c))
    if not input_effects:
        return changes_by_run
    # 2. Changed inputs, by run and batch element: for each share of a step, values (S,). The whole
    # step gives the mean; a tiny share at its beginning gives the value there.
    simulator, names = runs[0]._simulator, runs[0]._sensor_channels
    inputs = [run._get_inputs_with_effects(tuple(input_effects)) for run in runs]
    shares = [1.0]
    if any(name.startswith("tau.") for name in names):  # drive forces
        shares.append(SAME_INSTANT_SHARE)
    control_indices = {f"u.{a.name}": a.control for a in simulator.robot.actuators}
    series: dict[tuple[int, int], list[Array]] = {}
    for share in shares:
        for run, name, elements, values in compute_changed_inputs(
            simulator.time_step, inputs, share
        ):
            for element, series_row in zip(elements.tolist(), values, strict=True):
                # An element may also have an effect of the run, on another input.
                effect, _ = input_effects[element]
                if effect.signal == name:
                    series.setdefault((run, element), []).append(series_row)
    # 3. Changes of controls. `instants` is empty if drive forces are not observed.
    for (run, element), (means, *instants) in sorted(series.items()):
        effect_index, (effect, _) = effect_indices[element], input_effects[element]
        if effect.signal not in control_indices:  # a force, which is not an actuator's control
            continue
        column, motion = control_indices[effect.signal], runs[run]._motion
        mean_change = means - motion.controls[:, column]
        change = Perturbation(
            effect_index,
            actuator=column,
            series=mean_change,
            instant=instants[0] - motion.instant[:, column] if instants else mean_change,
        )
        changes_by_run[run].setdefault(effect_index, []).append(change)
    return changes_by_run


def _select_sensor_effects(
    channel: str, run_effects: ActiveEffects, extra_effects: Sequence[ActiveEffects]
) -> ActiveEffects:
    """Return the sensor effects on a channel: those of the run, then the additional ones.

    Each batch element has its own additional effects. They are joined by name, so that an effect is
    evaluated once for all elements.

    Args:
        channel: name of the channel.
        run_effects: effects that are active in the run, with K coefficients each, (K, L, 1).
        extra_effects: additional effects of each of the L batch elements, with coefficients
            (K, 1, 1).

    Returns:
        Effects with coefficients (K, L, 1). Those of an additional effect are zero in all elements
        that do not have it.
    """
    # An effect without a signal acts on all channels.
    acting = [(e, c) for e, c in run_effects if isinstance(e, Sensor) and e.signal in ("", channel)]
    added: dict[str, tuple[Effect, Array]] = {}
    for element, parts in enumerate(extra_effects):
        for effect, c in parts:
            if effect.signal not in ("", channel):
                continue
            _, coefficients = added.setdefault(
                effect.name, (effect, np.zeros((len(c), len(extra_effects), 1)))
            )
            coefficients[:, element] = c[:, 0]
    return (*acting, *added.values())
