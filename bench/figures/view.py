"""Where the places of a robot are, and from where it is looked at: the plane that shows most of it.

With f forward, r right and u up (unit vectors, orthogonal) and c the centre, a point p is seen,
without perspective, at

    ((p - c) . r, (p - c) . u)                                                     (1)

so that a metre is as long everywhere in the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from sims.base import Array, InputError

if TYPE_CHECKING:
    from sims.robot.model import Robot

AZIMUTHS = tuple(range(0, 360, 30))
"""Degrees: the directions from which a robot in space is looked at in turn."""
ELEVATION = -25.0
"""Degrees: from a little above."""
PARALLEL = 0.02
"""Sine of the angle up to which two axes count as parallel."""
AROUND = 0.3
"""What does not move is shown up to this share of the robot's size around it."""
MARGIN = 0.06
"""Empty ground to each side, as a share of what is shown."""
LEAST = 0.02
"""Metres that a picture shows at least."""
SLIMMEST = 0.3
"""A picture is at least this share of its other side wide or high: labels need room."""


@dataclass(frozen=True)
class View:
    """A parallel projection.

    Attributes:
        azimuth, elevation: degrees, as MuJoCo's free camera counts them.
        centre: (3,) metres, what is in the middle.
        width, height: metres that are shown.
    """

    azimuth: float
    elevation: float
    centre: Array
    width: float
    height: float

    @property
    def axes(self) -> Array:
        """(3, 3) rows: right, up, forward."""
        return _axes(self.azimuth, self.elevation)

    def seen(self, points: Array) -> Array:
        """(N, 2) metres from the middle to the right and up, of points (N, 3)."""
        seen: Array = (np.asarray(points) - self.centre) @ self.axes[:2].T  # (1)
        return seen


def _axes(azimuth: float, elevation: float) -> Array:
    a, e = np.deg2rad([azimuth, elevation])
    forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    up = np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)])
    return np.stack([np.cross(forward, up), up, forward])


def posed(robot: Robot, positions: dict[str, float]) -> Any:
    """The robot's mujoco.MjData at positions by joint (rad or m), as the file has it where none is
    given.
    """
    import mujoco

    data = mujoco.MjData(robot.compiled)
    for joint in robot.joints:
        if joint.single and joint.name in positions:
            data.qpos[joint.position] = positions[joint.name]
    mujoco.mj_forward(robot.compiled, data)
    return data


def view(robot: Robot, data: Any) -> View:
    """Where to look from: along the common axis of a planar robot, else from where its joints lie
    furthest apart.
    """
    azimuth, elevation = _direction(robot, data)
    axes = _axes(azimuth, elevation)
    moving, still = outlines(robot.compiled, data)
    points = np.concatenate([data.xanchor, moving, _tips(robot.compiled, data)]) @ axes.T
    low, high = points.min(axis=0), points.max(axis=0)
    if len(still):
        # A floor or a long rail would make the robot small.
        around = AROUND * float(np.linalg.norm(high - low))
        clipped = np.clip(still @ axes.T, low - around, high + around)
        low = np.minimum(low, clipped.min(axis=0))
        high = np.maximum(high, clipped.max(axis=0))
    width, height = np.maximum((high - low)[:2], LEAST) * (1 + 2 * MARGIN)
    width, height = max(width, SLIMMEST * height), max(height, SLIMMEST * width)
    return View(azimuth, elevation, (low + high) / 2 @ axes, float(width), float(height))


def _tips(model: Any, data: Any) -> Array:
    """(N, 3) how far bodies without shapes are drawn that carry no other: as far behind their
    centre of mass as that is from their joint.
    """
    bare = set(range(1, model.nbody)) - {*model.geom_bodyid.tolist(), *model.body_parentid.tolist()}
    jointed = [body for body in sorted(bare) if int(model.body_jntadr[body]) >= 0]
    tips: Array = 2 * data.xipos[jointed] - data.xanchor[model.body_jntadr[jointed]]
    return tips


def _direction(robot: Robot, data: Any) -> tuple[float, float]:
    """Azimuth and elevation in degrees."""
    normal = _normal(robot, data)
    if normal is not None and abs(normal[2]) > 1 - PARALLEL:
        return 90.0, -90.0
    if normal is not None:
        azimuth = float(np.rad2deg(np.arctan2(normal[1], normal[0]))) % 360
        elevation = float(np.rad2deg(np.arcsin(np.clip(normal[2], -1, 1))))
        # Of the two sides the one on which x runs to the right, as in a drawing.
        right = _axes(azimuth, elevation)[0]
        flipped = right @ (1.0, 1e-3, 0.0) < 0
        return ((azimuth + 180) % 360, -elevation) if flipped else (azimuth, elevation)
    moving, _ = outlines(robot.compiled, data)
    points = np.concatenate([data.xanchor, moving.mean(axis=0, keepdims=True)])

    def spread(azimuth: float) -> float:
        seen = points @ _axes(azimuth, ELEVATION)[:2].T
        sizes = np.linalg.svd(seen - seen.mean(axis=0), compute_uv=False)
        return float(np.prod(sizes))

    # Rounded, or a robot that looks the same from two sides would be turned by rounding.
    return max(AZIMUTHS, key=lambda azimuth: round(spread(azimuth), 9)), ELEVATION


def _normal(robot: Robot, data: Any) -> Array | None:
    """(3,) the normal of the plane in which a planar robot moves; None for any other."""
    if not all(joint.single for joint in robot.joints):
        return None
    hinges = [data.xaxis[j.id] for j in robot.joints if j.kind == "hinge"]
    slides = [data.xaxis[j.id] for j in robot.joints if j.kind == "slide"]
    if not hinges:
        return None
    normal: Array = np.array(hinges[0])
    turned = [float(np.linalg.norm(np.cross(normal, axis))) for axis in hinges]
    pushed = [abs(float(normal @ axis)) for axis in slides]
    return normal if max(turned + pushed) < PARALLEL else None


def outlines(model: Any, data: Any) -> tuple[Array, Array]:
    """Corners (N, 3) and (M, 3) of boxes about the shapes of what moves and of what does not;
    centres of mass stand for bodies without shapes.
    """
    import mujoco

    endless = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
    corners = np.array(list(product((-1, 1), repeat=3)))
    parts: tuple[list[Array], list[Array]] = ([data.xipos[:0]], [data.xipos[:0]])
    shaped = set()
    for g in range(model.ngeom):
        if int(model.geom_type[g]) in endless:
            continue
        body = int(model.geom_bodyid[g])
        shaped.add(body)
        box = model.geom_aabb[g, :3] + corners * model.geom_aabb[g, 3:]
        turn = data.geom_xmat[g].reshape(3, 3)
        parts[_still(model, body)].append(data.geom_xpos[g] + box @ turn.T)
    for body in range(1, model.nbody):
        if body not in shaped:
            parts[_still(model, body)].append(data.xipos[body][None])
    moving, still = (np.concatenate(part) for part in parts)
    return moving, still


def _still(model: Any, body: int) -> bool:
    return int(model.body_weldid[body]) == 0


def place_of(robot: Robot, data: Any, kind: str, name: str) -> Array | None:
    """(3,) metres, where a place of the robot is; None where the robot has no such place."""
    try:
        if kind == "body":
            return np.array(data.xipos[robot.body(name).id])
        if kind == "actuator":
            joint = robot.actuator(name).joint
            return None if joint is None else np.array(data.xanchor[robot.joint(joint).id])
        if kind == "channel":
            return _place_of_channel(robot, data, name)
        return np.array(data.xanchor[robot.joint(name).id])
    except InputError:
        return None


def _place_of_channel(robot: Robot, data: Any, name: str) -> Array | None:
    """Of a joint's channel the joint, of a sensor what it is fixed to."""
    import mujoco

    kind, _, rest = name.partition(".")
    if kind != "s":
        return place_of(robot, data, "joint", rest)
    model = robot.compiled
    row = next((s for s in robot.sensors if s.name == rest), None)
    if row is None:
        return None
    sensor = int(np.searchsorted(model.sensor_adr, row.address, side="right")) - 1
    on, of = int(model.sensor_objid[sensor]), int(model.sensor_objtype[sensor])
    places = {
        int(mujoco.mjtObj.mjOBJ_SITE): data.site_xpos,
        int(mujoco.mjtObj.mjOBJ_JOINT): data.xanchor,
        int(mujoco.mjtObj.mjOBJ_BODY): data.xipos,
        int(mujoco.mjtObj.mjOBJ_XBODY): data.xpos,
    }
    return np.array(places[of][on]) if of in places else None
