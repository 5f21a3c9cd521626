"""Directions in which a tilt of a joint's axis changes the motion of a robot."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from sims.core.simulator import Array
from sims.robot.robot_model import Joint, RobotModel, cache_per_robot

POSE_COUNT = 4
"""Number of random poses and velocities in which forces are compared."""
TILT_STEP = 1e-4
"""Finite difference of a tilt in rad."""
MAX_UNOBSERVABLE_SHARE = 1e-6
"""Largest change of forces per rad, as a share of the forces, that counts as none."""


@cache_per_robot
def observable_tilts(robot: RobotModel, name: str) -> tuple[int, ...]:
    """Return the axes of a body's frame about which a tilt of a joint's axis changes the motion.

    The frame axis nearest to the joint's own axis is omitted, since the two others give every
    direction. A tilt out of the plane of a planar mechanism changes nothing to first order, so it
    is omitted as well: forces of gravity, velocity and inertia are compared in random poses.

    Args:
        robot: robot with the joint.
        name: name of a joint with one coordinate.

    Returns:
        Observable axes, 0, 1, 2 for x, y, z.
    """
    model = copy.copy(robot.compiled)
    joint = robot.joint(name)
    file_axis = model.jnt_axis[joint.id].copy()
    nearest_axis = int(np.argmax(np.abs(file_axis).round(9)))
    observable = []
    for axis in (axis for axis in range(3) if axis != nearest_axis):
        tilt_direction = np.cross(np.eye(3)[axis], file_axis)
        forces_by_sign = []
        for sign in (1.0, -1.0):
            model.jnt_axis[joint.id] = _normalise(file_axis + sign * TILT_STEP * tilt_direction)
            forces_by_sign.append(_compute_random_state_forces(model, robot.joints))
        change = (forces_by_sign[0] - forces_by_sign[1]) / (2.0 * TILT_STEP)
        if (np.abs(change) > MAX_UNOBSERVABLE_SHARE * np.abs(forces_by_sign[0]).max()).any():
            observable.append(axis)
    return tuple(observable)


def _normalise(vector: Array) -> Array:
    """Return the vector scaled to length 1."""
    result: Array = vector / np.linalg.norm(vector)
    return result


def _compute_random_state_forces(model: Any, joints: tuple[Joint, ...]) -> Array:
    """Return bias forces and inertia matrices in fixed random states, as one vector.

    If a change of the model changes none of these numbers, it changes no motion.
    """
    import mujoco

    data = mujoco.MjData(model)
    rng = np.random.default_rng(11)
    inertia = np.zeros((model.nv, model.nv))
    parts = []
    for _ in range(POSE_COUNT):
        data.qpos[:] = model.qpos0
        for joint in joints:
            if joint.has_one_coordinate:
                data.qpos[joint.position] += rng.uniform(-1.0, 1.0)
        data.qvel[:] = rng.uniform(-1.0, 1.0, model.nv)
        for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_makeM):
            compute(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_fullM(model, data, inertia)
        bias = np.zeros(model.nv)
        mujoco.mj_rne(model, data, 0, bias)
        parts += [bias, inertia.ravel().copy()]
    return np.concatenate(parts)
