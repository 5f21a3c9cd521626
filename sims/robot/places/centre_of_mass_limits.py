"""Limits of centres of mass, and tilts of gravity that a robot's motion can show."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np

from sims.core.simulator import Array
from sims.robot.robot_model import Joint, RobotModel, cache_per_robot

MIN_THICKNESS_SHARE = 0.25
"""Minimum half width of a link's box, as a share of its longest side.

Motors and cables protrude from a thin rod.
"""
MARGIN_SHARE = 0.1
"""Margin of a link's box on each face, as a share of its longest side."""
MIN_PARALLEL_COSINE = 1.0 - 1e-9
"""Absolute cosine above which two joint axes count as parallel."""
CUBE_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
"""Corners (8, 3) of a cube with sides of 2."""
UNKNOWN_LENGTH = 0.1
"""Assumed longest side, in metres, of a link in a robot whose file specifies no lengths."""


def compute_centre_of_mass_limits(robot: RobotModel, body: str) -> Array:
    """Return the limits of the offset of a body's centre of mass, as the link's size allows it.

    A fitted offset outside them would put the centre of mass outside the link. The limits are a box
    that contains the geoms and sites of the link and the joints of its child links. A link without
    geoms is as large as its inertia needs, and one without any of these and inertia is assumed to
    be as long as its distance from its parent.

    Returns:
        (3, 2) lowest and highest offset from the specified centre of mass, in metres, along the
        axes of the body's frame.
    """
    model, data = robot.compiled, _make_reference_data(robot.compiled)
    body_id = robot.body(body).id
    points = np.array(list(_iterate_link_points(model, data, body_id)))
    low, high = points.min(axis=0), points.max(axis=0)
    longest_side = float((high - low).max()) or _estimate_link_length(model, body_id)
    half_sizes = (
        np.maximum(0.5 * (high - low), MIN_THICKNESS_SHARE * longest_side)
        + MARGIN_SHARE * longest_side
    )
    middle, stated_centre = 0.5 * (low + high), model.body_ipos[body_id]
    box: Array = np.stack(
        [middle - half_sizes - stated_centre, middle + half_sizes - stated_centre], axis=1
    )
    return box


def _iterate_link_points(model: Any, data: Any, body_id: int) -> Iterator[Array]:
    """Yield the points of a link, in its own frame, that its box must contain.

    They are its origin, its stated centre of mass, the corners of its geoms, its sites, such as
    those of rotors, and the origins of its child bodies. Without geoms they are also the corners of
    the box that has its mass and inertia.

    Args:
        model: compiled model.
        data: MuJoCo data at the reference pose.
        body_id: index of the body.
    """
    import mujoco

    origin, axes = data.xpos[body_id], data.xmat[body_id].reshape(3, 3)
    yield np.zeros(3)
    yield model.body_ipos[body_id]
    flat = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
    bodies = _list_fixed_bodies(model, body_id)
    if not model.body_geomnum[bodies].any():
        inertia_axes = np.zeros(9)
        mujoco.mju_quat2Mat(inertia_axes, model.body_iquat[body_id])
        half_sides = _compute_box_of_inertia(model, body_id)
        for corner in CUBE_CORNERS:
            yield model.body_ipos[body_id] + inertia_axes.reshape(3, 3) @ (half_sides * corner)
    for body in bodies:
        yield axes.T @ (data.xpos[body] - origin)
        for site in np.flatnonzero(model.site_bodyid == body):
            yield axes.T @ (data.site_xpos[site] - origin)
        first, count = model.body_geomadr[body], model.body_geomnum[body]
        for geom in range(first, first + count):
            if int(model.geom_type[geom]) in flat:
                continue
            centre, size = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            geom_axes = data.geom_xmat[geom].reshape(3, 3)
            for corner in CUBE_CORNERS:
                corner_point = centre + size * corner
                yield axes.T @ (data.geom_xpos[geom] + geom_axes @ corner_point - origin)
        for child in np.flatnonzero(model.body_parentid == body):
            if child and model.body_jntnum[child]:
                yield axes.T @ (data.xpos[child] - origin)


def _compute_box_of_inertia(model: Any, number: int) -> Array:
    """Return half the sides (3,), in metres, of the uniform box with a body's mass and inertia.

    A box with sides 2 a, 2 b, 2 c and mass m has the moment of inertia m (b² + c²) / 3 about the
    side a.

    Args:
        model: compiled model.
        number: number of the body.
    """
    mass, moments = float(model.body_mass[number]), model.body_inertia[number]
    if mass <= 0.0:
        return np.zeros(3)
    squares: Array = 1.5 * (moments.sum() - 2.0 * moments) / mass
    return np.sqrt(np.maximum(squares, 0.0))


def _list_fixed_bodies(model: Any, number: int) -> list[int]:
    """Return the numbers of a body and of all bodies that are rigidly attached below it.

    Args:
        model: compiled model.
        number: number of the body.
    """
    bodies = [number]
    for child in range(number + 1, model.nbody):
        if model.body_parentid[child] in bodies and not model.body_jntnum[child]:
            bodies.append(child)
    return bodies


def _estimate_link_length(model: Any, number: int) -> float:
    """Return the assumed length, in metres, of a link without a specified shape.

    It is the distance of the link from its parent, or else the longest such distance in the robot.

    Args:
        model: compiled model.
        number: number of the body.
    """
    distances = np.linalg.norm(model.body_pos[1:], axis=1)
    return float(distances[number - 1]) or float(distances.max(initial=0.0)) or UNKNOWN_LENGTH


def observable_axes(robot: RobotModel, body: str) -> tuple[int, ...]:
    """Return the frame axes along which a shift of a body's centre of mass changes the motion.

    If all hinges between the world and the body have parallel axes, a shift along that direction
    moves no mass relative to the hinges and changes no torque of gravity. So the frame axis nearest
    to that direction is omitted; offsets along the two others give every possible motion. A body
    that only slides has no observable axis. A floating body, or one that turns about several
    directions, has three.

    Returns:
        Observable axes, 0, 1, 2 for x, y, z.
    """
    import mujoco

    model, number = robot.compiled, robot.body(body).id
    hinge, slide = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    data = _make_reference_data(model)
    axes = []  # of the hinges between the body and the world, in world coordinates
    carrier = number
    while carrier:
        first, count = model.body_jntadr[carrier], model.body_jntnum[carrier]
        for joint in range(first, first + count):
            kind = int(model.jnt_type[joint])
            if kind == hinge:
                axes.append(data.xaxis[joint])
            elif kind != slide:
                return (0, 1, 2)
        carrier = int(model.body_parentid[carrier])
    if not axes:
        return ()
    if any(abs(float(axis @ axes[0])) < MIN_PARALLEL_COSINE for axis in axes):
        return (0, 1, 2)
    along = data.xmat[number].reshape(3, 3).T @ axes[0]
    # For a diagonal direction the nearest frame axis is omitted, since the two others suffice.
    nearest_axis = int(np.argmax(np.abs(along).round(9)))
    return tuple(axis for axis in range(3) if axis != nearest_axis)


@lru_cache(maxsize=8)
def _make_reference_data(model: Any) -> Any:
    """Return MuJoCo's data with the poses of all bodies in the reference pose of the model."""
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

    Only such tilts can be fitted. The frame axis nearest to the joint's own axis is omitted, since
    the two others give every direction. A tilt out of the plane of a planar mechanism changes
    nothing to first order, so it is omitted as well: the joint forces with and without a tilt are
    compared in random states.

    Args:
        robot: model of the robot.
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
            axis_vector = file_axis + sign * TILT_STEP * tilt_direction
            model.jnt_axis[joint.id] = axis_vector / np.linalg.norm(axis_vector)
            forces_by_sign.append(_compute_random_state_forces(model, robot.joints))
        change = (forces_by_sign[0] - forces_by_sign[1]) / (2.0 * TILT_STEP)
        if (np.abs(change) > MAX_UNOBSERVABLE_SHARE * np.abs(forces_by_sign[0]).max()).any():
            observable.append(axis)
    return tuple(observable)


def _compute_random_state_forces(model: Any, joints: tuple[Joint, ...]) -> Array:
    """Return bias forces and inertia matrices in fixed random states, as one vector.

    They determine the motion. So a change of the model that changes none of these numbers cannot be
    observed.

    Args:
        model: compiled model.
        joints: joints that have random positions.
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
        for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_makeM):
            compute(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_fullM(model, data, inertia)
        bias = np.zeros(model.nv)
        mujoco.mj_rne(model, data, 0, bias)
        biases_and_inertias += [bias, inertia.ravel().copy()]
    return np.concatenate(biases_and_inertias)
