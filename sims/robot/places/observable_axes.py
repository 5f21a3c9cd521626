"""Axes along which a shift of a centre of mass, or about which a tilt of a joint, is observable."""

from __future__ import annotations

import copy
from functools import lru_cache
from typing import Any

import numpy as np

from sims.core.simulator import Array
from sims.robot.robot_model import Joint, RobotModel, cache_per_robot

MIN_PARALLEL_COSINE = 1.0 - 1e-9
"""Absolute cosine above which two joint axes count as parallel."""


def observable_axes(robot: RobotModel, body: str) -> tuple[int, ...]:
    """Return the frame axes along which a shift of a body's centre of mass changes the motion.

    The cases are:

    * Only slides between the world and the body: no axis, since it does not turn.
    * Hinges with parallel axes: a shift along that direction moves no mass relative to the hinges
      and changes no torque of gravity. So the frame axis nearest to that direction is omitted;
      offsets along the two others give every possible motion.
    * Hinges about several directions, or a floating body: all three axes.

    Args:
        robot: robot with the body.
        body: name of the body.

    Returns:
        Observable axes, 0, 1, 2 for x, y, z.
    """
    import mujoco

    model, number = robot.compiled, robot.body(body).id
    hinge, slide = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    data = make_reference_data(model)
    hinge_axes = []  # unit vectors in the world, of the hinges between the body and the world
    ancestor = number
    while ancestor:  # until the world, body 0
        first, count = model.body_jntadr[ancestor], model.body_jntnum[ancestor]
        for joint in range(first, first + count):
            kind = int(model.jnt_type[joint])
            if kind == hinge:
                hinge_axes.append(data.xaxis[joint])
            elif kind != slide:  # a free or a ball joint
                return (0, 1, 2)
        ancestor = int(model.body_parentid[ancestor])
    if not hinge_axes:
        return ()
    # All hinges are parallel if they are parallel to the first one.
    direction = hinge_axes[0]
    if any(abs(float(axis @ direction)) < MIN_PARALLEL_COSINE for axis in hinge_axes):
        return (0, 1, 2)
    direction_in_body = data.xmat[number].reshape(3, 3).T @ direction
    # Equal components are rounded, so that rounding errors do not decide between them.
    nearest_axis = int(np.argmax(np.abs(direction_in_body).round(9)))
    return tuple(axis for axis in range(3) if axis != nearest_axis)


@lru_cache(maxsize=8)
def make_reference_data(model: Any) -> Any:
    """Return MuJoCo's data with the poses of all bodies in the reference pose of the model.

    Args:
        model: compiled model.
    """
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    return data


POSE_COUNT = 4
"""Number of random poses and velocities in which forces are compared."""


TILT_STEP = 1e-4
"""Finite difference of a tilt in rad."""


MAX_UNOBSERVABLE_SHARE = 1e-6
"""Largest change of forces per rad, as a share of the forces, that counts as none."""


@cache_per_robot
def observable_tilts(robot: RobotModel, name: str) -> tuple[int, ...]:
    """Return the axes of a body's frame about which a tilt of a joint's axis changes the motion.

    Only such tilts can be fitted. Two are omitted:

    * The frame axis nearest to the joint's own axis, since tilts about the two others give every
      direction.
    * A tilt that changes no forces to first order, such as one out of the plane of a planar
      mechanism. Forces with opposite small tilts are compared in random states.

    Args:
        robot: model of the robot.
        name: name of a joint with one coordinate.

    Returns:
        Observable axes, 0, 1, 2 for x, y, z.
    """
    model = copy.copy(robot.compiled)
    joint = robot.joint(name)
    file_axis = model.jnt_axis[joint.id].copy()
    # Rounded, so that rounding errors do not decide between equal components.
    nearest_axis = int(np.argmax(np.abs(file_axis).round(9)))
    observable = []
    for axis in (axis for axis in range(3) if axis != nearest_axis):
        # To first order, the axis moves along the cross product of the tilt's axis and itself.
        tilt_direction = np.cross(np.eye(3)[axis], file_axis)
        forces_by_sign = []
        for sign in (1.0, -1.0):
            axis_vector = file_axis + sign * TILT_STEP * tilt_direction
            model.jnt_axis[joint.id] = axis_vector / np.linalg.norm(axis_vector)
            forces_by_sign.append(_compute_random_state_forces(model, robot.joints))
        forward, backward = forces_by_sign
        change = (forward - backward) / (2.0 * TILT_STEP)
        if (np.abs(change) > MAX_UNOBSERVABLE_SHARE * np.abs(forward).max()).any():
            observable.append(axis)
    return tuple(observable)


def _compute_random_state_forces(model: Any, joints: tuple[Joint, ...]) -> Array:
    """Return bias forces (gravity, Coriolis) and inertia matrices in random states, as one vector.

    They determine the motion. So a change of the model that changes none of these numbers cannot be
    observed. The states are the same in each call.

    Args:
        model: compiled model.
        joints: joints of the robot; those with one coordinate have random positions.
    """
    import mujoco

    data = mujoco.MjData(model)
    rng = np.random.default_rng(11)
    inertia = np.zeros((model.nv, model.nv))
    biases_and_inertias = []
    for _ in range(POSE_COUNT):
        data.qpos[:] = model.qpos0
        for joint in joints:
            if joint.has_one_coordinate:
                data.qpos[joint.position] += rng.uniform(-1.0, 1.0)
        data.qvel[:] = rng.uniform(-1.0, 1.0, model.nv)
        # Positions, the inertia matrix, and velocities of the bodies.
        for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_makeM):
            compute(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_fullM(model, data, inertia)
        # The recursive Newton-Euler algorithm without accelerations gives the bias forces.
        bias = np.zeros(model.nv)
        mujoco.mj_rne(model, data, 0, bias)
        biases_and_inertias += [bias, inertia.ravel().copy()]
    return np.concatenate(biases_and_inertias)
