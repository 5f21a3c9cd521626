"""Physical limits and observability of the position of a body's centre of mass."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np

from sims.core.simulator import Array
from sims.robot.robot_model import RobotModel

MIN_THICKNESS_SHARE = 0.25
"""Minimum half width of a link's box, as a share of its longest side.

Motors and cables protrude from a thin rod.
"""
MARGIN_SHARE = 0.1
"""Margin of a link's box on each face, as a share of its longest side."""
MIN_PARALLEL_COSINE = 1.0 - 1e-9
"""Absolute cosine above which two joint axes count as parallel."""
UNKNOWN_LENGTH = 0.1
"""Assumed longest side, in metres, of a link in a robot whose file specifies no lengths."""


def compute_centre_of_mass_limits(robot: RobotModel, body: str) -> Array:
    """Return the limits of the offset of a body's centre of mass.

    The limits are a box that contains the geoms of the link and the joints of its child links. A
    link without either is assumed to be as long as its distance from its parent.

    Args:
        robot: robot with the body.
        body: name of the body.

    Returns:
        (3, 2) lowest and highest offset from the specified centre of mass, in metres, along the
        axes of the body's frame.
    """
    model, data = _get_reference_state(robot)
    number = robot.body(body).id
    points = np.array(list(_iterate_link_points(model, data, number)))
    low, high = points.min(axis=0), points.max(axis=0)
    longest_side = float((high - low).max()) or _estimate_link_length(model, number)
    half_sizes = (
        np.maximum(0.5 * (high - low), MIN_THICKNESS_SHARE * longest_side)
        + MARGIN_SHARE * longest_side
    )
    middle, stated_centre = 0.5 * (low + high), model.body_ipos[number]
    box: Array = np.stack(
        [middle - half_sizes - stated_centre, middle + half_sizes - stated_centre], axis=1
    )
    return box


def _iterate_link_points(model: Any, data: Any, number: int) -> Iterator[Array]:
    """Yield the points of a link, in its own frame, that its box must contain.

    They are its origin, its specified centre of mass, the corners of its geoms, and the origins of
    its child bodies.
    """
    import mujoco

    origin, axes = data.xpos[number], data.xmat[number].reshape(3, 3)
    yield np.zeros(3)
    yield model.body_ipos[number]
    flat = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
    for body in _list_fixed_bodies(model, number):
        yield axes.T @ (data.xpos[body] - origin)
        first, count = model.body_geomadr[body], model.body_geomnum[body]
        for geom in range(first, first + count):
            if int(model.geom_type[geom]) in flat:
                continue
            centre, size = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            geom_axes = data.geom_xmat[geom].reshape(3, 3)
            for corner in np.ndindex(2, 2, 2):
                corner_point = centre + size * (2.0 * np.array(corner) - 1.0)
                yield axes.T @ (data.geom_xpos[geom] + geom_axes @ corner_point - origin)
        for child in np.flatnonzero(model.body_parentid == body):
            if child and model.body_jntnum[child]:
                yield axes.T @ (data.xpos[child] - origin)


def _list_fixed_bodies(model: Any, number: int) -> list[int]:
    """Return the numbers of a body and of all bodies that are rigidly attached below it."""
    bodies = [number]
    for child in range(number + 1, model.nbody):
        if model.body_parentid[child] in bodies and not model.body_jntnum[child]:
            bodies.append(child)
    return bodies


def _estimate_link_length(model: Any, number: int) -> float:
    """Return the assumed length, in metres, of a link without a specified shape.

    It is the distance of the link from its parent, or else the longest such distance in the robot.
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

    Args:
        robot: robot with the body.
        body: name of the body.

    Returns:
        Observable axes, 0, 1, 2 for x, y, z.
    """
    return _compute_observable_axes(robot.compiled, robot.body(body).id)


def _compute_observable_axes(model: Any, number: int) -> tuple[int, ...]:
    """Return the observable axes of body `number` of a compiled model, see `observable_axes`.

    `axes` collects, in world coordinates, the hinge axes between the body and the world.
    """
    import mujoco

    hinge, slide = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    data = _make_reference_data(model)
    axes = []
    body = number
    while body:
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        for joint in range(first, first + count):
            kind = int(model.jnt_type[joint])
            if kind == hinge:
                axes.append(data.xaxis[joint])
            elif kind != slide:
                return (0, 1, 2)
        body = int(model.body_parentid[body])
    if not axes:
        return ()
    if any(abs(float(axis @ axes[0])) < MIN_PARALLEL_COSINE for axis in axes):
        return (0, 1, 2)
    along = data.xmat[number].reshape(3, 3).T @ axes[0]
    # For a diagonal direction the nearest frame axis is omitted, since the two others suffice.
    nearest_axis = int(np.argmax(np.abs(along).round(9)))
    return tuple(axis for axis in range(3) if axis != nearest_axis)


def _get_reference_state(robot: RobotModel) -> tuple[Any, Any]:
    return robot.compiled, _make_reference_data(robot.compiled)


@lru_cache(maxsize=8)
def _make_reference_data(model: Any) -> Any:
    """Return MuJoCo's data with the poses of all bodies in the reference pose of the model."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    return data
