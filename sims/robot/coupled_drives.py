"""Drives that act on two joints, modelled by a fixed tendon in place of the joint transmission.

Let q be the position of the drive's own joint, p that of the preceding joint, c the coefficient,
and U(l, l') the actuator force at the transmission length l:

    l = q + c p,   tau_q = U(l, l'),   tau_p = c U(l, l')                                      (1)

by virtual work. This is MuJoCo's fixed tendon with coefficients 1 and c (documentation,
"Computation", actuation model). So MuJoCo integrates it like any actuator, and a model file can
state it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from sims.robot.robot_model import COUPLING_TENDON_SUFFIX, Joint, RobotModel, cache_per_robot

COUPLING_EFFECT = "joint.coupling"
COUPLING_PLACEHOLDER = ("", COUPLING_EFFECT)
"""Entry for all coupled drives in the list of added elements (`dynamics.series_joints`).

One model has a tendon for each drive that can be coupled; c is zero where none is.
"""

COUPLING_FIELD = "wrap_prm"
"""Model field of coupling coefficients, which a model without tendons lacks."""


def find_preceding_joint(robot: RobotModel, name: str) -> Joint | None:
    """Find the preceding joint, in the joint's own body or in the nearest ancestor with joints.

    Joints that effects have added in series with others (`RobotModel.series`) do not count.

    Args:
        robot: robot whose joints are meant.
        name: joint.

    Returns:
        The nearest joint towards the base; None if there is none, or if one is a hinge and the
        other a slide.
    """
    model, second_joint = robot.compiled, robot.joint(name)
    # First the joints of the same body before this one, then all joints of each ancestor.
    body = int(model.jnt_bodyid[second_joint.id])
    first_joint_id, end_joint_id = int(model.body_jntadr[body]), second_joint.id
    while body > 0:
        preceding_joints = [robot.joints[i] for i in range(first_joint_id, end_joint_id)]
        preceding_joints = [joint for joint in preceding_joints if joint.name not in robot.series]
        if preceding_joints:
            return preceding_joints[-1] if preceding_joints[-1].kind == second_joint.kind else None
        body = int(model.body_parentid[body])
        first_joint_id = int(model.body_jntadr[body])
        end_joint_id = first_joint_id + int(model.body_jntnum[body])
    return None


@cache_per_robot
def list_coupling_places(robot: RobotModel) -> tuple[str, ...]:
    """List the joints whose drives can be coupled to the preceding joint.

    Such a joint is a hinge or slide with an actuator. The preceding joint is the next one towards
    the base; it must be of the same kind.

    Args:
        robot: robot as read from its model file.

    Returns:
        Names of the joints, in the order of the robot's joints.
    """
    driven_joints = {actuator.joint for actuator in robot.actuators}
    return tuple(
        joint.name
        for joint in robot.joints
        if joint.has_one_coordinate
        and joint.name in driven_joints
        and find_preceding_joint(robot, joint.name) is not None
    )


def make_coupled_robot(robot: RobotModel, coefficients: Mapping[str, float]) -> RobotModel:
    """Make a robot whose coupled drives act on tendons in place of joints; names do not change.

    A tendon has the length l = q + c p, with the position q of the drive's joint and p of the
    preceding one. So the actuator force U acts on both joints, as U and c U (1).

    Args:
        robot: robot as read from its model file.
        coefficients: c by joint; the joints are among `list_coupling_places`.
    """
    import mujoco

    spec = robot.spec.copy()
    for name, c in coefficients.items():
        preceding_joint = find_preceding_joint(robot, name)
        assert preceding_joint is not None
        tendon = spec.add_tendon(name=name + COUPLING_TENDON_SUFFIX)
        tendon.wrap_joint(name, 1.0)
        tendon.wrap_joint(preceding_joint.name, c)
        # The actuators of the joint get the tendon as their target.
        for actuator in spec.actuators:
            if robot.actuators[actuator.id].joint == name:
                actuator.trntype = mujoco.mjtTrn.mjTRN_TENDON
                actuator.target = tendon.name
                if actuator.inheritrange > 0:
                    # A tendon has no range to inherit, so the control range of the joint is written
                    # instead.
                    actuator.inheritrange = 0.0
                    actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
                    actuator.ctrlrange = robot.compiled.actuator_ctrlrange[actuator.id]
    return replace(robot, spec=spec, coupled=tuple(coefficients))


def get_coupling_address(robot: RobotModel, place: str) -> int:
    """Return the address in `wrap_prm` of the coupling coefficient of a joint's drive.

    Args:
        robot: robot with coupled drives.
        place: joint of the drive.
    """
    model = robot.compiled
    tendon = model.tendon(place + COUPLING_TENDON_SUFFIX).id
    # The tendon lists the drive's own joint with the coefficient 1, then the preceding joint.
    return int(model.tendon_adr[tendon]) + 1
