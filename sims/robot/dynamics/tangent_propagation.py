"""First-order propagation of small changes along a robot's motion (tangent linear model).

It computes the responses to hundreds of effects at the cost of a few dozen simulations. With the
state z = (q, v, a), the controls u and generalised forces f, a step of MuJoCo is the map z_{t+1} =
F(z_t, u_t, f_t; p) with the model parameters p. Along one motion

    A_t = dF/dz,   B_t = dF/df,   C_t = dF/du                                                  (1)

are difference quotients (`step_jacobians`). A change with forces df, controls du or parameters
p + dp then changes the motion by

    dz_{t+1} = A_t dz_t + B_t (df_t + M_t da_t) + C_t du_t                                     (2)

with the change da_t of the acceleration at the same state by the changed parameters, and the
inertia matrix M_t (the tangent or variational equations; J. Guckenheimer, P. Holmes, Nonlinear
Oscillations, 1983, section 1.3). Effect forces are evaluated along the motion, for all times at
once. Changes of readings follow in the same way, with separate quotients.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sims.core.effect import ActiveEffects, Effect
from sims.core.simulator import Array
from sims.robot.dynamics.active_effects import is_in_drive
from sims.robot.dynamics.linearisation_points import LinearisationPoints, find_neighbours
from sims.robot.dynamics.midpoint_state import IndexArray, Mask
from sims.robot.dynamics.mujoco_batch import MujocoBatch
from sims.robot.dynamics.step_jacobians import DifferenceQuotients, compute_difference_quotients

MAX_SIMULTANEOUS_CHANGES = 64
"""Maximum number of changes that are propagated together; the data of more exceed the CPU cache."""


class Perturbation(NamedTuple):
    """A perturbation to propagate: of a force or control (S,), or of model parameters.

    Attributes:
        owner: number of the effect candidate to which it belongs.
        joint: joint of the force; -1 if it is not a force.
        actuator: index of the control; -1 if it is not a control.
        series: (S,) forces or controls; None if model parameters change.
        instant: (S,) controls at the beginning of each step.
        forces: (N, E) forces equivalent to changed parameters, at each linearisation point.
        readings: (N, O) direct changes of readings, at each linearisation point.
    """

    owner: int
    joint: int = -1
    actuator: int = -1
    series: Array | None = None
    instant: Array | None = None
    forces: Array | None = None
    readings: Array | None = None


class TangentModel:
    """Tangent linear model about one motion.

    Attributes:
        quotients: difference quotients in use.
    """

    def __init__(
        self, at: LinearisationPoints, sizes: Array, quotients: DifferenceQuotients | None = None
    ) -> None:
        """Prepare the interpolation between points, and compute the difference quotients if needed.

        A linearisation point is a step of the motion at which derivatives are computed. Consecutive
        steps share a point: `point_of_step` has the point of each step.

        Args:
            at: linearisation points of the motion.
            sizes: (E,) typical forces in N or N m, which set the finite differences of forces; E is
                the number of velocities, of joints and of floating bodies.
            quotients: difference quotients of another motion nearby, to be used for this one;
                computed if None, or if they belong to other points.
        """
        self._points, self._motion = at, at.motion
        self._typical_forces = sizes
        self._step_count = len(at.motion.controls)
        # Distance (S,) of each of the S steps from its linearisation point, as a share of the
        # regular distance between points.
        step_numbers = np.arange(self._step_count)
        self._distance_share: Array = (
            step_numbers - at.point_steps[at.point_of_step]
        ) / at.point_spacing
        # Indices (S,) of the two points between which values at points are interpolated to a step.
        earlier_points, later_points = find_neighbours(at.point_steps, at.point_spacing)
        self._earlier_point = earlier_points[at.point_of_step]
        self._later_point = later_points[at.point_of_step]
        # If commands change at other times, the linearisation points differ.
        points_and_states = at.point_steps.size, self.state_size
        if quotients is None or quotients.states.shape[:2] != points_and_states:
            quotients = compute_difference_quotients(at, sizes, lambda: self._base_step)
        self.quotients = quotients

    @cached_property
    def _base_step(self) -> tuple[Array, Array]:
        """States (N, Z) after an unperturbed step from each point, and readings (N, O)."""
        return self._points.step_displaced({}, self._points.acting)

    @property
    def _base_readings(self) -> Array:
        at_points = self._points.steps_joints_by_runge_kutta
        _, readings = self._base_accelerations if at_points else self._base_step
        return readings

    @cached_property
    def _base_accelerations(self) -> tuple[Array, Array]:
        """Accelerations (N, E) and readings (N, O) of the unperturbed motion."""
        return self._points.compute_accelerations(self._points.acting)

    @property
    def placed_element_count(self) -> int:
        """Number of batch elements that were placed at linearisation points so far."""
        return self._points.placed_count

    @property
    def state_size(self) -> int:
        """Number of state components.

        They are positions, velocities, activations, hidden states of effects, and displacements and
        velocities of floating bodies.
        """
        velocities = self._typical_forces.size  # of joints and of floating bodies
        activations = self._motion.act.shape[1]
        hidden_states = len(self._points.hidden_state_effects)
        # Each velocity has a position of the joint, or a displacement of the floating body.
        size: int = 2 * velocities + activations + hidden_states
        return size

    # -- changes

    def perturb_model_numbers(
        self, acting: ActiveEffects, change: float, mujoco_batch: MujocoBatch
    ) -> tuple[Array, Array]:
        """Return the perturbation by other model parameters, such as a mass.

        The accelerations at the N points of the motion are computed with the changed model. A
        change da of the acceleration at the same state acts like the force M da, with the inertia
        matrix M, and is propagated like a force.

        Args:
            acting: active effects including the one that changes the parameters.
            change: size of the change, as a share of the effect's coefficients.
            mujoco_batch: batch whose model has the required elements.

        Returns:
            Equivalent forces (N, E) on the E velocities of joints and floating bodies, and direct
            changes (N, O) of the O readings at unchanged states, both divided by `change`.
        """
        # A contact reacts to the force M da, so that it would not change the acceleration by da.
        if self._points.has_contacts and not self._points.steps_joints_by_runge_kutta:
            return self._perturb_numbers_at_contacts(acting, change, mujoco_batch)
        # With these forces the unchanged model has its mean accelerations over a step.
        step_mean_forces = self._mean_acceleration_forces
        with self._points.with_batch(mujoco_batch):
            accelerations, readings = self._points.compute_accelerations(acting, step_mean_forces)
            # Sensors of drive forces do not depend on these applied forces, but others do, such as
            # an accelerometer. Then all are read without these forces, like the base readings.
            if self._points.reads_others:
                _, readings = self._points.compute_accelerations(acting)
        difference = (accelerations - self._accelerations_with_mean_forces) / change
        force = np.einsum("nij,nj->ni", self._mass_matrices, difference)
        _, base_readings = self._base_accelerations
        return force, (readings - base_readings) / change

    def _perturb_numbers_at_contacts(
        self, acting: ActiveEffects, change: float, mujoco_batch: MujocoBatch
    ) -> tuple[Array, Array]:
        """Compute the perturbation by other model parameters for a robot whose geoms touch.

        Without contacts, a change da of the acceleration by other model parameters is equivalent to
        the force M da with the inertia matrix M. But a contact reacts to this force, so that the
        motion would not change by da. The force that changes the velocity after a step by dv is
        inv(B) dv, with the derivatives B of this velocity by forces, which include the reaction.

        Args:
            acting: active effects including the one that changes the parameters.
            change: size of the change, as a share of the effect's coefficients.
            mujoco_batch: batch whose model has the required elements.

        Returns:
            Equivalent forces (N, E) on E joints at N points, and direct changes (N, O) of O
            readings, both divided by `change`.
        """
        with self._points.with_batch(mujoco_batch):
            ends, readings = self._points.step_displaced({}, acting)
        # A state begins with E displacements and E velocities, of joints and of floating bodies.
        velocity_count = self._typical_forces.size
        velocities = slice(velocity_count, 2 * velocity_count)
        base_ends, _ = self._base_step  # states after a step without the change
        difference = (ends - base_ends)[:, velocities] / change
        derivatives = self.quotients.forces[:, velocities]  # B, (N, E, E)
        force: Array = np.linalg.solve(derivatives, difference[..., None])[..., 0].astype(
            np.float64
        )
        return force, (readings - self._base_readings) / change

    @cached_property
    def _mean_acceleration_forces(self) -> Array:
        """Forces (N, E) that convert accelerations at a state to mean accelerations over the step.

        They act on the E velocities of joints and floating bodies at the N linearisation points.
        They represent the damping of an implicit integrator, and the motion of other joints within
        the step.
        """
        # A change da of the acceleration needs the force M da, with the inertia matrix M.
        base_accelerations, _ = self._base_accelerations
        difference = self.accelerations[self._points.point_steps] - base_accelerations
        forces: Array = np.einsum("nij,nj->ni", self._mass_matrices, difference)
        return forces

    @cached_property
    def _accelerations_with_mean_forces(self) -> Array:
        """Accelerations (N, E) of the unperturbed motion with `_mean_acceleration_forces`.

        There are N linearisation points, and E velocities of joints and floating bodies. The
        accelerations are the mean ones over a step, except where a joint sticks, whose dry friction
        absorbs a part of these forces. A difference from the mean accelerations would be a jump
        there, which does not depend on the change of the model.
        """
        accelerations, _ = self._points.compute_accelerations(
            self._points.acting, self._mean_acceleration_forces
        )
        return accelerations

    def perturb_by_force(self, owner: int, effect: Effect, c: Array) -> list[Perturbation]:
        """Return the perturbations by an effect's force, one for each joint that it acts on.

        A force within a drive changes what the sensors of the drives read, too; this is one more
        perturbation.

        Args:
            owner: number of the effect candidate.
            effect: effect with a force.
            c: (K, 1, 1) its K coefficients.
        """
        # Forces (S, D) on D joints along the motion of S steps.
        forces = self._points.compute_effect_force(effect, c)
        changes = [
            Perturbation(owner, joint=joint, series=series)
            for joint, series in enumerate(forces.T)
            if np.abs(series).max() > 0
        ]
        if is_in_drive(effect) and self._points.reads_drives:
            changes.append(
                Perturbation(
                    owner,
                    readings=self._points.compute_drive_reading_changes(
                        effect, c, self._base_readings
                    ),
                )
            )
        return changes

    @cached_property
    def _mass_matrices(self) -> Array:
        return self._points.compute_mass_matrices()

    @cached_property
    def accelerations(self) -> Array:
        """Mean accelerations (S, E) over each of S steps, from the velocities at its ends."""
        motion = self._motion
        result: Array = np.diff(motion.velocities, axis=0)[: self._step_count] / motion.step
        return result

    # -- propagation over time

    def propagate(
        self, changes: Sequence[Perturbation], count: int, initial: Array | None = None
    ) -> tuple[Array, Array]:
        """Propagate changes along the motion, added up for each owner.

        A step multiplies a change dz of the state by A, and adds B times the change df of forces
        and C times the change du of controls: dz_{t+1} = A dz_t + B df_t + C du_t (2). An owner is
        the candidate effect to which a change belongs; all n owners are propagated in one matrix
        product per step.

        Args:
            changes: changes with owners from 0 to `count` - 1.
            count: number of owners n.
            initial: (Z, n) changes of the initial state; none by default.

        Returns:
            Changes of states (n, S + 1, Z), with Z components at the beginnings of S steps and at
            the end, and of O readings (n, S, O) at the beginnings.
        """
        quotients = self.quotients
        state_size = quotients.forces.shape[1]
        steps = self._step_count
        # Changes of forces and controls (S, E + nu, n), and direct changes of readings (S, O, n).
        inputs, readings = self.sum_inputs_and_readings(changes, count)
        # States, forces and controls of each step are stacked, so that a step is one matrix product
        # with [A, B, C]. Its result is the state part of the next step.
        stacked = np.zeros((steps + 1, state_size + inputs.shape[1], count))
        stacked[:-1, state_size:] = inputs
        if initial is not None:
            stacked[0, :state_size] = initial
        step_matrices = list(
            np.concatenate([quotients.states, quotients.forces, quotients.controls], axis=2)
        )
        stacked_steps = list(stacked)
        for step_index, point in enumerate(self._points.point_of_step.tolist()):
            np.matmul(
                step_matrices[point],
                stacked_steps[step_index],
                out=stacked_steps[step_index + 1][:state_size],
            )  # (2)
        # Readings change directly (so far), and by the changed states.
        if readings.shape[1]:
            readings += np.matmul(
                quotients.read_states[self._points.point_of_step], stacked[:-1, :state_size]
            )
        states = stacked[:, :state_size]
        return np.moveaxis(states, 2, 0), np.moveaxis(readings, 2, 0)

    def sum_inputs_and_readings(
        self, changes: Sequence[Perturbation], count: int
    ) -> tuple[Array, Array]:
        """Add up the forces and controls of changes, and their direct changes of readings.

        A sensor of a drive force shows a change of force or command at once, before the motion
        changes. It shows the command at the beginning of a step, while the mean over the step moves
        the robot.

        Args:
            changes: changes with owners from 0 to `count` - 1; an owner is the candidate effect to
                which a change belongs.
            count: number of owners n.

        Returns:
            Changes (S, E + nu, n) of E forces and nu controls in S steps; and changes (S, O, n) of
            O readings at unchanged states.
        """
        quotients, steps = self.quotients, self._step_count
        force_count, control_count = quotients.forces.shape[2], quotients.controls.shape[2]
        reading_count = self._points.output_count
        # The series of one owner are contiguous in memory while they are added up. Forces come
        # first, then controls: their means over the steps, and their values at the beginnings. The
        # latter are only used for readings; without any, no memory is taken for them.
        inputs = np.zeros((force_count + control_count, count, steps))
        instant_inputs = (
            np.zeros((control_count, count, steps)) if reading_count else inputs[force_count:]
        )
        readings = np.zeros((steps, reading_count, count))
        # 1. Series of forces and controls, and readings that a change states itself.
        for change in changes:
            owner = change.owner
            if change.joint >= 0 and change.series is not None:
                inputs[change.joint, owner] += change.series
            if change.actuator >= 0 and change.series is not None:
                inputs[force_count + change.actuator, owner] += change.series
                # Values at the beginnings of the steps; the means stand for them if not stated.
                instant = change.series if change.instant is None else change.instant
                if reading_count:
                    instant_inputs[change.actuator, owner] += instant
            if change.forces is not None:
                inputs[:force_count, owner] += self._interpolate_to_steps(change.forces).T
            if change.readings is not None:
                readings[:, :, owner] += self._interpolate_to_steps(change.readings)
        stepwise_inputs = np.ascontiguousarray(inputs.transpose(2, 0, 1))
        # 2. Readings that follow from forces and controls.
        if reading_count:
            forces = stepwise_inputs[:, :force_count].copy()
            # Changes of model parameters already contain their effect on readings.
            forces[:, :, self._find_parameter_changes(changes, count)] = 0.0
            readings += np.matmul(quotients.read_forces[self._points.point_of_step], forces)
            instants = np.ascontiguousarray(instant_inputs.transpose(2, 0, 1))
            readings += np.matmul(quotients.read_controls[self._points.point_of_step], instants)
        return stepwise_inputs, readings

    @property
    def point_of_step(self) -> IndexArray:
        """Index of the linearisation point whose quotients apply to each step, (S,)."""
        return self._points.point_of_step

    @property
    def hidden_state_effects(self) -> Sequence[int]:
        """Numbers of the effects with hidden states."""
        return self._points.hidden_state_effects

    @property
    def motion_readings(self) -> Array:
        """Readings (S, O) of O outputs at the beginnings of S steps, as computed by the model."""
        motion, points = self._motion, self._points.point_of_step
        # The model is evaluated at all steps instead of the linearisation points.
        with self._points.at_steps(np.arange(self._step_count)):
            _, step_readings = self._points.compute_accelerations(self._points.acting)
        # The model was evaluated with the mean of a command over the step, while a sensor shows its
        # value at the beginning.
        difference = motion.instant - motion.controls
        result: Array = step_readings + np.einsum(
            "sou,su->so", self.quotients.read_controls[points], difference
        )
        return result

    def step_errors(self, finer: MujocoBatch) -> Array:
        """Estimate the discretisation error of a step by Richardson extrapolation.

        Two steps of half the length have half the error of one step of a method of first order, so
        twice the difference leads to the exact state (L. F. Richardson, 1911,
        doi:10.1098/rsta.1911.0009).

        Args:
            finer: batch of the same model with half the time step.

        Returns:
            (N, Z) exact minus computed state, of Z components, after a step from each of the N
            linearisation points.
        """
        with self._points.with_batch(finer):
            finer_state, _ = self._points.step_displaced({}, self._points.acting, steps=2)
        state, _ = self._base_step
        return 2.0 * (finer_state - state)

    @cached_property
    def defects(self) -> Array:
        """Differences (S, Z) between the motion and the model's own step, the defect of each step.

        The model starts each of the S steps from the state of the motion, with Z components. The
        defect is zero for a simulated motion, and not zero for a measured one. Only positions and
        velocities of joints and floating bodies have defects.
        """
        motion, joints = self._motion, self._motion.x.shape[1]
        # A state begins with the positions and velocities of the joints.
        predicted_states, _ = self._every_step
        defects = np.zeros_like(predicted_states)
        defects[:, :joints] = motion.x[1:] - predicted_states[:, :joints]
        defects[:, joints : 2 * joints] = motion.v[1:] - predicted_states[:, joints : 2 * joints]
        floating = motion.floating_state.rate.shape[1]
        if floating:
            # The displacements and velocities of floating bodies come last. Predicted displacements
            # are relative to the motion.
            displacements, rates = np.split(predicted_states[:, -2 * floating :], 2, axis=1)
            defects[:, -2 * floating : -floating] = -displacements
            defects[:, -floating:] = motion.floating_state.rate[1:] - rates
        return defects

    def compute_defect_changes(self, similar: TangentModel) -> Array:
        """Compute how the defects (S, Z) differ from those of a model with other parameters.

        The defect is the difference between the motion and the model's own step, so it changes by
        the difference of both steps. Consecutive steps share a linearisation point. One step in the
        middle between this point and the next one represents them all, unless commands differ too.

        Args:
            similar: model of the same motion.

        Returns:
            The defects of this model minus those of the other one, for Z state components in each
            of S steps.
        """
        if not np.array_equal(self._motion.controls, similar._motion.controls):
            return self.defects - similar.defects
        ends = np.append(self._points.point_steps[1:], self._step_count)
        middle = (self._points.point_steps + ends) // 2
        # Evaluate these steps instead of the linearisation points.
        with self._points.at_steps(middle):
            states, _ = self._points.step_displaced({}, self._points.acting)
        similar_states, _ = similar._every_step
        changes: Array = similar_states[middle] - states
        return changes[self._points.point_of_step]

    @property
    def limited_forces(self) -> Array:
        """Forces (S, K) with limits at stiff servos, in each step."""
        _, limited_forces = self._every_step
        return limited_forces

    @cached_property
    def _every_step(self) -> tuple[Array, Array]:
        """States (S, Z) after each step, and the limited forces (S, K)."""
        with self._points.at_steps(np.arange(self._step_count)), self._points.limited_forces():
            return self._points.step_displaced({}, self._points.acting)

    def _interpolate_to_steps(self, values: Array) -> Array:
        """Interpolate values (N, k) at N linearisation points linearly to all S steps, (S, k).

        Each point has k values. A point lies at each change of a command and at regular distances
        after it. Between two points of one command the motion is smooth, so values are interpolated
        there; after the last point of a command, they are extrapolated. `_earlier_point` and
        `_later_point` (S,) are the two points for each step, and `_distance_share` (S,) is its
        distance from its own point, as a share of their distance.
        """
        slope = values[self._later_point] - values[self._earlier_point]
        result: Array = values[self._points.point_of_step] + self._distance_share[:, None] * slope
        return result

    @staticmethod
    def _find_parameter_changes(changes: Sequence[Perturbation], count: int) -> Mask:
        """Return which of `count` owners change model parameters, as a mask (count,)."""
        changes_parameters = np.zeros(count, dtype=bool)
        changes_parameters[[change.owner for change in changes if change.forces is not None]] = True
        return changes_parameters

    def propagate_initial_state(self) -> tuple[Array, Array]:
        """Compute the responses to unit changes of each initial position and velocity of a joint.

        Returns:
            Changes of states (2 D, S + 1, Z) of Z components and of O readings (2 D, S, O) over S
            steps: first by the D positions, then by the D velocities.
        """
        count = 2 * self._motion.x.shape[1]
        return self.propagate((), count, np.eye(self.state_size, count))
