"""Camera view of a robot, from the side that shows most of it.

With f forward, r right and u up (orthogonal unit vectors) and c the centre, a point p is projected
without perspective to

    ((p - c) . r, (p - c) . u)                                                     (1)

so that a metre has the same length everywhere in the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from sims.core.simulator import Array

if TYPE_CHECKING:
    from sims.robot.robot_model import RobotModel


CANDIDATE_AZIMUTHS_DEG = tuple(range(0, 360, 30))
"""Azimuths in degrees that are tried for a robot that moves in space."""
ELEVATION_DEG = -25.0
"""Elevation of the camera in degrees, slightly from above."""
PARALLEL_SINE_TOLERANCE = 0.02
"""Maximum sine of the angle between two axes that count as parallel."""
STATIC_CONTEXT_SHARE = 0.3
"""Maximum distance around the robot at which static shapes are shown, relative to its size."""
MARGIN_SHARE = 0.06
"""Empty margin at each side, as a fraction of the displayed size."""
MIN_VIEW_METRES = 0.02
"""Minimum width and height of a picture in metres."""
MIN_ASPECT_RATIO = 0.3
"""Minimum ratio of a picture's width to its height and vice versa, so that labels have space."""


@dataclass(frozen=True)
class Projection:
    """A parallel projection.

    Attributes:
        azimuth, elevation: Angles in degrees, by the convention of MuJoCo's free camera.
        centre: (3,) point in the middle of the picture, in metres.
        width, height: Displayed size in metres.
    """

    azimuth: float
    elevation: float
    centre: Array
    width: float
    height: float

    @property
    def axes(self) -> Array:
        """(3, 3) unit vectors in rows: right, up, forward."""
        return _compute_camera_axes(self.azimuth, self.elevation)

    def project(self, points: Array) -> Array:
        """Project points (N, 3) to (N, 2) metres to the right and up from the middle."""
        projected: Array = (np.asarray(points) - self.centre) @ self.axes[:2].T  # Equation (1).
        return projected


def _compute_camera_axes(azimuth: float, elevation: float) -> Array:
    """Return the unit vectors right, up and forward of a camera, in the rows of a (3, 3) array.

    Args:
        azimuth: angle in degrees, by the convention of MuJoCo's free camera.
        elevation: angle in degrees, by the same convention.
    """
    azimuth_angle, elevation_angle = np.deg2rad([azimuth, elevation])
    forward = np.array(
        [
            np.cos(elevation_angle) * np.cos(azimuth_angle),
            np.cos(elevation_angle) * np.sin(azimuth_angle),
            np.sin(elevation_angle),
        ]
    )
    up = np.array(
        [
            -np.sin(elevation_angle) * np.cos(azimuth_angle),
            -np.sin(elevation_angle) * np.sin(azimuth_angle),
            np.cos(elevation_angle),
        ]
    )
    return np.stack([np.cross(forward, up), up, forward])


def make_posed_data(robot: RobotModel, positions: dict[str, float]) -> Any:
    """Compute the robot's mujoco.MjData at a pose: positions of bodies and joints in the world.

    Joints with several coordinates keep the pose of the model file.

    Args:
        robot: Model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        positions: Positions by joint, rad or m; other joints keep the position of the model file.
    """
    import mujoco

    data = mujoco.MjData(robot.compiled)
    for joint in robot.joints:
        if joint.has_one_coordinate and joint.name in positions:
            data.qpos[joint.position] = positions[joint.name]
    mujoco.mj_forward(robot.compiled, data)
    for joint in robot.joints:
        # The slides of a floating body have no bearings: they are where the body is.
        if joint.name in robot.base_joints:
            data.xanchor[joint.id] = data.xpos[robot.compiled.jnt_bodyid[joint.id]]
    return data


def choose_projection(robot: RobotModel, data: Any) -> Projection:
    """Choose the camera view of a robot, and the width and height of its picture.

    The camera looks along the common axis of a planar robot, else from the direction in which its
    joints are furthest apart. The picture shows the bounding box, along the camera's axes, of all
    moving parts and of the static parts close to them.

    Args:
        robot: Model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        data: MuJoCo data at the pose.
    """
    azimuth, elevation = _choose_view_angles(robot, data)
    axes = _compute_camera_axes(azimuth, elevation)
    moving_points, static_points = compute_bounding_points(robot.compiled, data)
    world_points = np.concatenate(
        [
            data.xanchor,
            moving_points,
            _find_end_points(robot.compiled, data),
            _find_actuated_sites(robot.compiled, data),
        ]
    )
    # Corners of the bounding box in m, along the camera's axes right, up and forward.
    points = world_points @ axes.T
    low, high = points.min(axis=0), points.max(axis=0)
    if len(static_points):
        # A floor or a long rail would make the robot too small.
        margin = STATIC_CONTEXT_SHARE * float(np.linalg.norm(high - low))
        clipped = np.clip(static_points @ axes.T, low - margin, high + margin)
        low = np.minimum(low, clipped.min(axis=0))
        high = np.maximum(high, clipped.max(axis=0))
    width, height = np.maximum((high - low)[:2], MIN_VIEW_METRES) * (1 + 2 * MARGIN_SHARE)
    width, height = max(width, MIN_ASPECT_RATIO * height), max(height, MIN_ASPECT_RATIO * width)
    # The middle of the box, from the axes of the camera back to those of the world.
    world_centre = (low + high) / 2 @ axes
    return Projection(azimuth, elevation, world_centre, float(width), float(height))


def _find_end_points(model: Any, data: Any) -> Array:
    """Return the (N, 3) drawn ends of bodies that have a joint, but no shapes and no child bodies.

    Such a body is drawn as a line from its joint to its end: the joint mirrored at the centre of
    mass.

    Args:
        model: compiled model (`mujoco.MjModel`).
        data: its state at the pose (`mujoco.MjData`).
    """
    shapeless_bodies = set(range(1, model.nbody)) - {
        *model.geom_bodyid.tolist(),
        *model.body_parentid.tolist(),
    }
    jointed = [body for body in sorted(shapeless_bodies) if int(model.body_jntadr[body]) >= 0]
    tips: Array = 2 * data.xipos[jointed] - data.xanchor[model.body_jntadr[jointed]]
    return tips


def _find_actuated_sites(model: Any, data: Any) -> Array:
    """Return the positions (n, 3) of sites on which actuators act, such as rotors.

    Args:
        model: compiled model.
        data: its state at the pose.
    """
    import mujoco

    is_at_site = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_SITE)
    sites: Array = data.site_xpos[model.actuator_trnid[is_at_site, 0]]
    return sites


def _choose_view_angles(robot: RobotModel, data: Any) -> tuple[float, float]:
    """Choose azimuth and elevation of the camera, in degrees.

    A planar robot is viewed along its common axis, from the side on which x points to the right,
    as in a drawing. Another robot is viewed from slightly above, in the direction of
    `CANDIDATE_AZIMUTHS_DEG` from which its joints look widest.

    Args:
        robot: model of the robot.
        data: state at the pose (`mujoco.MjData`).
    """
    normal = _find_motion_plane_normal(robot, data)
    if normal is not None and abs(normal[2]) > 1 - PARALLEL_SINE_TOLERANCE:
        return 90.0, -90.0  # Azimuth and elevation in degrees: from above.
    if normal is not None:
        azimuth = float(np.rad2deg(np.arctan2(normal[1], normal[0]))) % 360
        elevation = float(np.rad2deg(np.arcsin(np.clip(normal[2], -1, 1))))
        right, _, _ = _compute_camera_axes(azimuth, elevation)
        # The small second component decides if the first one is zero.
        if right @ (1.0, 1e-3, 0.0) < 0:
            return (azimuth + 180) % 360, -elevation
        return azimuth, elevation
    moving, _ = compute_bounding_points(robot.compiled, data)
    points = np.concatenate([data.xanchor, moving.mean(axis=0, keepdims=True)])

    def spread(azimuth: float) -> float:
        """Return how widely the joints are spread in the picture from an azimuth, in m².

        It is the product of the singular values of their positions about the mean.
        """
        projected = points @ _compute_camera_axes(azimuth, ELEVATION_DEG)[:2].T
        sizes = np.linalg.svd(projected - projected.mean(axis=0), compute_uv=False)
        return float(np.prod(sizes))

    # Without rounding, numerical errors would decide for a robot that looks the same from two
    # sides.
    return max(CANDIDATE_AZIMUTHS_DEG, key=lambda azimuth: round(spread(azimuth), 9)), ELEVATION_DEG


def _find_motion_plane_normal(robot: RobotModel, data: Any) -> Array | None:
    """Return (3,) the normal of the plane in which a planar robot moves; None for others.

    A robot is planar if all its hinges have parallel axes, and all slides are perpendicular to
    them.

    Args:
        robot: model of the robot.
        data: state at the pose (`mujoco.MjData`).
    """
    if not all(joint.has_one_coordinate for joint in robot.joints):
        return None
    hinges = [data.xaxis[j.id] for j in robot.joints if j.kind == "hinge"]
    slides = [data.xaxis[j.id] for j in robot.joints if j.kind == "slide"]
    if not hinges:
        return None
    normal: Array = np.array(hinges[0])
    hinge_sines = [float(np.linalg.norm(np.cross(normal, axis))) for axis in hinges]
    slide_cosines = [abs(float(normal @ axis)) for axis in slides]
    return normal if max(hinge_sines + slide_cosines) < PARALLEL_SINE_TOLERANCE else None


def compute_bounding_points(model: Any, data: Any) -> tuple[Array, Array]:
    """Compute the corners of bounding boxes of moving and of static shapes, to frame the robot.

    Floors are left out, since they are endless. Centres of mass represent bodies without shapes.

    Args:
        model: mujoco.MjModel.
        data: MuJoCo data at the pose.

    Returns:
        (N, 3) corners of moving shapes and (M, 3) of static ones.
    """
    import mujoco

    floor_types = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
    # The eight corners of a cube with half-lengths of 1.
    corners = np.array(list(product((-1, 1), repeat=3)))
    # Points (n, 3) in the world, with the body they belong to.
    points_with_body: list[tuple[int, Array]] = []
    for geom in range(model.ngeom):
        if int(model.geom_type[geom]) not in floor_types:
            # The bounding box has its centre and its half-lengths in the frame of the shape.
            box = model.geom_aabb[geom, :3] + corners * model.geom_aabb[geom, 3:]
            rotation = data.geom_xmat[geom].reshape(3, 3)
            points = data.geom_xpos[geom] + box @ rotation.T
            points_with_body.append((int(model.geom_bodyid[geom]), points))
    shaped_bodies = {body for body, _ in points_with_body}
    for body in range(1, model.nbody):
        if body not in shaped_bodies:
            points_with_body.append((body, data.xipos[body][None]))
    # Without any points, the result must still have the shape (0, 3).
    no_points = np.empty((0, 3))
    moving = [points for body, points in points_with_body if not _is_static_body(model, body)]
    static = [points for body, points in points_with_body if _is_static_body(model, body)]
    return np.concatenate([no_points, *moving]), np.concatenate([no_points, *static])


def _is_static_body(model: Any, body: int) -> bool:
    return int(model.body_weldid[body]) == 0
