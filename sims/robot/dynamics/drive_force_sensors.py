"""Corrections of the readings of drive-force sensors, which MuJoCo computes for its own inputs.

MuJoCo applies the mean of a command over a step, and does not know the forces of effects in drives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sims.core.effect import ActiveEffects
from sims.core.simulator import Array
from sims.robot.coupled_drives import COUPLING_FIELD, find_preceding_joint, get_coupling_address
from sims.robot.dynamics.activation_filters import activation_filters
from sims.robot.dynamics.active_effects import (
    find_active_elements,
    is_in_drive,
    slice_active_effects,
)
from sims.robot.dynamics.disabled_drives import find_working_servos
from sims.robot.dynamics.effect_forces import compute_drive_effect_forces, make_snapshot
from sims.robot.dynamics.mujoco_batch import MujocoBatch
from sims.robot.dynamics.run_batches import BatchInputs
from sims.robot.robot_model import Actuator, RobotModel
from sims.robot.robot_system import RobotSystem


@dataclass(frozen=True)
class DriveSensorModel:
    """Drive-force readings of the batch elements of one MuJoCo batch.

    Attributes:
        robot: robot that is simulated.
        system: system of the robot.
        batch: MuJoCo batch, whose `drives` are the columns of the drive forces in its sensor data.
        inputs: inputs of the batch elements.
        step: step length in seconds.
    """

    robot: RobotModel
    system: RobotSystem
    batch: MujocoBatch
    inputs: BatchInputs
    step: float

    def shift_to_step_begin(self, readings: Array) -> None:
        """Correct drive-force readings for commands that change within a step.

        MuJoCo applies the mean of a command over a step, but a sensor of the drive force shows the
        force at the beginning. The difference of the two commands times the actuator's force per
        unit of command is added, within its force limits. If a drive is coupled to the preceding
        joint, the reading of that joint changes in proportion.

        Args:
            readings: (n, S, k) sensor data, k numbers of n batch elements in each of S steps;
                changed in place.
        """
        batch_inputs, mujoco_batch = self.inputs, self.batch
        columns = mujoco_batch.drives  # column of the drive force in the sensor data, by joint
        batch_size = len(readings)
        for actuator in self.robot.actuators:
            # Command at the beginning of a step minus its mean over the step; none while it is off.
            control_change = (
                batch_inputs.instant[:, :, actuator.control]
                - batch_inputs.controls[:, :, actuator.control]
            )
            control_change = np.where(batch_inputs.off[:, :, actuator.id], 0.0, control_change)
            # Without a driven joint no sensor shows the force.
            if actuator.joint not in columns or not control_change.any():
                continue
            force = readings[:, :, columns[actuator.joint]]  # a view
            force_before = force.copy()
            force += control_change * self._compute_force_per_control(actuator)[:batch_size, None]
            np.clip(force, *self._get_force_limits(actuator), out=force)
            if actuator.joint in mujoco_batch.robot.coupled:
                preceding_joint = find_preceding_joint(self.robot, actuator.joint)
                assert preceding_joint is not None  # only such joints can be coupled
                # Force on the preceding joint per unit of the drive's force, (n,).
                coupling: Array = mujoco_batch.fields[COUPLING_FIELD][
                    :batch_size, get_coupling_address(mujoco_batch.robot, actuator.joint)
                ]
                preceding_column = columns[preceding_joint.name]
                readings[:, :, preceding_column] += coupling[:, None] * (force - force_before)

    def add_drive_effects(self, readings: Array, x: Array, v: Array, acting: ActiveEffects) -> None:
        """Add the forces of effects in the drives to the drive-force readings.

        Examples are a dead zone and a voltage drop. The simulation applies these effects as
        external forces, so MuJoCo's sensors do not contain them. They are evaluated at the
        beginnings of all steps at once: each pair of a batch element and a step is one element of a
        snapshot.

        Args:
            readings: (n, S, k) sensor data, k numbers of n batch elements in each of S steps;
                changed in place.
            x: (n, S + 1, D) positions of the D joints.
            v: (n, S + 1, D) velocities.
            acting: active effects with K coefficients each, (K, n, 1).
        """
        # 1. Batch elements with such an effect, and their readings of all drives.
        batch_indices = np.flatnonzero(find_active_elements(acting, len(x), is_in_drive))
        if not batch_indices.size:
            return
        mujoco_batch, batch_inputs, steps = self.batch, self.inputs, readings.shape[1]
        columns = [mujoco_batch.drives[name.removeprefix("q.")] for name in self.system.coordinates]
        drive_readings = readings[batch_indices][:, :, columns]

        # 2. Snapshot of all steps.
        def flatten(values: Array) -> Array:
            """Stack all steps of the selected batch elements into one axis."""
            return values[batch_indices, :steps].reshape(batch_indices.size * steps, -1)

        inputs = {name: flatten(u) for name, u in batch_inputs.applied_inputs.items()}
        for actuator in self.robot.actuators:
            # The output of an activation filter does not change within a step.
            if not self._is_filtered(actuator):
                inputs[f"u.{actuator.name}"] = flatten(batch_inputs.instant[:, :, actuator.control])
        t = np.tile(self.step * np.arange(float(steps)), batch_indices.size)[:, None]
        drive = drive_readings.reshape(batch_indices.size * steps, -1)
        # The load on the other side of the transmissions does not matter to effects in drives.
        carried = np.stack([drive, np.zeros_like(drive)])
        stiffness = np.repeat(
            mujoco_batch.get_servo_stiffness(mujoco_batch.file_joints)[batch_indices], steps, axis=0
        )
        if batch_inputs.off.any():
            is_servo_on = find_working_servos(
                mujoco_batch.robot,
                mujoco_batch.file_joints.velocities,
                batch_inputs.off[batch_indices, :steps],
            )
            stiffness = stiffness * is_servo_on.reshape(stiffness.shape)
        snapshot = make_snapshot(self.system, t, flatten(x), flatten(v), inputs, carried, stiffness)
        # 3. Forces of the effects.
        selected = slice_active_effects(
            tuple((e, c) for e, c in acting if is_in_drive(e)), batch_indices
        )
        repeated = tuple((e, np.repeat(c, steps, axis=1)) for e, c in selected)
        drive_readings += compute_drive_effect_forces(repeated, snapshot).reshape(
            drive_readings.shape
        )
        # The indices are broadcast to (batch elements, steps, drives).
        readings[batch_indices[:, None, None], np.arange(steps)[:, None], columns] = drive_readings

    def _compute_force_per_control(self, actuator: Actuator) -> Array:
        """Return the joint force at once per unit of an actuator's control, (N,) in the batch.

        It is zero if a filter precedes the actuator, or if the force is not a gain times the
        control. Effects may change the gain, so that the N elements of the batch differ.
        """
        gear = float(self.robot.compiled.actuator_gear[actuator.id, 0])
        gain: Array = self.batch.fields["actuator_gainprm"][:, actuator.id, 0]
        has_constant_gain = actuator.kind in ("motor", "position", "velocity")
        acts_at_once = has_constant_gain and not self._is_filtered(actuator)
        return gear * gain if acts_at_once else np.zeros_like(gain)

    def _is_filtered(self, actuator: Actuator) -> bool:
        """Return whether a filter precedes the actuator, so that controls act with a delay."""
        return any(one.actuator == actuator for one in activation_filters(self.robot))

    def _get_force_limits(self, actuator: Actuator) -> tuple[float, float]:
        """Return lower and upper limit of an actuator's joint force; infinite if unspecified.

        The actuator's own limit is multiplied by its gear; the joint may have a limit, too.

        Args:
            actuator: actuator of a joint.

        Returns:
            Lower and upper limit in N or N m.
        """
        gear = abs(float(self.robot.compiled.actuator_gear[actuator.id, 0]))
        low, high = actuator.force or (-np.inf, np.inf)
        assert actuator.joint is not None  # the caller skips actuators without a joint
        effort = self.robot.joint(actuator.joint).effort or np.inf
        return max(gear * low, -effort), min(gear * high, effort)
