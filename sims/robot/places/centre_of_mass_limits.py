"""Limits of the centres of mass of links, by their sizes."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np

from sims.core.simulator import Array
from sims.robot.places.observable_axes import make_reference_data
from sims.robot.robot_model import RobotModel

MIN_THICKNESS_SHARE = 0.25
"""Minimum half width of a link's box, as a share of its longest side.

Motors and cables protrude from a thin rod.
"""
MARGIN_SHARE = 0.1
"""Margin of a link's box on each face, as a share of its longest side."""
CUBE_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
"""Corners (8, 3) of a cube with sides of 2."""
UNKNOWN_LENGTH = 0.1
"""Assumed longest side, in metres, of a link in a robot whose file specifies no lengths."""


def compute_centre_of_mass_limits(robot: RobotModel, body: str) -> Array:
    """Return the limits of the offset of a body's centre of mass, as the link's size allows it.

    A fitted offset outside them would put the centre of mass outside the link. The limits are a box
    with a margin around points of the link:

    * the geoms and sites of the link, and the joints of its child links,
    * without geoms also the corners of the box that has its mass and inertia.

    If all points coincide, the link is assumed to be as long as its distance from its parent.

    Args:
        robot: robot with the body.
        body: name of the body.

    Returns:
        (3, 2) lowest and highest offset from the specified centre of mass, in metres, along the
        axes of the body's frame.
    """
    model, data = robot.compiled, make_reference_data(robot.compiled)
    body_id = robot.body(body).id
    # Corners of the box around the points, in the body's frame.
    points = np.array(list(_iterate_link_points(model, data, body_id)))
    low, high = points.min(axis=0), points.max(axis=0)
    longest_side = float((high - low).max()) or _estimate_link_length(model, body_id)
    # A thin rod gets a thickness, and each face a margin.
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
    the box that has its mass and inertia. Bodies that are rigidly attached to it belong to the
    link.

    Args:
        model: compiled model.
        data: MuJoCo data at the reference pose.
        body_id: index of the body.
    """
    import mujoco

    # Points of the data are in the world: `axes.T @ (point - origin)` is a point in the link.
    origin, axes = data.xpos[body_id], data.xmat[body_id].reshape(3, 3)
    yield np.zeros(3)
    yield model.body_ipos[body_id]
    # Planes and height fields are surroundings, whose size is not that of the link.
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
        # Child bodies on joints. The world, body 0, is its own parent.
        for child in np.flatnonzero(model.body_parentid == body):
            if child and model.body_jntnum[child]:
                yield axes.T @ (data.xpos[child] - origin)


def _compute_box_of_inertia(model: Any, number: int) -> Array:
    """Return half the sides (3,), in metres, of the uniform box with a body's mass and inertia.

    A box with sides 2 a, 2 b, 2 c and mass m has the moment of inertia I_a = m (b² + c²) / 3 about
    the side a, so that a² = 1.5 (I_b + I_c - I_a) / m. A negative square counts as zero; without a
    mass, all sides are zero.

    Args:
        model: compiled model.
        number: number of the body.
    """
    mass, moments = float(model.body_mass[number]), model.body_inertia[number]
    if mass <= 0.0:
        return np.zeros(3)
    squared_half_sides: Array = 1.5 * (moments.sum() - 2.0 * moments) / mass
    return np.sqrt(np.maximum(squared_half_sides, 0.0))


def _list_fixed_bodies(model: Any, number: int) -> list[int]:
    """Return the numbers of a body and of all bodies that are rigidly attached below it.

    Args:
        model: compiled model.
        number: number of the body.
    """
    bodies = [number]
    # Children have larger numbers than their parents.
    for child in range(number + 1, model.nbody):
        if model.body_parentid[child] in bodies and not model.body_jntnum[child]:
            bodies.append(child)
    return bodies


def _estimate_link_length(model: Any, number: int) -> float:
    """Return the assumed length, in metres, of a link without a specified shape.

    It is the distance of the link from its parent; if that is zero, the longest such distance in
    the robot; if that is zero, too, `UNKNOWN_LENGTH`.

    Args:
        model: compiled model.
        number: number of the body.
    """
    distances = np.linalg.norm(model.body_pos[1:], axis=1)
    return float(distances[number - 1]) or float(distances.max(initial=0.0)) or UNKNOWN_LENGTH
