"""Typical forces and inertias of joints, and typical forces of floating bodies.

They set the sizes of finite differences and the plausible ranges of coefficients.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sims.core.simulator import Array
from sims.robot.dynamics.inverse_dynamics import inertia_matrix
from sims.robot.floating_joints import FloatingJoints
from sims.robot.robot_model import RobotModel, cache_per_robot

POSE_COUNT = 24
"""Number of random poses that are evaluated."""


DEFAULT_JOINT_RANGE = 1.5
"""Half the position range assumed for a joint without limits, in rad or m."""


TYPICAL_ACCELERATION = 5.0
"""Typical acceleration of a joint, in rad/s^2 or m/s^2."""


MIN_FORCE = 1e-4
"""Minimum typical force of a joint, in N or N m."""
MIN_INERTIA = 1e-9
"""Minimum typical inertia of a joint, in kg or kg m^2."""


MIN_PARENT_SHARE = 0.01
"""Minimum ratio of a joint's typical force and inertia to those of its parent joint.

It applies to the ranges of coefficients. A smaller value more likely means that the file omits an
inertia than that the link is light.
"""


class JointScales(NamedTuple):
    """Typical forces and inertias of the D joints with one coordinate.

    Attributes:
        force: (D,) typical force in N or N m.
        inertia: (D,) mean inertia in kg or kg m^2.
    """

    force: Array
    inertia: Array


@cache_per_robot
def compute_joint_scales(robot: RobotModel) -> JointScales:
    """Compute typical forces and inertias of the joints, from random poses within their ranges.

    They set the sizes of finite differences and of coefficients. The force is the larger of the
    largest gravity force, and the force for a typical acceleration with the mean inertia. The poses
    are the same in each call, by a fixed seed.

    Returns:
        Forces in N or N m, and inertias in kg or kg m^2, of the D joints with one coordinate, in
        the order of the robot's joints; none is below `MIN_FORCE` or `MIN_INERTIA`.
    """
    import mujoco

    model = robot.compiled
    data = mujoco.MjData(model)
    joints = [joint for joint in robot.joints if joint.has_one_coordinate]
    dofs = [joint.velocity for joint in joints]
    rng = np.random.default_rng(7)
    gravity_forces, inertias = [], []
    mass_matrix = np.zeros((model.nv, model.nv))
    for _ in range(POSE_COUNT):
        data.qpos[:] = model.qpos0
        data.qvel[:] = 0.0
        for joint in joints:
            start = float(model.qpos0[joint.position])
            low, high = joint.range or (start - DEFAULT_JOINT_RANGE, start + DEFAULT_JOINT_RANGE)
            data.qpos[joint.position] = rng.uniform(low, high)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass_matrix)
        # The joints rest, so bias forces are those of gravity.
        gravity_forces.append(np.abs(data.qfrc_bias[dofs]))
        inertias.append(np.diagonal(mass_matrix)[dofs])
    inertia = np.mean(inertias, axis=0)
    force = np.maximum(np.max(gravity_forces, axis=0), TYPICAL_ACCELERATION * inertia)
    return JointScales(np.maximum(force, MIN_FORCE), np.maximum(inertia, MIN_INERTIA))


def coefficient_scales(robot: RobotModel) -> JointScales:
    """Compute the forces and inertias (D,) of D joints that set the ranges of coefficients.

    The values are those of `compute_joint_scales`, but at least `MIN_PARENT_SHARE` times those of
    the parent joint of the same kind: for a hinge, the next hinge towards the base, for a slide the
    next slide. So a link whose inertia the file omits (1e-9 kg m^2) does not make the ranges of its
    joint vanish.
    """
    joint_scales = compute_joint_scales(robot)
    force, inertia = joint_scales.force.copy(), joint_scales.inertia.copy()
    model = robot.compiled
    joints = [joint for joint in robot.joints if joint.has_one_coordinate]
    # Index of the last joint so far by body and kind.
    last_joint_of_body: dict[tuple[int, str], int] = {}
    # Bodies are numbered from the base outwards, so a parent joint has its final value already.
    for joint_index, joint in enumerate(joints):
        body = int(model.jnt_bodyid[joint.id])
        parent = last_joint_of_body.get((body, joint.kind))
        while parent is None and body:
            body = int(model.body_parentid[body])
            parent = last_joint_of_body.get((body, joint.kind))
        if parent is not None:
            force[joint_index] = max(force[joint_index], MIN_PARENT_SHARE * force[parent])
            inertia[joint_index] = max(inertia[joint_index], MIN_PARENT_SHARE * inertia[parent])
        last_joint_of_body[int(model.jnt_bodyid[joint.id]), joint.kind] = joint_index
    return JointScales(force, inertia)


def compute_floating_forces(robot: RobotModel) -> Array:
    """Compute the typical force of each degree of freedom of floating bodies, in N or N m.

    Returns:
        (F,) forces of F degrees of freedom for the acceleration `TYPICAL_ACCELERATION`.
    """
    inertias = np.diagonal(inertia_matrix(robot.compiled))
    result: Array = TYPICAL_ACCELERATION * inertias[FloatingJoints.from_robot(robot).velocities]
    return result
