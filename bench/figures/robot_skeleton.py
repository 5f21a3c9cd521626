"""Draw a robot as links and joints, for machines that cannot render it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from bench.figures.robot_view import Projection
from bench.figures.style import CAPTION_GREY, NEUTRAL_MARK, NULL_LEVEL_GREY
from sims.core.simulator import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from sims.robot.robot_model import Joint, RobotModel

JOINT_AXIS_LENGTH_SHARE = 0.07
"""Length of a joint's axis to either side, as a fraction of the picture's size."""
MIN_VISIBLE_AXIS_SHARE = 0.25
"""Minimum length of the projected joint axis of length 1; a shorter axis points at the viewer."""


def draw_skeleton(axis: Axes, robot: RobotModel, data: Any, view: Projection) -> None:
    """Draw links as lines between joint anchors, and joints as dots with a tick along each axis.

    Args:
        axis: Axes to draw on.
        robot: The robot.
        data: MuJoCo data at the pose.
        view: Camera view.
    """
    for start, end in compute_link_segments(robot, data):
        line = view.project(np.stack([start, end]))
        axis.plot(
            *line.T,
            color=NULL_LEVEL_GREY,
            linewidth=5,
            solid_capstyle="round",
            zorder=1,
            clip_on=False,
        )
    for point in _find_base_points(robot, data):
        x, y = view.project(point[None])[0]
        axis.plot(x, y, "s", color=CAPTION_GREY, markersize=11, zorder=2)
    for joint in robot.joints:
        _draw_joint(axis, joint, data, view)


def compute_link_segments(robot: RobotModel, data: Any) -> list[tuple[Array, Array]]:
    """Compute the end points (3,) of each link.

    A link extends from the joint of the parent body to the body's own joint, or from the last joint
    to the end of the last body.

    Args:
        robot: The robot.
        data: MuJoCo data at the pose.
    """
    model = robot.compiled
    segments = []
    parents = set()
    for body in range(1, model.nbody):
        if not int(model.body_weldid[body]):
            continue
        parent = int(model.body_parentid[body])
        parents.add(parent)
        if parent:
            segments.append(
                (_find_link_start(model, data, parent), _find_link_start(model, data, body))
            )
    for body in range(1, model.nbody):
        if int(model.body_weldid[body]) and body not in parents:
            start = _find_link_start(model, data, body)
            segments.append((start, _find_link_end(model, data, body, start)))
    return segments


def _find_link_start(model: Any, data: Any, body: int) -> Array:
    """Return (3,) the anchor of a body's first joint, or the body's origin without a joint."""
    first = int(model.body_jntadr[body])
    return np.array(data.xanchor[first] if first >= 0 else data.xpos[body])


def _find_link_end(model: Any, data: Any, body: int, start: Array) -> Array:
    """Return (3,) the end of a body without child bodies.

    It is the point of its shapes that is furthest from the joint; without shapes, the joint
    mirrored at the centre of mass.
    """
    points = [2 * data.xipos[body] - start]
    for g in range(model.ngeom):
        if int(model.geom_bodyid[g]) != body:
            continue
        turn = data.geom_xmat[g].reshape(3, 3)
        middle = data.geom_xpos[g] + turn @ model.geom_aabb[g, :3]
        half_extents = turn * model.geom_aabb[g, 3:]
        points += [*(middle + half_extents.T), *(middle - half_extents.T)]
    shapes = points[1:] or points
    return np.array(max(shapes, key=lambda p: round(float(np.linalg.norm(p - start)), 9)))


def _find_base_points(robot: RobotModel, data: Any) -> list[Array]:
    """Return the (3,) points where moving bodies are fixed to static ones, without free bodies."""
    model = robot.compiled
    free_bodies = {
        int(model.jnt_bodyid[joint.id]) for joint in robot.joints if joint.kind == "free"
    }
    points = []
    for body in range(1, model.nbody):
        parent = int(model.body_parentid[body])
        has_fixed_parent = not int(model.body_weldid[parent])
        if int(model.body_weldid[body]) and has_fixed_parent and body not in free_bodies:
            points.append(
                np.array(data.xpos[parent]) if parent else _find_link_start(model, data, body)
            )
    return points


def _draw_joint(axis: Axes, joint: Joint, data: Any, view: Projection) -> None:
    """Draw a joint as a circle, or as a square if it is prismatic, with its axis as a dashed line.

    `data` is the mujoco.MjData of the pose: `xanchor` and `xaxis` have the position (m) and the
    axis of each joint in the world.
    """
    anchor = data.xanchor[joint.id]
    x, y = view.project(anchor[None])[0]
    if joint.has_one_coordinate:
        projected_axis = view.axes[:2] @ data.xaxis[joint.id]
        # An axis that points at the viewer has no direction to draw.
        if float(np.linalg.norm(projected_axis)) > MIN_VISIBLE_AXIS_SHARE:
            reach = JOINT_AXIS_LENGTH_SHARE * max(view.width, view.height) * projected_axis
            middle = np.array([x, y])
            end_points = np.stack([middle - reach, middle + reach])
            axis.plot(
                *end_points.T, color=NEUTRAL_MARK, linewidth=1.3, linestyle=(0, (3, 1.2)), zorder=3
            )
    shape = "s" if joint.kind == "slide" else "o"
    axis.plot(
        x,
        y,
        shape,
        color=NEUTRAL_MARK,
        markerfacecolor="white",
        markersize=7,
        markeredgewidth=1.4,
        zorder=4,
    )
