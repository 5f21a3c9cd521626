"""Physical limits of a body's centre of mass: how far its link reaches, and along which axes of its
frame the position of the centre of mass can be observed at all.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np

from sims.base import Array
from sims.robot.model import Robot

THINNEST = 0.25
"""Half width of a link's box is at least this share of its longest side: motors and cables stick
out of a thin rod.
"""
MARGIN = 0.1
"""The box is enlarged by this share of its longest side on each face."""
PARALLEL = 1.0 - 1e-9
"""Absolute cosine above which two joint axes are parallel."""
UNKNOWN_LENGTH = 0.1
"""Longest side in metres of a link in a robot whose file states no lengths."""


def reach(robot: Robot, body: str) -> Array:
    """Return the box that a body's centre of mass cannot leave, (3, 2) lowest and highest offset
    from the stated centre of mass in metres, along the axes of the body's frame.

    The box holds the geoms of the link and the joints of the links that it carries. A link without
    either is taken to be as long as its distance from the joint before.
    """
    model, data = _at_start(robot)
    number = robot.body(body).id
    points = np.array(list(_points(model, data, number)))
    low, high = points.min(axis=0), points.max(axis=0)
    longest = float((high - low).max()) or _length(model, number)
    half = np.maximum(0.5 * (high - low), THINNEST * longest) + MARGIN * longest
    middle, stated = 0.5 * (low + high), model.body_ipos[number]
    box: Array = np.stack([middle - half - stated, middle + half - stated], axis=1)
    return box


def _points(model: Any, data: Any, number: int) -> Iterator[Array]:
    """Points of a link in its own frame: its origin, its stated centre of mass, corners of its
    geoms, and origins of the bodies that it carries.
    """
    import mujoco

    origin, axes = data.xpos[number], data.xmat[number].reshape(3, 3)
    yield np.zeros(3)
    yield model.body_ipos[number]
    flat = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
    for one in _fixed_to(model, number):
        yield axes.T @ (data.xpos[one] - origin)
        first, count = model.body_geomadr[one], model.body_geomnum[one]
        for geom in range(first, first + count):
            if int(model.geom_type[geom]) in flat:
                continue
            centre, size = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            turned = data.geom_xmat[geom].reshape(3, 3)
            for corner in np.ndindex(2, 2, 2):
                local = centre + size * (2.0 * np.array(corner) - 1.0)
                yield axes.T @ (data.geom_xpos[geom] + turned @ local - origin)
        for child in np.flatnonzero(model.body_parentid == one):
            if child and model.body_jntnum[child]:
                yield axes.T @ (data.xpos[child] - origin)


def _fixed_to(model: Any, number: int) -> list[int]:
    """A body and those that are fixed to it."""
    found = [number]
    for child in range(number + 1, model.nbody):
        if model.body_parentid[child] in found and not model.body_jntnum[child]:
            found.append(child)
    return found


def _length(model: Any, number: int) -> float:
    """Length in metres of a link of which the file states no shape: its distance from the link
    before, else the longest such distance in the robot.
    """
    distances = np.linalg.norm(model.body_pos[1:], axis=1)
    return float(distances[number - 1]) or float(distances.max(initial=0.0)) or UNKNOWN_LENGTH


def observable_axes(robot: Robot, body: str) -> tuple[int, ...]:
    """Return the axes (0, 1, 2 for x, y, z) of a body's frame along which a shift of its centre of
    mass can change the motion.

    Let all hinges between the world and the body have parallel axes. A shift along that direction
    moves no mass relative to the axes and changes no torque of gravity, so the axis of the frame
    that is nearest to it is left out: offsets along the two others give every possible motion. A
    body that only slides has no observable axis; one that floats or turns about several directions
    has three.
    """
    return _observable(robot.compiled, robot.body(body).id)


def _observable(model: Any, number: int) -> tuple[int, ...]:
    import mujoco

    hinge, slide = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    data = _started(model)
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
    if any(abs(float(axis @ axes[0])) < PARALLEL for axis in axes):
        return (0, 1, 2)
    along = data.xmat[number].reshape(3, 3).T @ axes[0]
    # Of a diagonal direction the file's axis nearest to it: the two others reach all that matters.
    nearest = int(np.argmax(np.abs(along).round(9)))
    return tuple(axis for axis in range(3) if axis != nearest)


def _at_start(robot: Robot) -> tuple[Any, Any]:
    return robot.compiled, _started(robot.compiled)


@lru_cache(maxsize=8)
def _started(model: Any) -> Any:
    """Kinematics of a model at its initial position."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    return data
