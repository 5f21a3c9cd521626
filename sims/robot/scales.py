"""How large forces and inertias are along the joints of a robot, so that ranges of coefficients
suit a finger as they suit a shoulder.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sims.base import Array
from sims.robot.floating import Floating
from sims.robot.inertia_matrix import inertia_matrix
from sims.robot.model import Robot

POSES = 24
"""Poses that are looked at."""
FREE = 1.5
"""Radians or metres to either side of the first pose, of a joint without limits."""
ACCELERATION = 5.0
"""rad/s^2 or m/s^2 that a joint of its inertia is taken to reach."""
LEAST = 1e-4
"""N or N m; no joint is taken to carry less."""
NEIGHBOUR = 0.01
"""Ranges of coefficients suit a joint of at least this share of the force and inertia of the joint
that carries it: a smaller value is more likely a missing inertia of the file than a light link.
"""


class Scales(NamedTuple):
    """Of each joint (D,): a typical force in N or N m, and the mean inertia in kg or kg m^2."""

    force: Array
    inertia: Array


def scales(robot: Robot) -> Scales:
    """Over poses all through the joints' ranges: what gravity pulls with, and what it takes to
    accelerate.
    """
    import mujoco

    model = robot.compiled
    data = mujoco.MjData(model)
    joints = [joint for joint in robot.joints if joint.single]
    places = [joint.velocity for joint in joints]
    rng = np.random.default_rng(7)
    weights, inertias = [], []
    whole = np.zeros((model.nv, model.nv))
    for _ in range(POSES):
        data.qpos[:] = model.qpos0
        data.qvel[:] = 0.0
        for joint in joints:
            start = float(model.qpos0[joint.position])
            low, high = joint.range or (start - FREE, start + FREE)
            data.qpos[joint.position] = rng.uniform(low, high)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, whole)
        weights.append(np.abs(data.qfrc_bias[places]))
        inertias.append(np.diagonal(whole)[places])
    inertia = np.mean(inertias, axis=0)
    force = np.maximum(np.max(weights, axis=0), ACCELERATION * inertia)
    return Scales(np.maximum(force, LEAST), np.maximum(inertia, 1e-9))


def coefficient_scales(robot: Robot) -> Scales:
    """Return force and inertia of each joint (D,) that the ranges of coefficients follow.

    They are those of `scales`, where a joint counts for at least `NEIGHBOUR` times the joint of the
    same kind that carries it, so that a link whose inertia the file leaves out (1e-9 kg m^2) does
    not make the ranges of its joint vanish.
    """
    own = scales(robot)
    force, inertia = own.force.copy(), own.inertia.copy()
    model = robot.compiled
    joints = [joint for joint in robot.joints if joint.single]
    last: dict[tuple[int, str], int] = {}
    # Bodies are numbered from the base outwards, so a parent joint has its final value already.
    for number, joint in enumerate(joints):
        body = int(model.jnt_bodyid[joint.id])
        parent = last.get((body, joint.kind))
        while parent is None and body:
            body = int(model.body_parentid[body])
            parent = last.get((body, joint.kind))
        if parent is not None:
            force[number] = max(force[number], NEIGHBOUR * force[parent])
            inertia[number] = max(inertia[number], NEIGHBOUR * inertia[parent])
        last[int(model.jnt_bodyid[joint.id]), joint.kind] = number
    return Scales(force, inertia)


def floating_forces(robot: Robot) -> Array:
    """(F,) of each move of what floats, what it takes to accelerate, in N or N m."""
    inertias = np.diagonal(inertia_matrix(robot.compiled))
    result: Array = ACCELERATION * inertias[Floating.of(robot).velocities]
    return result
