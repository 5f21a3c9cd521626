"""How large forces and inertias are along the joints of a robot, so that ranges of coefficients
suit a finger as they suit a shoulder.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sims.base import Array
from sims.robot.floating import Floating
from sims.robot.model import Robot

POSES = 24
"""Poses that are looked at."""
FREE = 1.5
"""Radians or metres to either side of the first pose, of a joint without limits."""
ACCELERATION = 5.0
"""rad/s^2 or m/s^2 that a joint of its inertia is taken to reach."""
LEAST = 1e-4
"""N or N m; no joint is taken to carry less."""


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


def floating_forces(robot: Robot) -> Array:
    """(F,) of each move of what floats, what it takes to accelerate, in N or N m."""
    import mujoco

    model = robot.compiled
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    whole = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, whole)
    result: Array = ACCELERATION * np.diagonal(whole)[Floating.of(robot).velocities]
    return result
