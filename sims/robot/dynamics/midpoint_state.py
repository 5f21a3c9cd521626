"""Predicted state at the middle of a step, at which effect forces are evaluated.

MuJoCo holds applied forces constant over a step. A force evaluated at the beginning is half a step
late, an error of first order. Evaluated at the middle, it gives the momentum of the force over the
step, to second order (the midpoint rule: E. Hairer, S. P. Nørsett, G. Wanner, Solving Ordinary
Differential Equations I, section II.1). With the step h, the last acceleration a that MuJoCo
computed, and the load d of a transmission at the beginning of step k and at the end of step k - 1,

    v(h / 2) = v + h/2 a,    x(h / 2) = x + h/2 v + h²/8 a                                       (1)
    d(h / 2) = d_k + (d_{k-1, end} - d_{k-1}) / 2                                                (2)

In (2) both terms of the difference have the same command: a jump with a command only appears in
d_k.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Array
from sims.robot.integrator_settings import RK4_INTEGRATOR_ID

IndexArray = NDArray[np.intp]
Mask = NDArray[np.bool_]


class JointStates(NamedTuple):
    """States of joints in a batch at the beginning of a step, (L, D) each.

    Attributes:
        x: positions.
        v: velocities.
        a: last accelerations that MuJoCo computed.
        drive: forces of the actuators on the joints.
        bias: forces by gravity and the motion of the other bodies.
        later_drive: forces of the actuators at the middle of the step.
        later_bias: forces by gravity and motion at the middle of the step.
    """

    x: Array
    v: Array
    a: Array
    drive: Array
    bias: Array
    later_drive: Array
    later_bias: Array

    @property
    def transmission_loads(self) -> tuple[Array, Array]:
        """Forces on both sides of the transmissions."""
        return self.drive, self.bias

    @property
    def at_midpoint(self) -> tuple[Array, Array]:
        """Forces on both sides of the transmissions at the middle of the step."""
        return self.later_drive, self.later_bias


def predict_midpoint(x: Array, v: Array, a: Array, step: Array | float) -> tuple[Array, Array]:
    """Predict positions and velocities half a step later, for a constant acceleration.

    With the step h they are x + h v / 2 + h^2 a / 8 and v + h a / 2. Forces that depend on the
    state are evaluated there, which is accurate to second order. A velocity that would change its
    sign keeps its value.

    Args:
        x: positions.
        v: velocities.
        a: accelerations.
        step: step length in seconds.

    Returns:
        Positions and velocities, in arrays of the same shape.
    """
    half = 0.5 * step
    later = v + half * a
    # A reversal within half a step cannot be predicted by a linear extrapolation.
    later = np.where(later * v < 0.0, v, later)
    return x + half * (v + (0.5 * half) * a), later


class MidpointPredictor:
    """Predictor of joint states at the middle of each step, for the first elements of a batch.

    It must be created before MuJoCo's first evaluation of the batch, since fields that are bound
    later are not updated.

    Attributes:
        dof_indices: addresses of the joints' velocities, as a slice if they are contiguous.
    """

    def __init__(
        self, batch: Any, positions: IndexArray, velocities: IndexArray, loaded: Mask
    ) -> None:
        """Bind MuJoCo's fields of joint states and joint forces, for the first L elements.

        A bound field is a view of MuJoCo's memory, which shows the present values.

        Args:
            batch: the mujoco.batch.Batch.
            positions: (D,) addresses of the positions of D joints.
            velocities: (D,) addresses of the joints' velocities.
            loaded: (L,) whether the load of transmissions matters; L is the number of elements in
                use.
        """
        self._batch = batch
        # Whether MuJoCo's data has the forces of the end of a step after it, or of its beginning.
        self._forces_are_at_end = forces_are_at_step_end(batch.model)
        self._loaded, self._needs_loads = loaded, bool(loaded.any())
        self._is_first_step = True
        self.dof_indices = to_slice_if_contiguous(velocities)
        # Pairs of a field and the columns of the joints, in the order x, v, a, drive, bias.
        self._fields = [(batch.bind("qpos")[: len(loaded)], to_slice_if_contiguous(positions))]
        for name in ("qvel", "qacc", "qfrc_actuator", "qfrc_bias"):
            self._fields.append((batch.bind(name)[: len(loaded)], self.dof_indices))
        # Transmission loads at the beginning of the previous step.
        self._previous_loads = np.zeros((2, len(loaded), len(velocities)))
        # Factor of the load change in (2), zero where loads do not matter.
        self._share = 0.5 * loaded[:, None]

    def read_joint_states(self, has_new_command: Mask) -> JointStates:
        """Return the joint states at the beginning of the next step; called once for each step.

        Args:
            has_new_command: (L,) whether commands of the L batch elements have changed since the
                previous step; they are already set.
        """
        x, v, a, drive, bias = (field[:, indices] for field, indices in self._fields)
        # The initial acceleration lacks the applied forces, so it is not used for prediction.
        is_first_step, self._is_first_step = self._is_first_step, False
        a = np.zeros_like(a) if is_first_step else a
        if not self._needs_loads:
            # No effect uses the loads, so those at the middle of the step need not be predicted.
            return JointStates(x, v, a, drive, bias, later_drive=drive, later_bias=bias)
        # The loads are those on both sides of a transmission: drive and bias.
        loads, midpoint_loads = self._compute_transmission_loads(has_new_command, is_first_step)
        return JointStates(x, v, a, *loads, *midpoint_loads)

    def _compute_transmission_loads(
        self, has_new_command: Mask, is_first_step: bool
    ) -> tuple[Array, Array]:
        """Return the transmission loads (2, L, D) at the beginning and at the middle of a step.

        The two loads of each of D joints, in L batch elements, are the drive's force, and the bias
        force of gravity and motion. With the load d_k at the beginning of step k, that at its
        middle is extrapolated from the change over the previous step: d_k + (d_{k-1, end} -
        d_{k-1}) / 2 (2). Both loads of the difference have the same command, so that a jump with a
        command appears in d_k alone. MuJoCo must evaluate the forces again with a new command. For
        integrators whose last evaluation is at the beginning of a step, it must always do so,
        d_{k-1, end} is not known, and both results are d_k.

        Args:
            has_new_command: (L,) whether the command changes at the beginning of the step.
            is_first_step: whether it is the first step, in which both results are d_k, too.
        """
        # d_{k-1, end}, which is also d_k without a new command; and d_{k-1}.
        end_loads = self._copy_forces()
        start_loads, previous_loads = end_loads, self._previous_loads
        # Batch elements (L,) whose forces at the beginning of this step are not known.
        to_evaluate = self._loaded & has_new_command if self._forces_are_at_end else self._loaded
        # The fields hold the forces of the previous step's last evaluation. At the first step
        # MuJoCo has already evaluated the batch.
        if not is_first_step and to_evaluate.any():
            # Only these batch elements are evaluated, so that no element depends on others.
            self._batch.forward(np.flatnonzero(to_evaluate))
            start_loads = self._copy_forces()
        self._previous_loads = start_loads
        if is_first_step or not self._forces_are_at_end:
            return start_loads, start_loads
        return start_loads, start_loads + self._share * (end_loads - previous_loads)  # (2)

    def _copy_forces(self) -> Array:
        """Return a copy of the drive and bias forces, (2, L, D)."""
        *_, (drive, dofs), (bias, _) = self._fields
        loads = np.empty_like(self._previous_loads)
        loads[0] = drive[:, dofs]
        loads[1] = bias[:, dofs]
        return loads


def forces_are_at_step_end(model: Any) -> bool:
    """Return whether the forces left in MuJoCo's data after a step are those of its end.

    The last evaluation of Runge-Kutta is at the end of the step, that of the other integrators at
    its beginning.
    """
    return bool(model.opt.integrator == RK4_INTEGRATOR_ID)


def compute_midpoint_loads(end_loads: Array, controls: Array) -> Array:
    """Compute transmission loads (2, S, D) at the middle of every step of a known motion.

    It is the load at the end of the step minus half its growth over the step. The two loads of each
    of D joints are those on both sides of a transmission: the drive's force, and that of gravity
    and motion.

    Args:
        end_loads: (2, S, D) loads at the ends of the S steps, each with the command of its step.
        controls: (S, nu) commands of the steps.
    """
    growth = np.diff(end_loads, axis=1, prepend=end_loads[:, :1])
    # NaN differs from every command, so the first step counts as one with a jump.
    has_jump: Mask = np.any(np.diff(controls, axis=0, prepend=np.nan) != 0, axis=1)
    # Where the command jumps at the beginning of a step, the difference is not a growth within the
    # step. It is replaced by that of the next step, or by zero if the command jumps there, too.
    next_has_jump = np.append(has_jump[1:], True)
    growth[:, has_jump & next_has_jump] = 0.0
    replaced = np.flatnonzero(has_jump & ~next_has_jump)
    growth[:, replaced] = growth[:, replaced + 1]
    result: Array = end_loads - 0.5 * growth
    return result


def to_slice_if_contiguous(indices: IndexArray) -> IndexArray | slice:
    """Return indices as a slice if they are contiguous, since numpy does not copy slices."""
    first = int(indices[0]) if indices.size else 0
    is_contiguous = np.array_equal(indices, np.arange(first, first + indices.size))
    return slice(first, first + indices.size) if is_contiguous else indices
