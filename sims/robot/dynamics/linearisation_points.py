"""Robot states along one motion, for finite-difference linearisation.

Each state is placed in another element of a batch. Computed are the states after a step,
accelerations, and effect forces. Neighbouring points are found for interpolation between them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from sims.core.effect import ActiveEffects, Effect, Force, Friction, HiddenState, HiddenStateEffect
from sims.core.simulator import Array
from sims.recording.recorded_poses import POSITION_AXES
from sims.robot.dry_friction import get_friction_constraint
from sims.robot.dynamics.active_effects import LOAD_DEPENDENT_EFFECTS, StepEffects, is_in_drive
from sims.robot.dynamics.disabled_drives import ForceRanges, Mask, find_working_servos
from sims.robot.dynamics.effect_forces import (
    compute_drive_effect_forces,
    compute_effect_forces,
    compute_friction_limits,
    make_snapshot,
)
from sims.robot.dynamics.hidden_states import (
    advance_state,
    compute_hidden_state_forces,
    integrate_state,
)
from sims.robot.dynamics.midpoint_state import IndexArray, forces_are_at_step_end
from sims.robot.dynamics.mujoco_batch import JointAddresses, MujocoBatch
from sims.robot.floating_joints import FloatingState
from sims.robot.model_field_effects import select_model_field_effects
from sims.robot.robot_system import RobotSystem
from sims.robot.state_snapshots import RobotSnapshot

LINEARISATION_INTERVAL_SECONDS = 0.004
"""Interval of the linearisation in seconds; a pose changes little within it."""
CONTACT_DIFFERENCE = 1e-6
"""Displacement in m of a floating body, for derivatives that show its contacts."""
MAX_RELATIVE_CHANGE = 0.1
"""Maximum change of these derivatives for which one linearisation is used."""
TRANSMISSION_FORCE_FIELDS = ("qfrc_actuator", "qfrc_bias")
"""Fields of MuJoCo's data with the forces on both sides of a joint's transmission."""


# The values are Any because floating bodies and hidden states take one index, others also arrays.
Displacements = Mapping[str, tuple[Any, Any]]
"""Index, or indices, and size of the displacement of each displaced quantity."""


@dataclass(frozen=True)
class RobotMotion:
    """One motion of a robot, with all its inputs.

    Attributes:
        x: (S + 1, D) positions at the beginnings of steps, and at the end.
        v: (S + 1, D) velocities at the beginnings of steps, and at the end.
        act: (S, na) activations at the beginnings of steps.
        controls: (S, nu) mean controls over each step.
        instant: (S, nu) controls at the beginning of each step.
        forces: (S, nv) precomputed generalised forces.
        inputs: (S,) applied inputs by name.
        compute_loads: computes the forces on both sides of the transmissions, (2, S, D).
        floating_state: (S + 1, P) poses and (S + 1, F) velocities of floating bodies.
        step: step length in seconds.
        off: (S, K) whether each actuator is switched off.
    """

    x: Array
    v: Array
    act: Array
    controls: Array
    instant: Array
    forces: Array
    inputs: Mapping[str, Array]
    compute_loads: Callable[[], Array]
    floating_state: FloatingState
    step: float
    off: Mask

    @cached_property
    def carried(self) -> Array:
        """Forces (2, S, D) on both sides of the transmissions, which few effects need."""
        return self.compute_loads()

    @property
    def velocities(self) -> Array:
        """All velocities (S + 1, D + F)."""
        return np.concatenate([self.v, self.floating_state.rate], axis=1)


class LimbNumbers(NamedTuple):
    """Number of the limb of each component of a robot whose limbs do not influence each other.

    Attributes:
        joints: (D,) limb of each joint, with its position, velocity and force.
        controls: (nu,) limb of each control.
        activations: (na,) limb of each activation.
        results: (D,) limb of each acceleration, or (Z,) of each component of a state.
        outputs: (O,) limb of each output.
    """

    joints: IndexArray
    controls: IndexArray
    activations: IndexArray
    results: IndexArray
    outputs: IndexArray

    def get_number(self, quantity: str, index: int) -> int:
        """Return the limb of a component that is displaced.

        Args:
            quantity: quantity as in `LinearisationPoints.step_displaced`.
            index: number of the component among those of its quantity.
        """
        numbers = {"u": self.controls, "a": self.activations}.get(quantity, self.joints)
        return int(numbers[index])


class LinearisationPoints:
    """Linearisation points of one motion.

    Attributes:
        motion: the given motion.
        acting: the given effects.
        point_steps: (N,) steps that begin at the points.
        point_of_step: (S,) index of the point that applies to each step.
        point_spacing: number of steps between two points while no command changes.
        placed_count: number of batch elements that have been placed so far.
        hidden_state_effects: numbers of the hidden states of effects, in the order of their
            columns in a state.
    """

    def __init__(
        self,
        mujoco_batch: MujocoBatch,
        system: RobotSystem,
        motion: RobotMotion,
        acting: ActiveEffects,
        outputs: Sequence[tuple[str, int]],
        joints: JointAddresses,
        drives: Sequence[int] = (),
        held: float = LINEARISATION_INTERVAL_SECONDS,
    ) -> None:
        """Choose the points of the motion, and prepare the batch (fields, effects, state).

        A linearisation point is a step of the motion at which derivatives are computed. Also
        integrate the hidden states of the effects along the motion, since each point needs them.

        Args:
            mujoco_batch: batch of the robot; its size is the number of points evaluated together.
            system: system of the robot.
            motion: motion at all steps: states, controls and forces.
            acting: effects active in it, with K coefficients each, (K, 1, 1).
            outputs: fields of MuJoCo's data and their columns that are read, in addition to the
                state.
            joints: addresses of the joints.
            drives: for each output, the number of the joint whose drive force it is; -1 for other
                outputs.
            held: time in seconds for which a linearisation is used.
        """
        self.motion, self.acting = motion, acting
        self._mujoco_batch, self._system = mujoco_batch, system
        self._outputs = tuple(outputs)
        self._joints = joints
        self._joint_of_output = np.array(tuple(drives) or (-1,) * len(self._outputs), dtype=np.intp)
        # Forces (n, D) of effects in drives, which a sensor of drive forces shows; none so far.
        self._drive_effect_forces = np.zeros((0, 0))
        self._floating = mujoco_batch.floating
        # Addresses of the velocities of all joints and floating bodies.
        self._dofs = np.append(joints.velocities, self._floating.velocities)
        self.point_spacing = max(round(held / motion.step), 1)
        # Fields must be bound before MuJoCo's first call, since later ones are not updated before
        # the next call.
        self._bind_fields(mujoco_batch)
        self.placed_count = 0
        # Effects whose forces are evaluated here, because no model field represents them.
        self._step_effects = StepEffects.from_active(acting)
        if any(self._step_effects):
            # Reading this property computes the loads of the transmissions with the same batch, so
            # it comes before the batch is prepared.
            _ = motion.carried
        mujoco_batch.write_effects(_repeat_coefficients(acting, mujoco_batch.count))
        # All elements have the same effects, so the stiffness of the first one is that of all.
        self._stiffness = mujoco_batch.get_servo_stiffness(joints)[:1]
        self._is_servo_on = find_working_servos(mujoco_batch.robot, joints.velocities, motion.off)
        self._hidden_states = [
            self.integrate_hidden_state(effect, c) for effect, c in self._step_effects.hidden
        ]
        self.hidden_state_effects = range(len(self._hidden_states))
        self._next_hidden_states: list[HiddenState] = []
        # The state to which a batch is set before points are placed in it. Stage 0 resets it
        # without an evaluation of the dynamics.
        mujoco_batch.batch.reset(stage=0)
        self._reset_state = mujoco_batch.batch.state.copy()
        # At first, all steps are points, since contacts may change at any of them.
        self.point_steps = np.arange(len(motion.controls))
        changes = self._find_changed_contacts() if mujoco_batch.robot.is_on_ground else None
        self.point_steps, self.point_of_step = _choose_points(motion, self.point_spacing, changes)

    def _find_changed_contacts(self) -> Mask:
        """Return at which of S steps the contacts with the ground have changed, as a mask (S,).

        They show in the derivatives of a step by the position of a floating body, since only a
        contact makes its motion depend strongly on its place. The contacts count as changed if any
        derivative differs from that at the last change by more than `MAX_RELATIVE_CHANGE` times
        the typical largest derivative of a step. It is called while all steps are points.
        """
        # States (S, Z) after a step from each of the S steps, and their derivatives by x, y and z
        # of each floating body, which slide joints represent.
        unmoved, _ = self.step_displaced({}, self.acting)
        columns = []
        for body in self._mujoco_batch.robot.recorded_bases:
            for axis in POSITION_AXES:
                joint = self._system.coordinates.index(f"q.{body}.{axis}")
                moved, _ = self.step_displaced({"q": (joint, CONTACT_DIFFERENCE)}, self.acting)
                columns.append((moved - unmoved) / CONTACT_DIFFERENCE)
        derivatives = np.concatenate(columns, axis=1)
        limit = MAX_RELATIVE_CHANGE * np.median(np.abs(derivatives).max(axis=1))
        has_changed, at_last_change = np.zeros(len(derivatives), dtype=bool), derivatives[0]
        for step, derivative in enumerate(derivatives):
            if not np.abs(derivative - at_last_change).max() <= limit:  # also for NaN
                has_changed[step], at_last_change = True, derivative
        return has_changed

    def _bind_fields(self, mujoco_batch: MujocoBatch) -> None:
        """Bind the fields of MuJoCo's data that are read, before MuJoCo's first call."""
        for name in ("qacc", *TRANSMISSION_FORCE_FIELDS, *dict(self._outputs)):
            mujoco_batch.batch.bind(name)

    @property
    def output_count(self) -> int:
        """Number of outputs that are read."""
        return len(self._outputs)

    @property
    def reads_drives(self) -> bool:
        """True if any output is a drive force."""
        return bool((self._joint_of_output >= 0).any())

    @property
    def reads_others(self) -> bool:
        """True if any output is not a drive force."""
        return bool((self._joint_of_output < 0).any())

    @property
    def has_contacts(self) -> bool:
        """True if geoms touch in the recording of a robot without floating bodies."""
        return bool(self._mujoco_batch.robot.contacts) and not self._floating

    @property
    def limbs(self) -> LimbNumbers | None:
        """Limbs of the robot: kinematic trees that do not influence each other.

        None if there is only one, or if forces may pass from tree to tree: through contacts,
        equality constraints, tendons, drives that are not at a joint, or effects that are evaluated
        in every step.
        """
        robot, model = self._mujoco_batch.robot, self._mujoco_batch.model
        may_pass_forces = (
            self.has_contacts
            or bool(self._floating)
            or any(self._step_effects)
            or model.nv != self.motion.x.shape[1]
            or bool(model.neq or model.ntendon or model.nplugin)
            or any(actuator.joint is None for actuator in robot.actuators)
            or self.reads_others
        )
        if may_pass_forces or model.ntree < 2:
            return None
        joints = np.asarray(model.dof_treeid)[self._joints.velocities]
        controls, activations = np.zeros(model.nu, dtype=int), np.zeros(model.na, dtype=int)
        for actuator in robot.actuators:
            assert actuator.joint is not None
            limb = model.dof_treeid[robot.joint(actuator.joint).velocity]
            controls[actuator.control : actuator.control + actuator.controls] = limb
            # The address is -1 without activations.
            first = max(model.actuator_actadr[actuator.id], 0)
            activations[first : first + model.actuator_actnum[actuator.id]] = limb
        states = np.concatenate([joints, joints, activations])
        results = joints if self.steps_joints_by_runge_kutta else states
        return LimbNumbers(joints, controls, activations, results, joints[self._joint_of_output])

    @property
    def steps_joints_by_runge_kutta(self) -> bool:
        """True if the integrator is the classical Runge-Kutta method, for joints alone.

        The state then consists of the positions and velocities of joints. It has no activations, no
        hidden states of effects, and no floating or unlisted bodies.
        """
        return (
            forces_are_at_step_end(self._mujoco_batch.model)
            and not self.motion.act.shape[1]
            and not self.hidden_state_effects
            and not self._floating
            and self._mujoco_batch.model.nv == self.motion.x.shape[1]
        )

    def step_displaced(
        self, moved: Displacements, acting: ActiveEffects, steps: int = 1
    ) -> tuple[Array, Array]:
        """Make a step from each of N points, with displaced states or inputs.

        The difference to the result without a displacement, divided by its size, is a column of the
        derivative of a step.

        Args:
            moved: index and size of the displacement by its quantity: ``{"q": (2, 1e-6)}`` moves
                joint 2. The quantities are those of `_place_points`. Nothing moves if empty.
            acting: active effects; the model has the elements that they add, such as a joint.
            steps: number of steps to make; more than one for a batch with shorter steps.

        Returns:
            States (N, Z) of Z components after the step, and readings (N, O) of the O outputs. A
            state consists of the positions and velocities of joints, activations, hidden states of
            effects, and displacements and velocities of floating bodies; displacements are relative
            to the motion after the step.
        """
        states, readings = [], []
        # `bind` returns a field of MuJoCo's data, with one row for each batch element.
        bind, joints, floating = self._mujoco_batch.batch.bind, self._joints, self._floating
        begin = 0  # number of points in earlier batches
        for point_count, ids in self._place_points(moved, acting):
            for _ in range(steps):
                self._mujoco_batch.batch.step(ids)
            state_columns = [
                bind("qpos")[:point_count, joints.positions],
                bind("qvel")[:point_count, joints.velocities],
            ]
            if self.motion.act.shape[1]:
                state_columns.append(bind("act")[:point_count])
            # `_place_points` has advanced the hidden states of effects by one step.
            state_columns += [state.v for state in self._next_hidden_states]
            if floating:
                # Poses of the motion at the ends of the steps.
                unperturbed = self.motion.floating_state.pose[
                    self.point_steps[begin : begin + point_count] + 1
                ]
                state_columns.append(
                    floating.compute_displacement(
                        bind("qpos")[:point_count, floating.positions], unperturbed
                    )
                )
                state_columns.append(bind("qvel")[:point_count, floating.velocities])
            begin += point_count
            states.append(np.concatenate(state_columns, axis=1))
            readings.append(self._read_outputs(point_count))
        return np.concatenate(states), np.concatenate(readings)

    def compute_accelerations(
        self,
        acting: ActiveEffects,
        extra_forces: Array | None = None,
        moved: Displacements | None = None,
        at_centres: bool = False,
    ) -> tuple[Array, Array]:
        """Compute accelerations and readings at the state of each of N points, without a step.

        Args:
            acting: active effects; the model has the elements that they add, such as a joint.
            extra_forces: (N, E) additional forces on the E velocities of joints and floating
                bodies; none by default.
            moved: index and size of a displacement by its quantity: ``{"q": (2, 1e-6)}`` moves
                joint 2. The quantities are those of `_place_points`. None by default.
            at_centres: whether joints have the state in the middle of the steps that a point stands
                for, instead of that at the point.

        Returns:
            Accelerations (N, E) of all joints and floating bodies, and readings (N, O) of the O
            outputs.
        """
        accelerations, readings = [], []
        batch, dofs = self._mujoco_batch.batch, self._dofs
        # Fields of MuJoCo's data, with one row for each batch element.
        applied_forces, qacc = batch.bind("qfrc_applied"), batch.bind("qacc")
        begin = 0  # number of points in earlier batches
        for n, ids in self._place_points(moved or {}, acting, at_centres):
            if extra_forces is not None:
                applied_forces[:n, dofs] += extra_forces[begin : begin + n]
            begin += n
            batch.forward(ids)
            accelerations.append(qacc[:n, dofs].copy())
            readings.append(self._read_outputs(n))
        return np.concatenate(accelerations), np.concatenate(readings)

    def _read_outputs(self, n: int) -> Array:
        """Read the O outputs from the first n elements of the batch, (n, O).

        An output is one column of a field of MuJoCo's data. Readings of drive forces include the
        forces that effects exert in the drive, which MuJoCo does not know.
        """
        bind = self._mujoco_batch.batch.bind
        columns = [bind(name)[:n, column, None] for name, column in self._outputs]
        if not columns:
            return np.zeros((n, 0))
        readings = np.concatenate(columns, axis=1)
        if self._drive_effect_forces.size:
            # An output that is no drive force has the joint -1.
            is_drive = self._joint_of_output >= 0
            readings[:, is_drive] += self._drive_effect_forces[:, self._joint_of_output[is_drive]]
        return readings

    @cached_property
    def _interval_centres(self) -> tuple[Array, Array]:
        """Positions and velocities (N, D) in the middle of the steps that each point stands for."""
        ends = np.append(self.point_steps[1:], len(self.motion.controls))
        below, above = (self.point_steps + ends) // 2, (self.point_steps + ends + 1) // 2
        x, v = self.motion.x, self.motion.v
        return 0.5 * (x[below] + x[above]), 0.5 * (v[below] + v[above])

    def _place_points(
        self,
        moved: Displacements,
        acting: ActiveEffects,
        at_centres: bool = False,
    ) -> Iterator[tuple[int, IndexArray | None]]:
        """Place the points in the elements of the batch, as many at a time as it has elements.

        Each batch element gets the state, controls and forces of another step of the motion, with
        the displacements added, and the forces of effects at this state. After each `yield` the
        caller lets MuJoCo evaluate the batch and reads the results.

        Args:
            moved: displacements for a difference quotient, index and size by quantity: ``q``
                position of a joint, ``v`` its velocity, ``a`` activation, ``w`` hidden state of an
                effect, ``p`` displacement of floating bodies, ``r`` their velocity, ``f`` force,
                ``u`` control. Of all but ``w`` and ``p``, several may be displaced together.
            acting: active effects.
            at_centres: whether joints have the state of `_interval_centres`.

        Yields:
            Number n of elements in use, and their indices (None if all are in use).
        """
        motion, joints, floating = self.motion, self._joints, self._floating
        count = self._mujoco_batch.count
        self.placed_count += self.point_steps.size  # a measure of the cost
        self._mujoco_batch.write_effects(_repeat_coefficients(acting, count))
        batch = self._mujoco_batch.batch
        # `bind` returns a field of MuJoCo's data, with one row for each batch element.
        bind = batch.bind
        qpos, qvel, ctrl = bind("qpos"), bind("qvel"), bind("ctrl")
        applied = bind("qfrc_applied")
        has_activations = bool(motion.act.shape[1])
        # Fields of MuJoCo's data, and their columns, of the quantities to which displacements are
        # simply added.
        columns: dict[str, Callable[[Any], tuple[Array, Any]]] = {
            "q": lambda k: (qpos, joints.positions[k]),
            "v": lambda k: (qvel, joints.velocities[k]),
            "f": lambda k: (applied, self._dofs[k]),
            "u": lambda k: (ctrl, k),
            "a": lambda k: (bind("act"), k),
            "r": lambda k: (qvel, floating.velocities[k]),
        }
        # An actuator is switched off by a force range of zero.
        ranges: ForceRanges | None = None
        if motion.off[self.point_steps].any():
            ranges = self._mujoco_batch.force_ranges()
        for begin in range(0, self.point_steps.size, count):
            steps = self.point_steps[begin : begin + count]
            point_count = steps.size
            if ranges is not None:
                ranges.write(motion.off[steps])
            # All quantities that are not set below, also those of the earlier points.
            batch.state[:] = self._reset_state
            if at_centres:
                x, v = (values[begin : begin + point_count] for values in self._interval_centres)
            else:
                x, v = motion.x[steps], motion.v[steps]
            qpos[:point_count, joints.positions] = x
            qvel[:point_count, joints.velocities] = v
            qpos[:point_count, floating.positions] = motion.floating_state.pose[steps]
            qvel[:point_count, floating.velocities] = motion.floating_state.rate[steps]
            ctrl[:point_count] = motion.controls[steps]
            applied[:point_count] = motion.forces[steps]
            if has_activations:
                bind("act")[:point_count] = motion.act[steps]
            # Poses have quaternions, which are rotated. Hidden states are not in MuJoCo's data, so
            # their displacement is passed to the effects.
            hidden_state_changes: dict[int, float] = {}
            for name, (k, size) in moved.items():
                if name == "p":
                    poses = floating.displace_coordinate(motion.floating_state.pose[steps], k, size)
                    qpos[:point_count, floating.positions] = poses
                elif name == "w":
                    hidden_state_changes[k] = size
                else:
                    field, column = columns[name](k)
                    field[:point_count, column] += size
            self._add_effect_forces(steps, point_count, hidden_state_changes)
            yield point_count, self._mujoco_batch.get_element_ids(point_count)

    def _add_effect_forces(
        self, steps: IndexArray, n: int, state_changes: Mapping[int, float]
    ) -> None:
        """Evaluate the effects that no model field represents, at the states of the batch elements.

        Forces are added to the applied forces of the batch, and dry friction is written into the
        friction limits of its model. Also advance the hidden states of the effects by one step, for
        `step_displaced`; a hidden state is a variable that an effect has in addition to the state
        of the robot.

        Args:
            steps: (n,) steps of the points.
            n: number of batch elements in use.
            state_changes: displacements of hidden states, by their numbers.
        """
        effects = self._step_effects  # three groups: forces, dry friction and hidden states
        if not any(effects):
            return
        bind, joints = self._mujoco_batch.batch.bind, self._joints
        motion = self.motion
        # Snapshot of the displaced states, with the loads of the transmissions (2, n, D).
        x = bind("qpos")[:n, joints.positions]
        v = bind("qvel")[:n, joints.velocities]
        if any(e.of in LOAD_DEPENDENT_EFFECTS for group in effects for e, _ in group):
            # As in the simulation, a servo's force must follow the perturbed state.
            self._mujoco_batch.batch.forward(self._mujoco_batch.get_element_ids(n))
            carried = np.stack(
                [bind(name)[:n, joints.velocities] for name in TRANSMISSION_FORCE_FIELDS]
            )
        else:
            carried = motion.carried[:, steps]
        snapshot = self._make_snapshot(steps, x, v, carried)
        # Forces, hidden states and dry friction. All n elements have the same coefficients.
        acting = effects.with_coefficients(np.repeat(effects.coefficients.T, n, axis=0))
        # Forces in drives are stored, since sensors of drive forces show them.
        self._drive_effect_forces = compute_drive_effect_forces(acting.forces, snapshot)
        other_forces = [(effect, c) for effect, c in acting.forces if not is_in_drive(effect)]
        force = self._drive_effect_forces + compute_effect_forces(other_forces, snapshot)
        states = [
            HiddenState(hidden.x[steps], hidden.v[steps] + state_changes.get(k, 0.0))
            for k, hidden in enumerate(self._hidden_states)
        ]
        # Hidden states act with their values at the middle of the step.
        hidden_force, _ = compute_hidden_state_forces(
            acting.hidden, (snapshot, snapshot), states, 0.5 * motion.step
        )
        force += hidden_force
        self._next_hidden_states = [
            advance_state(effect, c, snapshot, state, motion.step)
            for (effect, c), state in zip(acting.hidden, states, strict=True)
        ]
        bind("qfrc_applied")[:n, joints.velocities] += force
        limits = np.maximum(compute_friction_limits(acting.frictions, snapshot), 0.0)
        for joint in {effect.coordinate for effect, _ in acting.frictions}:
            self._mujoco_batch.set_dry_friction(n, int(joints.velocities[joint]), limits[:, joint])

    def _make_snapshot(
        self, steps: IndexArray, x: Array, v: Array, carried: Array
    ) -> RobotSnapshot:
        """Return the snapshot (the state that effects receive) at the beginning of each of n steps.

        Args:
            steps: (n,) the steps.
            x: (n, D) positions of D joints.
            v: (n, D) velocities.
            carried: (2, n, D) forces on both sides of the transmissions.
        """
        t: Array = self.motion.step * steps[:, None].astype(np.float64)  # s
        inputs = {name: u[steps, None] for name, u in self.motion.inputs.items()}
        stiffness = self.get_servo_stiffness(steps)
        return make_snapshot(self._system, t, x, v, inputs, carried, stiffness)

    def get_servo_stiffness(self, steps: IndexArray) -> Array:
        """Return the stiffness (n, D) of the position servos in the given n steps."""
        stiffness: Array = self._stiffness * self._is_servo_on[steps]
        return stiffness

    @contextmanager
    def with_batch(self, mujoco_batch: MujocoBatch) -> Iterator[None]:
        """Use another batch within a `with` block, such as one whose model has more elements.

        Args:
            mujoco_batch: batch of the same robot; its coordinates must be those of the own batch.
        """
        previous = self._mujoco_batch, self._reset_state
        if mujoco_batch is not self._mujoco_batch:
            # Fields that are bound after MuJoCo's first call would not be updated by it.
            self._bind_fields(mujoco_batch)
            mujoco_batch.batch.reset(stage=0)
            self._mujoco_batch, self._reset_state = mujoco_batch, mujoco_batch.batch.state.copy()
        try:
            yield
        finally:
            self._mujoco_batch, self._reset_state = previous

    @contextmanager
    def at_steps(self, steps: IndexArray) -> Iterator[None]:
        """Evaluate the given steps of the motion within a `with` block, instead of the points."""
        previous = self.point_steps
        self.point_steps = steps
        try:
            yield
        finally:
            self.point_steps = previous

    @contextmanager
    def limited_forces(self) -> Iterator[None]:
        """Read other outputs within a `with` block: the forces of stiff servos with force limits.

        They show at which points a force limit is reached, where the linear model is not
        valid.
        """
        previous = self._outputs, self._joint_of_output
        self._outputs = self._mujoco_batch.force_limits.outputs
        # No output counts as the reading of a drive-force sensor, to which effects would be added.
        self._joint_of_output = np.full(len(self._outputs), -1)
        self._bind_fields(self._mujoco_batch)
        try:
            yield
        finally:
            self._outputs, self._joint_of_output = previous

    def compute_mass_matrices(self) -> Array:
        """Compute the inertia matrix (N, E, E) at each of the N points.

        The E rows are those of the joints and of the floating bodies. The active effects may change
        masses, so they are written into the model first.
        """
        import mujoco

        self._mujoco_batch.write_effects(
            _repeat_coefficients(self.acting, self._mujoco_batch.count)
        )
        # All batch elements have the same effects, so the model of the first one is that of all.
        model = self._mujoco_batch.batch.get_model(0)
        data = mujoco.MjData(model)
        joints = self._joints
        full_matrix = np.zeros((model.nv, model.nv))
        matrices = []
        poses = self.motion.floating_state.pose[self.point_steps]
        for x, pose in zip(self.motion.x[self.point_steps], poses, strict=True):
            data.qpos[joints.positions] = x
            data.qpos[self._floating.positions] = pose
            # The composite rigid body algorithm.
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_crb(model, data)
            mujoco.mj_fullM(model, data, full_matrix)
            matrices.append(full_matrix[np.ix_(self._dofs, self._dofs)])
        return np.array(matrices)

    def compute_drive_reading_changes(self, effect: Effect, c: Array, readings: Array) -> Array:
        """Compute the direct changes (N, O) of readings by an effect in a drive, at the N points.

        Such an effect is a force at an actuator, for example that of a supply that sags. A sensor
        of the drive force shows it at once, before the motion changes. Other outputs do not change.

        Args:
            effect: effect in a drive.
            c: (K, 1, 1) its K coefficients.
            readings: (N, O) readings of the O outputs without the effect.
        """
        # Outputs that are no drive forces have the joint -1.
        motion, steps, joint_of_output = self.motion, self.point_steps, self._joint_of_output
        is_drive = joint_of_output >= 0
        # The effect depends on the drive forces, the first of both loads of a transmission. The
        # motion has those at the middle of a step; readings are at its beginning.
        carried = motion.carried[:, steps].copy()
        drive_forces, _ = carried  # views
        drive_forces[:, joint_of_output[is_drive]] = readings[:, is_drive]
        snapshot = self._make_snapshot(steps, motion.x[steps], motion.v[steps], carried)
        force = compute_drive_effect_forces(((effect, np.repeat(c, steps.size, axis=1)),), snapshot)
        result: Array = np.where(is_drive, force[:, joint_of_output], 0.0)
        return result

    def compute_effect_force(self, effect: Effect, c: Array) -> Array:
        """Compute the forces (S, D) of an effect on the D joints in the middle of each of S steps.

        The effect is evaluated along the unperturbed motion, at all steps at once. The cases are:

        * a hidden state, which is integrated along the motion first,
        * a force, and
        * dry friction, the force within its limit that the motion determines.

        Args:
            effect: effect with a force, a friction or a hidden state.
            c: (K, 1, 1) its K coefficients.
        """
        # Each step is one batch element of the snapshot, all with the same coefficients.
        coefficients = np.repeat(c, len(self.motion.controls), axis=1)
        if isinstance(effect, HiddenStateEffect):
            state = self.integrate_hidden_state(effect, c)
            midpoint_state = HiddenState(
                0.5 * (state.x[1:] + state.x[:-1]), 0.5 * (state.v[1:] + state.v[:-1])
            )
            force, _ = effect.act(coefficients, self.snapshot, midpoint_state)
            return force
        if isinstance(effect, Force):
            return effect.force(coefficients, self.snapshot)
        assert isinstance(effect, Friction)
        assert effect.coordinate is not None
        limit = effect.limit(coefficients, self.snapshot)[:, 0]
        forces = np.zeros_like(self.snapshot.x)
        forces[:, effect.coordinate] = self._compute_dry_friction(effect.coordinate, limit)
        return forces

    def _compute_dry_friction(self, joint: int, limit: Array) -> Array:
        """Return the force that dry friction at a joint adds in each of S steps, (S,).

        MuJoCo's dry friction is not a jump of the force with the sign of the velocity. It is a
        constraint that pulls the velocity to zero with a force of at most the limit
        (https://mujoco.readthedocs.io/en/stable/computation/index.html, "Friction loss"). The
        constraint has the reference acceleration -b v with b = 2 / (d_max timeconst), where d_max
        and timeconst are parameters of MuJoCo's solver. It has the regularisation
        R = A (1 - d) / d, with its impedance d and the inverse inertia A of the joint. With the
        velocity v at the beginning of a step, the acceleration a over it, and the acceleration A f
        by the friction force f itself, this force is

            f = -clip((a + b v + A f) / R, -limit, limit) = -clip(d (a + b v) / A, -limit, limit)

        So f changes its sign about 1 / b before v does: 9.5 ms with MuJoCo's defaults, and up to a
        step in the stiff form.

        Args:
            joint: index of the joint in the motion.
            limit: (S,) largest force of the friction in N m or N.
        """
        motion, robot = self.motion, self._mujoco_batch.robot
        dof, steps = int(self._joints.velocities[joint]), len(motion.controls)
        a = np.diff(motion.v[:, joint])[:steps] / motion.step
        b, d = get_friction_constraint(robot, dof)
        load = d * (a + b * motion.v[:steps, joint]) / float(robot.compiled.dof_invweight0[dof])
        force: Array = -np.clip(load, -limit, limit)
        return force

    def integrate_hidden_state(self, effect: Effect, c: Array) -> HiddenState:
        """Integrate an effect's hidden state along the motion, which the effect does not change.

        Args:
            effect: effect at its place.
            c: (K, 1, 1) its K coefficients.

        Returns:
            Hidden states (S + 1, 1) at the beginnings of the S steps and at the end; empty if the
            effect has none.
        """
        if not isinstance(effect, HiddenStateEffect):
            return HiddenState(np.zeros((0, 1)), np.zeros((0, 1)))
        return integrate_state(effect, c, self.snapshot, self.motion.step)

    @cached_property
    def snapshot(self) -> RobotSnapshot:
        """The whole motion as a snapshot (the state that effects receive) of S batch elements.

        Each of the S steps is one batch element, at the middle of the step. Positions and
        velocities are the means of both ends of a step.
        """
        motion = self.motion
        steps = len(motion.controls)
        t: Array = motion.step * (np.arange(float(steps)) + 0.5)
        inputs = {name: u[:, None] for name, u in motion.inputs.items()}
        x = 0.5 * (motion.x[:-1] + motion.x[1:])[:steps]
        v = 0.5 * (motion.v[:-1] + motion.v[1:])[:steps]
        stiffness = self.get_servo_stiffness(np.arange(steps))
        return make_snapshot(self._system, t[:, None], x, v, inputs, motion.carried, stiffness)


def _choose_points(
    motion: RobotMotion, spacing: int, contact_changes: Mask | None
) -> tuple[IndexArray, IndexArray]:
    """Choose the steps at which the model is linearised, one after every `spacing` steps.

    The count begins again where a piecewise constant command jumps, an actuator is switched, or a
    contact changes, because a derivative before the jump is not valid after it. So each point
    stands for the steps from a first step to the next one. The point is the first of its steps, or
    the middle one if contacts may change.

    Args:
        motion: motion at all steps: states, controls and forces.
        spacing: regular number of steps between two points.
        contact_changes: steps at which a contact changes, as a mask (S,); None if contacts cannot
            change.

    Returns:
        Steps of the N points (N,), and for each of the S steps the index of its point (S,).
    """
    steps = len(motion.controls)
    # Steps (S,) at which the count begins again; the first step is always one.
    changes = np.ones(steps, dtype=bool)
    changes[1:] = (np.diff(motion.controls, axis=0) != 0).any(axis=1)
    # A new point begins when a piecewise constant command changes. A command that changes more
    # often than there are regular points is as smooth as the motion, and needs no extra points.
    if changes.mean() > 1.0 / spacing:
        changes[1:] = False
    changes[1:] |= (motion.off[1:] != motion.off[:-1]).any(axis=1)
    if contact_changes is not None:
        changes |= contact_changes
    step_numbers = np.arange(steps)
    # Number (S,) of the last change at or before each step.
    last_change = np.maximum.accumulate(np.where(changes, step_numbers, 0))
    # Whether a step is the first of those for which a point stands.
    is_first = (step_numbers - last_change) % spacing == 0
    point_steps = np.flatnonzero(is_first)
    if contact_changes is not None:
        last_steps = np.append(point_steps[1:], steps) - 1
        point_steps = (point_steps + last_steps) // 2
    point_of_step = np.cumsum(is_first) - 1
    return point_steps, point_of_step


def find_neighbours(point_steps: IndexArray, spacing: int) -> IndexArray:
    """Find the pairs of linearisation points between which values are interpolated.

    Points follow one another at a regular distance, until a command changes. Two points that are
    not `spacing` steps apart therefore belong to different commands, between which nothing is
    interpolated. A point forms a pair with the next point of its command, or else with the previous
    one. If neither exists, it forms a pair with itself.

    Args:
        point_steps: (N,) steps of the N linearisation points.
        spacing: regular number of steps between two points.

    Returns:
        (2, N) indices of the earlier and the later point of each point's pair.
    """
    numbers = np.arange(point_steps.size)
    has_next = np.append(np.diff(point_steps) == spacing, False)
    has_previous = np.append(False, np.diff(point_steps) == spacing)
    earlier = np.where(has_next, numbers, np.where(has_previous, numbers - 1, numbers))
    later = np.where(has_next, numbers + 1, numbers)
    return np.stack([earlier, later])


def _repeat_coefficients(acting: ActiveEffects, count: int) -> ActiveEffects:
    """Repeat the coefficients of model-field effects for all elements of a batch.

    Args:
        acting: effects with coefficients (K, 1, 1).
        count: number of elements.
    """
    return tuple((e, np.repeat(c, count, axis=1)) for e, c in select_model_field_effects(acting))
