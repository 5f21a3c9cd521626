"""Inverse dynamics along a measured motion, and the inertia matrix."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sims.core.simulator import Array
from sims.robot.robot_model import Joint


class MotionForces(NamedTuple):
    """Forces at J joints at T times, (T, J) each.

    Attributes:
        needed: forces that the motion requires by inverse dynamics, in addition to gravity and the
            passive forces of the model.
        driven: forces that the actuators of the model exert.
    """

    needed: Array
    driven: Array


def motion_forces(
    model: Any,
    joints: Sequence[Joint],
    motion: Array,
    controls: Array,
    activations: Array | None = None,
) -> MotionForces:
    """Compute the joint forces of a motion by inverse dynamics, and those of the actuators.

    Inverse dynamics gives the forces that the motion requires in addition to gravity and the
    passive forces of the model. Their difference from the forces of the actuators is the force that
    the model lacks. The motion is given, so nothing is integrated. Joints that are not in `joints`
    rest in the reference pose of the model.

    Args:
        model: compiled mujoco.MjModel.
        joints: J joints with one coordinate each.
        motion: (3, T, J) positions, velocities and accelerations of the joints at T times.
        controls: (T, nu) controls of all actuators.
        activations: (T, na) activations of all actuators; zero if None.

    Returns:
        The required forces and the actuator forces in N or N m, (T, J) each.
    """
    import mujoco

    data = mujoco.MjData(model)
    qpos, qvel, qacc, ctrl, act = data.qpos, data.qvel, data.qacc, data.ctrl, data.act
    inverse_forces, actuator_forces = data.qfrc_inverse, data.qfrc_actuator
    positions = np.array([joint.position for joint in joints], dtype=np.intp)
    dofs = np.array([joint.velocity for joint in joints], dtype=np.intp)
    needed, driven = np.zeros(motion.shape[1:]), np.zeros(motion.shape[1:])
    for sample in range(motion.shape[1]):
        qpos[positions], qvel[dofs], qacc[dofs] = motion[:, sample]
        mujoco.mj_inverse(model, data)
        needed[sample] = inverse_forces[dofs]
        ctrl[:] = controls[sample]
        if activations is not None:
            act[:] = activations[sample]
        mujoco.mj_fwdActuation(model, data)
        driven[sample] = actuator_forces[dofs]
    return MotionForces(needed, driven)


def inertia_matrix(model: Any) -> Array:
    """Return the inertia matrix (nv, nv) of a MuJoCo model in its reference pose `qpos0`."""
    import mujoco

    data, matrix = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, matrix)
    return matrix
