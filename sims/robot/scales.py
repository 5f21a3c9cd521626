"""Typical forces and inertias of each joint, which set the ranges of effect coefficients."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sims.base import Array
from sims.robot.floating import Floating
from sims.robot.inertia_matrix import inertia_matrix
from sims.robot.model import Robot

POSES = 24
"""Number of random poses that are evaluated."""
FREE = 1.5
"""Half the position range assumed for a joint without limits, in rad or m."""
ACCELERATION = 5.0
"""Typical acceleration of a joint, in rad/s^2 or m/s^2."""
LEAST = 1e-4
"""Minimum typical force of a joint, in N or N m."""
NEIGHBOUR = 0.01
"""Minimum ratio of a joint's typical force and inertia to those of its parent joint.

It applies to the ranges of coefficients. A smaller value more likely means that the file omits an
inertia than that the link is light.
"""


class Scales(NamedTuple):
    """Typical forces and inertias of the D joints with one coordinate.

    Attributes:
        force: (D,) typical force in N or N m.
        inertia: (D,) mean inertia in kg or kg m^2.
    """

    force: Array
    inertia: Array


def scales(robot: Robot) -> Scales:
    """Compute typical forces and inertias over random poses within the joints' ranges.

    The force is the larger of the largest gravity force and the force for a typical acceleration.
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
    """Compute the forces and inertias of each joint (D,) that set the ranges of coefficients.

    The values are those of `scales`, but at least `NEIGHBOUR` times the values of the parent joint
    of the same kind. So a link whose inertia the file omits (1e-9 kg m^2) does not make the ranges
    of its joint vanish.
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
    """Compute the typical force of each degree of freedom of floating bodies, in N or N m.

    Args:
        robot: robot with floating bodies.

    Returns:
        (F,) forces for the acceleration `ACCELERATION`.
    """
    inertias = np.diagonal(inertia_matrix(robot.compiled))
    result: Array = ACCELERATION * inertias[Floating.of(robot).velocities]
    return result
