"""Linearise a robot's model about a recorded motion, from sample to sample.

`dynamics.linearisation_about_simulation` linearises about a simulated motion, which may be far from
the data. Here the motion is given, such as a smoothed measurement, with the state x̄[t] at step t.
The model's step F differs from it by the defect

    d[t] = x̄[t+1] - F(x̄[t], u[t])                                                            (1)

so that a deviation δ = x - x̄ of the true state follows, to first order,

    δ[t+1] = A[t] δ[t] - d[t] + B[t] (f[t] + Σ_k c_k φ_k[t])                                   (2)

with a generalised force f that the model lacks, and the force φ_k of a candidate effect k with
coefficient c_k. Composed over the steps between two samples i and i + 1,

    δ[i+1] = A_i δ[i] - d_i + G_i f_i + Σ_k c_k b_ik                                           (3)
    y[i] = h(x̄[i]) + H_i δ[i] + Σ_k c_k ψ_ik                                                   (4)

where f_i is constant between samples, and ψ is the direct change of a reading by an effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sims.core.effect import ActiveEffects
from sims.core.simulator import Array, Scenario
from sims.robot.dynamics.active_effects import LOAD_DEPENDENT_EFFECTS
from sims.robot.dynamics.linearisation_about_simulation import (
    EffectWithCoefficients,
    RunLinearisation,
    compute_control_changes,
)
from sims.robot.dynamics.linearisation_points import (
    LINEARISATION_INTERVAL_SECONDS,
    TRANSMISSION_FORCE_FIELDS,
    LinearisationPoints,
    RobotMotion,
)
from sims.robot.dynamics.midpoint_state import IndexArray, forces_are_at_step_end
from sims.robot.dynamics.series_joints import is_series_effect
from sims.robot.dynamics.tangent_propagation import Perturbation
from sims.robot.floating_joints import FloatingJoints, FloatingState
from sims.robot.loop_closure import follow_measured_joints, list_following_joints
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.robot_simulator import RobotSimulator
from sims.system_simulator import SystemSimulator

SingleArray = NDArray[np.float32]

MAX_DEVIATION = 1e3
"""Maximum deviation of a smoothed state from the measured motion, in SI units."""
CANDIDATES_PER_BLOCK = 64
"""Number of candidates whose responses are computed together."""
MAX_JACOBIAN_SECONDS = 0.02
"""Maximum time in seconds for which a Jacobian is held, if no longer time is given."""
STATE_DIFFERENCE = 1e-4
"""Size of the state difference for finite-difference derivatives of readings."""


class Trajectory(NamedTuple):
    """States of one run at the beginnings of all steps and at the end.

    Attributes:
        x: (S + 1, D) positions of the joints.
        v: (S + 1, D) velocities of the joints.
        floating_state: (S + 1, P) poses and (S + 1, F) velocities of floating joints.
    """

    x: Array
    v: Array
    floating_state: FloatingState


@dataclass(frozen=True)
class IntervalMaps:
    """The linear model (3) and (4) of one run with T samples.

    There are Z state components, E forces, and C channels.

    Attributes:
        states: A (T - 1, Z, Z).
        defects: d (T - 1, Z).
        forces: G (T - 1, Z, E).
        inputs: (T - 1, Z, E + nu) responses to constant forces and controls.
        readings: H (T, C, Z).
        predicted: h(x̄) (T, C).
        jumps: (T - 1, Z) standard deviations of state jumps at force limits of servos.
    """

    states: Array
    defects: Array
    forces: Array
    inputs: Array
    readings: Array
    predicted: Array
    jumps: Array


class MeasuredLinear(RunLinearisation):
    """The linear model of one run about a given motion."""

    def __init__(
        self,
        simulator: SystemSimulator,
        theta: Array,
        scenario: Scenario,
        start: tuple[Array, Array],
        trajectory: Trajectory | None = None,
        measured: Mapping[int, Array] | None = None,
        nearby: MeasuredLinear | None = None,
        reuses_jacobians: bool = True,
        reuses_loads: bool = False,
        min_jacobian_seconds: float = LINEARISATION_INTERVAL_SECONDS,
    ) -> None:
        """Linearise about the given motion, and compute its readings and the step of each sample.

        The derivatives of a step (Jacobians) are computed by differences, and held for one sample
        interval up to `MAX_JACOBIAN_SECONDS`, or for a given time if that is longer. With `nearby`,
        a model of a similar motion, most of this work is saved.

        Args:
            simulator: simulator of the robot.
            theta: (P,) values of the P parameters of the simulator.
            scenario: scenario of the run, with its T sample times.
            start: (D,) positions and velocities of D joints at which the simulated motion begins.
            trajectory: given motion at all steps.
            measured: alternative to `trajectory`: (T, 3) position, velocity and acceleration at the
                T samples, by joint number; all other joints follow the simulation.
            nearby: linear model of a similar motion, whose commands and readings are reused.
            reuses_jacobians: whether its Jacobians are reused as well.
            reuses_loads: whether the loads of its transmissions are reused as well, unless an
                active effect depends on them.
            min_jacobian_seconds: minimum time in seconds for which a Jacobian is held.
        """
        self._trajectory, self._measured, self._nearby = trajectory, measured or {}, nearby
        self._reuses_loads = reuses_loads
        if nearby is not None and reuses_jacobians:
            # The base class takes these Jacobians (difference quotients) instead of computing them.
            self.quotients = nearby._tangent.quotients
        # Time in seconds for which the base class holds a Jacobian.
        spacing = float(np.median(np.diff(scenario.times))) if scenario.times.size > 1 else 0.0
        self.held = max(min(spacing, MAX_JACOBIAN_SECONDS), min_jacobian_seconds)
        super().__init__(simulator, theta, scenario, *start)
        if self._sensor_channels:
            # The base class has stored the readings of the simulated motion. They are replaced by
            # those that MuJoCo's sensors would show in the given motion.
            with np.errstate(all="ignore"), capture_mujoco_warnings():
                readings = self._tangent.motion_readings
            self._readings = dict(zip(self._sensor_channels, readings.T, strict=True))
        with np.errstate(all="ignore"), capture_mujoco_warnings():
            self.observed = self._observe_nominal_motion()
        # Numbers (T,) of the steps at whose beginnings the samples are.
        knots = np.rint(self._times / self._simulator.time_step).astype(np.intp)
        self.knots: IndexArray = np.clip(knots, 0, self._step_count)

    @property
    def step(self) -> float:
        """Time step of the simulator in seconds."""
        return self._motion.step

    @property
    def positions(self) -> int:
        """Number of positions in a state, including joints in series."""
        return int(self._motion.x.shape[1])

    @property
    def trajectory(self) -> Trajectory:
        """The motion about which the model is linearised."""
        return Trajectory(self._motion.x, self._motion.v, self._motion.floating_state)

    def _simulate_nominal_motion(self) -> RobotMotion:
        """Return the given motion with the commands of the run, in place of a simulated motion.

        The base class linearises about a simulated motion; this overrides it. Only positions and
        velocities of the robot's joints and its floating base are given. Activations, and joints in
        series (the second joints of flexible drives), are those of a simulation. Loads of the
        transmissions are computed for the given motion, unless they are reused and no active effect
        depends on them.
        """
        # The source of what is not given: the model of a similar motion, or a simulation.
        motion = self._get_nearby_motion() or super()._simulate_nominal_motion()
        trajectory = self._trajectory or self._interpolate_samples(motion)
        # The file's joints come first. Joints in series, which are not measured, keep their motion.
        joint_count = trajectory.x.shape[1]
        x, v = motion.x.copy(), motion.v.copy()
        x[:, :joint_count], v[:, :joint_count] = trajectory.x, trajectory.v
        given_motion = replace(motion, x=x, v=v, floating_state=trajectory.floating_state)
        simulator, acting = self._simulator, self._run_batch.acting
        has_load_effect = any(e.of in LOAD_DEPENDENT_EFFECTS for e, _ in acting)
        if self._reuses_loads and not has_load_effect:
            return given_motion
        # The loads are computed on first use, since few effects need them.
        return replace(
            given_motion,
            compute_loads=lambda: compute_transmission_loads(simulator, acting, given_motion),
        )

    def _get_nearby_motion(self) -> RobotMotion | None:
        """Return the motion of the model `nearby` with the commands of this model.

        It saves a simulation. The sensor readings of `nearby` are copied, too. The result is None
        if there is no such model, if no trajectory is given, or if the robot has states other than
        the positions and velocities of the file's joints: only these are given, all others must be
        simulated.
        """
        if self._nearby is None or self._trajectory is None:
            return None
        # A motion has one step more than its run.
        motion, steps = self._nearby._motion, self._step_count + 1
        joint_count = len(self._simulator.addresses.positions)
        has_other_states = (
            motion.x.shape[1] != joint_count  # joints in series
            or motion.act.size > 0  # activations of filters before actuators
            or motion.floating_state.pose.size > 0
        )
        # An active effect of this model may add a joint in series that `nearby` does not have.
        adds_joint = any(is_series_effect(effect) for effect, _ in self._run_batch.acting)
        if has_other_states or adds_joint:
            return None
        self._readings = dict(self._nearby._readings)
        inputs = self._simulator.compute_controls(self._run_batch, steps)
        # Controls, forces and switches are those of this model; all else is that of `nearby`.
        return replace(
            motion,
            compute_loads=lambda: motion.carried,
            **self._compute_command_fields(inputs),
        )

    def _interpolate_samples(self, motion: RobotMotion) -> Trajectory:
        """Interpolate the measured joints between samples by quintic Hermite polynomials.

        They have the measured positions, velocities and accelerations at the samples. Unmeasured
        joints of closed loops follow them.

        Args:
            motion: simulated motion, which all other joints and the floating base keep.

        Returns:
            The motion of the file's joints at the steps of the simulation.
        """
        # Joints that are not recorded may diverge in the simulation.
        x, v = (
            np.clip(np.nan_to_num(states), -MAX_DEVIATION, MAX_DEVIATION)
            for states in (motion.x, motion.v)
        )
        step_times: Array = self._simulator.time_step * np.arange(float(len(x)))
        for joint, samples in self._measured.items():
            x[:, joint], v[:, joint] = interpolate_quintic(self._times, samples, step_times)
        # The file's joints come first; joints in series, which follow, are left out.
        joint_count = len(self._simulator.addresses.positions)
        trajectory = Trajectory(x[:, :joint_count], v[:, :joint_count], motion.floating_state)
        return self._close_loops(trajectory) if self._measured else trajectory

    def _close_loops(self, trajectory: Trajectory) -> Trajectory:
        """Move unmeasured joints of closed loops as the measured joints make them.

        A closed loop is a chain of links whose ends the model connects, such as a parallelogram.
        The measured joints of a loop then determine the others, which follow them.

        Args:
            trajectory: motion of the measured joints, and simulated motion of the others.

        Returns:
            The motion with closed loops; the given one if no joint follows measured ones.
        """
        system, robot = self._simulator.system, self._simulator.robot
        measured = {system.coordinates[joint] for joint in self._measured}
        following = list_following_joints(system.robot, system.joint_loops, measured)
        if not following:
            return trajectory
        model, addresses = robot.compiled, self._simulator.addresses
        floating = FloatingJoints.from_robot(robot)
        # MuJoCo's whole vectors `qpos` and `qvel` at each step.
        positions = np.tile(model.qpos0, (len(trajectory.x), 1))
        velocities = np.zeros((len(trajectory.x), model.nv))
        positions[:, addresses.positions] = trajectory.x
        velocities[:, addresses.velocities] = trajectory.v
        positions[:, floating.positions] = trajectory.floating_state.pose
        velocities[:, floating.velocities] = trajectory.floating_state.rate
        step = self._simulator.time_step
        positions, velocities = follow_measured_joints(
            robot, step, positions, velocities, following
        )
        return Trajectory(
            positions[:, addresses.positions],
            velocities[:, addresses.velocities],
            FloatingState(positions[:, floating.positions], velocities[:, floating.velocities]),
        )

    # -- the model from sample to sample

    def interval_maps(self) -> IntervalMaps:
        """Return the linear model from sample to sample that a Kalman smoother needs.

        Let δ be the deviation of the true state from the given motion, and f a force that the model
        lacks. Between samples i and i + 1, δ[i+1] = A_i δ[i] - d_i + G_i f_i (3), and the readings
        are y[i] = h + H_i δ[i] (4). A_i is the product of the derivatives of all steps in the
        interval; the responses G_i and the defects d_i (the difference between the motion and the
        model's own steps) are composed in the same way. H is computed by finite differences: each
        state component is changed at all samples at once.

        Returns:
            For T samples of C channels, Z state components, E forces and nu controls: A (T - 1, Z,
            Z), d (T - 1, Z), G (T - 1, Z, E), responses to forces and controls (T - 1, Z, E + nu),
            H (T, C, Z), h (T, C), and standard deviations (T - 1, Z) of state jumps at force limits
            of servos.
        """
        tangent, state_size = self._tangent, self._tangent.state_size
        point_of_step, quotients = tangent.point_of_step, tangent.quotients
        # d: the defects of all steps, composed to those of the intervals.
        with np.errstate(all="ignore"), capture_mujoco_warnings():
            defects = self._compose(tangent.defects)
        # A: responses to unit changes of the state at the beginning of an interval. The steps
        # themselves change nothing.
        no_changes = np.broadcast_to(0.0, (point_of_step.size, state_size, state_size))
        state_responses = self._compose(no_changes, np.eye(state_size))
        # G: the first columns of the responses are those to forces, the others those to controls.
        force_count = quotients.forces.shape[2]
        force_responses = self._input_responses[:, :, :force_count]
        # H: one changed motion for each state component, in which it is larger in all steps.
        instants = self._motion.x.shape[0]  # beginnings of all steps, and the end
        state_changes = np.broadcast_to(
            STATE_DIFFERENCE * np.eye(state_size)[:, None, :], (state_size, instants, state_size)
        )
        reading_changes = np.zeros((state_size, instants, len(self._sensor_channels)))
        if self._sensor_channels:
            # The end has the derivatives of the last step.
            points = point_of_step[np.minimum(np.arange(instants), point_of_step.size - 1)]
            reading_changes = STATE_DIFFERENCE * np.moveaxis(quotients.read_states[points], 2, 0)
        no_sensor_effects: list[ActiveEffects] = [()] * state_size
        with np.errstate(all="ignore"), capture_mujoco_warnings():
            observations = self._compute_observations(
                state_changes, reading_changes, no_sensor_effects
            )
        reading_derivatives = np.moveaxis((observations - self.observed) / STATE_DIFFERENCE, 0, 2)
        return IntervalMaps(
            states=state_responses,
            defects=defects,
            forces=force_responses,
            inputs=self._input_responses,
            readings=reading_derivatives,
            predicted=self.observed,
            jumps=self._compute_limit_jumps(),
        )

    def compute_changes(self, similar: MeasuredLinear) -> tuple[Array, Array]:
        """Compute how defects and readings differ from those of a model with other parameters.

        Args:
            similar: model of the same motion with the same Jacobians.

        Returns:
            Changes (T - 1, Z) of the defects, the differences of the Z state components between the
            motion and the model's own steps, in each interval between samples; and changes (T, C)
            of the readings of the motion, at T samples of C channels.
        """
        with np.errstate(all="ignore"), capture_mujoco_warnings():
            changes = self._tangent.compute_defect_changes(similar._tangent)
        return self._compose(changes), self.observed - similar.observed

    def _compose(
        self, values: Array, initial: Array | float = 0.0, rows: IndexArray | None = None
    ) -> Array:
        """Compose state changes in each step to those of each interval between samples.

        A change z in an interval becomes A z + (change in this step) in each step, with the
        derivatives A of the step by the state, a vector of Z components.

        Args:
            values: (S, Z) or (S, Z, m) changes in each of S steps of m kinds, such as unit forces.
            initial: (Z, m) changes of the state at the beginnings of the intervals; none by
                default.
            rows: (S,) row of `values` for each step, if they are not in the order of the steps.

        Returns:
            (T - 1, Z) or (T - 1, Z, m) state changes at the ends of the intervals between T
            samples.
        """
        columns = values[:, :, None] if values.ndim == 2 else values
        result = np.full((self.knots.size - 1, *columns.shape[1:]), initial)
        # Derivatives are computed at some points of the motion; each step has those of its point.
        points, derivatives = self._tangent.point_of_step, self._tangent.quotients.states
        # The first step of all intervals at once, then the second, and so on.
        for steps, intervals in self._list_active_intervals():
            changes = columns[steps if rows is None else rows[steps]]
            result[intervals] = derivatives[points[steps]] @ result[intervals] + changes
        return result.reshape(-1, *values.shape[1:])

    def _compute_limit_jumps(self) -> Array:
        """Return the standard deviations (T - 1, Z) of state jumps at force limits of stiff servos.

        A servo at its force limit does not follow the linearised model: positions jump by known
        sizes in each step in which the limit is reached. The sum of these jumps in an interval
        between two of the T samples is added to the process noise of a filter. The Z state
        components begin with positions, then velocities; the other ones do not jump.
        """
        mujoco_batch = self._simulator.make_linearisation_batch(self._run_batch.acting)
        limits = mujoco_batch.force_limits
        state_changes = np.zeros((self.knots.size - 1, self._tangent.state_size))
        if not limits.outputs:  # no stiff servo has a limit
            return state_changes
        with np.errstate(all="ignore"), capture_mujoco_warnings():
            is_limit_reached = np.abs(self._tangent.limited_forces) >= limits.sizes  # (S, servos)
        # Jumps (servos, D) of the D joints of the file, whose positions come first in a state.
        jumps = limits.jumps[:, mujoco_batch.file_joints.velocities]
        for steps, intervals in self._list_active_intervals():
            state_changes[intervals, : jumps.shape[1]] += is_limit_reached[steps] @ jumps
        # A position servo returns from a jump of position within the interval or later, so the
        # velocity changes by the jump per length of the interval.
        lengths = np.maximum(np.diff(self.knots), 1)[:, None] * self._simulator.time_step
        position_count = self.positions
        state_changes[:, position_count : 2 * position_count] = (
            state_changes[:, :position_count] / lengths
        )
        return state_changes

    @cached_property
    def step_errors(self) -> Array:
        """Discretisation errors (T - 1, Z) of the state, at the end of each sample interval.

        They are zero for the Runge-Kutta method, whose order is high. For others they are estimated
        by steps of half the length, at the linearisation points. There are T samples and Z state
        components.
        """
        simulator, tangent = self._simulator, self._tangent
        model = simulator.make_linearisation_batch(self._run_batch.acting).model
        is_runge_kutta = forces_are_at_step_end(model)  # a property of this integrator only
        if is_runge_kutta:
            return np.zeros((self.knots.size - 1, tangent.state_size))
        with np.errstate(all="ignore"), capture_mujoco_warnings():
            # Errors (N, Z) of one step at the N linearisation points; each step has those of its
            # point.
            errors = tangent.step_errors(simulator.make_half_step_batch(self._run_batch.acting))
            return self._compose(errors, rows=tangent.point_of_step)

    def _list_active_intervals(self) -> list[tuple[IndexArray, IndexArray]]:
        """Return which intervals between samples have a first step, a second step, and so on.

        Intervals have different numbers of steps. Loops over this list treat the same step of all
        intervals at once, instead of one interval after the other.

        Returns:
            For the first, second, ... step in an interval: the numbers of these steps in the run,
            and the numbers of the intervals that are long enough to have it, as arrays of one
            length.
        """
        lengths = np.diff(self.knots)  # numbers of steps
        first_steps = self.knots[:-1]
        result = []
        for steps_before in range(int(lengths.max(initial=0))):
            intervals = np.flatnonzero(lengths > steps_before)
            result.append((first_steps[intervals] + steps_before, intervals))
        return result

    def added(
        self,
        effects: Sequence[EffectWithCoefficients],
        predicted: Array,
        driven: Mapping[int, Sequence[Perturbation]] | None = None,
    ) -> tuple[SingleArray, SingleArray]:
        """Compute what candidate effects add to the states (3) and to the readings (4).

        In the model from sample i to i + 1, an effect adds a change b to the deviation δ[i+1] of
        the state (3), and a direct change ψ to the readings y[i], without a change of the motion
        (4). A force is replaced by its mean over the interval between two samples. Sensor effects
        are applied to predicted readings: a gain applied to the recorded reading would contain the
        noise that it has to explain.

        Args:
            effects: K effects with their coefficients; those in series with a joint add nothing.
            predicted: (T, Z) deviations δ of Z state components at the T samples, each predicted
                from the preceding samples.
            driven: changes of the controls by effects on inputs, by index of the effect; computed
                if None.

        Returns:
            Means (T - 1, E + nu, K) of E forces and nu controls over each interval, whose product
            with `IntervalMaps.inputs` is the change b of the state in (3); and direct changes ψ
            (T, C, K) of the readings of C channels. Both are in single precision.
        """
        count, samples = len(effects), self.knots.size
        quotients = self._tangent.quotients
        input_count = quotients.forces.shape[2] + quotients.controls.shape[2]
        means = np.zeros((samples - 1, input_count, count), dtype=np.float32)
        readings = np.zeros((samples, self.observed.shape[1], count), dtype=np.float32)
        if driven is None:
            (driven,) = compute_control_changes([self], effects)
        # The effects are treated in blocks, which limits the memory.
        for begin in range(0, count, CANDIDATES_PER_BLOCK):
            block = range(begin, min(begin + CANDIDATES_PER_BLOCK, count))
            # Perturbations of the motion, and sensor effects, of each effect of the block.
            changes, sensors = self._list_changes(effects, block, driven)
            columns = slice(begin, block.stop)
            with np.errstate(all="ignore"):
                stepwise_inputs, direct_readings = self._tangent.sum_inputs_and_readings(
                    changes, len(block)
                )
                means[:, :, columns] = self._compute_interval_means(stepwise_inputs)
                readings[:, :, columns] = self._compute_direct_readings(
                    direct_readings, sensors, predicted
                )
        return means, readings

    def _compute_interval_means(self, inputs: Array) -> Array:
        """Return means of forces and controls over the intervals between T samples.

        Args:
            inputs: (S, E + nu, K) forces on E coordinates and nu controls, in each of S steps, by
                each of K candidate effects.

        Returns:
            (T - 1, E + nu, K) means; zero for an interval without a step.
        """
        sums = np.zeros((self.knots.size - 1, *inputs.shape[1:]))
        for steps, intervals in self._list_active_intervals():
            sums[intervals] += inputs[steps]
        means: Array = sums / np.maximum(np.diff(self.knots), 1)[:, None, None]
        return means

    @cached_property
    def _input_responses(self) -> Array:
        """State changes (T - 1, Z, E + nu) at the end of each interval between T samples.

        They are the changes of the Z state components per unit of each of the E generalised forces
        and nu controls, which is constant over the interval.
        """
        quotients = self._tangent.quotients
        input_matrices = np.concatenate([quotients.forces, quotients.controls], axis=2)
        return self._compose(input_matrices, rows=self._tangent.point_of_step)

    def _compute_direct_readings(
        self, readings: Array, sensors: Sequence[ActiveEffects], predicted: Array
    ) -> Array:
        """Compute the direct changes ψ (T, C, K) of C channels by K candidate effects.

        They do not pass through the motion; an example is the bias of a sensor. The candidates are:

        * Without sensor effects, an effect in the model may still change a reading directly, such
          as a force in a drive that a sensor shows. It is applied to the given motion.
        * Sensor effects may be nonlinear, so they are applied to the readings of the predicted
          motion, and those readings without them are subtracted.
        * Candidates that change no reading are skipped.

        Args:
            readings: (S, O, K) direct changes of O readings by effects in the model, in each of S
                steps.
            sensors: sensor effects of each of the K candidates.
            predicted: (T, Z) deviations of Z state components of the predicted motion from the
                given one at T samples.
        """
        direct_changes = np.zeros((self.knots.size, self.observed.shape[1], len(sensors)))
        changing = [k for k, acting in enumerate(sensors) if acting or readings[:, :, k].any()]
        if not changing:
            return direct_changes
        has_sensor_effect = np.array([bool(sensors[k]) for k in changing])
        # One motion for each of these candidates, and a last one as the reference for candidates
        # with sensor effects: the predicted motion without them. A motion is given by the
        # deviations of its states from the given motion; those of candidates without sensor effects
        # are zero.
        states = np.zeros((len(changing) + 1, self._motion.x.shape[0], self._tangent.state_size))
        if has_sensor_effect.any():
            force_count = self._tangent.quotients.forces.shape[2]
            no_forces = np.zeros((self.knots.size - 1, force_count))
            is_predicted = np.append(has_sensor_effect, True)
            states[is_predicted] = self.propagate_deviations(predicted, no_forces)
        # Direct changes of readings by effects in the model, none in the reference.
        changes = np.concatenate(
            [np.moveaxis(readings[:, :, changing], 2, 0), np.zeros((1, *readings.shape[:2]))]
        )
        observations = self._compute_observations(
            states, changes, [*(sensors[k] for k in changing), ()]
        )
        without_effects = np.where(
            has_sensor_effect[:, None, None], observations[-1], self.observed
        )
        direct_changes[:, :, changing] = np.moveaxis(observations[:-1] - without_effects, 0, 2)
        return direct_changes

    def propagate_deviations(self, deviations: Array, forces: Array) -> Array:
        """Propagate deviations at samples to all steps by the linear model (2).

        In each step a deviation δ of the state becomes A δ - d + B f, with the defect d of the step
        and the derivatives A and B by the state and the force f. At each sample the deviation is
        the given one again.

        Args:
            deviations: (T, Z) deviations δ of Z state components at the T samples.
            forces: (T - 1, E) forces f on E coordinates, constant between samples.

        Returns:
            (S + 1, Z) deviations at the beginnings of the S steps and at the end; after the last
            sample they are constant.
        """
        tangent = self._tangent
        points, quotients = tangent.point_of_step, tangent.quotients
        with np.errstate(all="ignore"), capture_mujoco_warnings():
            defects = tangent.defects
        deviations_at_steps = np.zeros((self._motion.x.shape[0], tangent.state_size))
        # Deviations at the present step of each interval: the first step of all intervals at once,
        # then the second, and so on.
        present = deviations[:-1].copy()
        with np.errstate(all="ignore"):
            for steps, intervals in self._list_active_intervals():
                deviations_at_steps[steps] = delta = present[intervals]
                a, b = quotients.states[points[steps]], quotients.forces[points[steps]]
                propagated = np.einsum("izy,iy->iz", a, delta)
                forced = np.einsum("ize,ie->iz", b, forces[intervals])
                present[intervals] = propagated - defects[steps] + forced
        deviations_at_steps[self.knots[-1] :] = deviations[-1]
        return deviations_at_steps

    def moved(self, deviations: Array) -> Trajectory:
        """Return the motion plus deviations of its states, such as those of a smoother.

        Args:
            deviations: (S + 1, Z) deviations of Z state components at the beginnings of the S steps
                and at the end. The columns are positions and velocities of the joints, activations,
                hidden states of effects, and displacements and velocities of floating bodies.

        Returns:
            The motion of the file's joints and of floating bodies; other deviations are ignored.
        """
        # The motion is not changed where the linear model diverges.
        deviations = np.where(np.abs(deviations) < MAX_DEVIATION, deviations, 0.0)
        motion = self._motion
        # Joints of the file come first, then those that effects have added in series with them.
        file_joints, all_joints = len(self._simulator.addresses.positions), motion.x.shape[1]
        activations = motion.act.shape[1]
        first_floating = 2 * all_joints + activations + len(self._tangent.hidden_state_effects)
        displacements, rates = np.split(deviations[:, first_floating:], 2, axis=1)
        pose = motion.floating_state.pose
        if displacements.size:
            # Displacements include rotations, which cannot be added to a pose with quaternions.
            floating = self._simulator.make_linearisation_batch(self._run_batch.acting).floating
            pose = floating.displace(pose, displacements)
        return Trajectory(
            motion.x[:, :file_joints] + deviations[:, :file_joints],
            motion.v[:, :file_joints] + deviations[:, all_joints : all_joints + file_joints],
            FloatingState(pose, motion.floating_state.rate + rates),
        )


def compute_transmission_loads(
    simulator: RobotSimulator, acting: ActiveEffects, motion: RobotMotion
) -> Array:
    """Compute the loads of the transmissions in a motion, on which their friction depends.

    They are the forces on both sides of a transmission: those of the actuators, and those of
    gravity and motion (`TRANSMISSION_FORCE_FIELDS` of MuJoCo). They are evaluated at the
    linearisation points; all steps of a point have its loads.

    Args:
        simulator: simulator of the robot.
        acting: active effects.
        motion: motion whose own loads are used only by effects with hidden states.

    Returns:
        (2, S, D) loads of D joints in S steps.
    """
    mujoco_batch = simulator.make_linearisation_batch(acting)
    outputs = [
        (name, int(dof))
        for name in TRANSMISSION_FORCE_FIELDS
        for dof in mujoco_batch.all_joints.velocities
    ]
    points = LinearisationPoints(
        mujoco_batch, simulator.robotic, motion, acting, outputs, mujoco_batch.all_joints
    )
    with np.errstate(all="ignore"), capture_mujoco_warnings():
        _, loads = points.compute_accelerations(acting)
    # The outputs are the first field at all joints, then the second one.
    return np.stack(np.split(loads[points.point_of_step], 2, axis=1))


def interpolate_quintic(times: Array, samples: Array, instants: Array) -> tuple[Array, Array]:
    """Interpolate by quintic Hermite polynomials, and extrapolate linearly.

    The polynomial of fifth degree between two samples has the given value, first and second
    derivative at both ends. Before the first and after the last sample, the value continues with
    the slope there, since a motion has one step more than its run.

    Args:
        times: (T,) times of T samples, ascending.
        samples: (T, 3) values, first and second derivatives.
        instants: (n,) times at which to interpolate.

    Returns:
        Values and first derivatives, (n,) each, at the n times.
    """
    within = np.clip(instants, times[0], times[-1])
    # Index of the last sample before each instant; the last sample belongs to the last interval.
    below = np.clip(np.searchsorted(times, within, side="right") - 1, 0, times.size - 2)
    h = times[below + 1] - times[below]
    s = (within - times[below]) / h  # from 0 to 1 between two samples
    (x0, v0, a0), (x1, v1, a1) = samples[below].T, samples[below + 1].T
    # Derivatives by s.
    v0, a0, v1, a1 = h * v0, h * h * a0, h * v1, h * h * a1
    # Coefficients of the polynomial in s with these values at 0 and at 1.
    c2 = 0.5 * a0
    c3 = 10.0 * (x1 - x0) - 6.0 * v0 - 4.0 * v1 - 1.5 * a0 + 0.5 * a1
    c4 = -15.0 * (x1 - x0) + 8.0 * v0 + 7.0 * v1 + 1.5 * a0 - a1
    c5 = 6.0 * (x1 - x0) - 3.0 * (v0 + v1) - 0.5 * a0 + 0.5 * a1
    value = x0 + s * (v0 + s * (c2 + s * (c3 + s * (c4 + s * c5))))
    slope = (v0 + s * (2.0 * c2 + s * (3.0 * c3 + s * (4.0 * c4 + 5.0 * s * c5)))) / h
    return value + (instants - within) * slope, slope
