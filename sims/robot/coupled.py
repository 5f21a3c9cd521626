"""Drives that act on two joints: a fixed tendon in place of the joint.

With q the position of the drive's own joint, p that of the one before it, c the coefficient and
U(l, l') what the actuator exerts where its transmission stands at l,

    l = q + c p,   tau_q = U(l, l'),   tau_p = c U(l, l')                                      (1)

by virtual work, which is MuJoCo's fixed tendon with coefficients 1 and c (documentation,
"Computation", actuation model): so MuJoCo integrates it as it does any actuator, and a model file
can say it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from sims.robot.model import TENDON, Joint, Robot, kept_with_robot
from sims.robot.quiet import quiet

EFFECT = "joint.coupling"
ANY = ("", EFFECT)
"""What stands among what acts in series with joints (`sims.robot.series`) where drives are coupled,
whichever: one model has a tendon for each, whose c is zero where none is.
"""


def before(robot: Robot, name: str) -> Joint | None:
    """The joint before one, in its own body or in one that carries it; None where that is none of
    the same kind.
    """
    model, own = robot.compiled, robot.joint(name)
    body = int(model.jnt_bodyid[own.id])
    first, behind = int(model.body_jntadr[body]), own.id
    while body > 0:
        there = [robot.joints[i] for i in range(first, behind)]
        there = [joint for joint in there if joint.name not in robot.series]
        if there:
            return there[-1] if there[-1].kind == own.kind else None
        body = int(model.body_parentid[body])
        first = int(model.body_jntadr[body])
        behind = first + int(model.body_jntnum[body])
    return None


@kept_with_robot
def places(robot: Robot) -> tuple[str, ...]:
    """Joints whose drives may be coupled to the joint before."""
    driven = {actuator.joint for actuator in robot.actuators}
    return tuple(
        joint.name
        for joint in robot.joints
        if joint.single and joint.name in driven and before(robot, joint.name) is not None
    )


def named(spec: Any, robot: Robot) -> dict[int, Any]:
    """Name the joints and actuators of a spec that have no name, as the robot names them: by their
    numbers, which change where elements are added.

    Returns:
        The joints by their numbers.
    """
    if all(element.name for element in (*spec.joints, *spec.actuators)):
        return {robot.joint(joint.name).id: joint for joint in spec.joints}
    # Numbers are known once it has been compiled.
    with quiet():
        spec.compile()
    joints = {joint.id: joint for joint in spec.joints}
    for joint in robot.joints:
        joints[joint.id].name = joint.name
    for actuator in spec.actuators:
        actuator.name = robot.actuators[actuator.id].name
    return joints


def coupled(robot: Robot, coefficients: Mapping[str, float]) -> Robot:
    """The robot with tendons in place of joints; elements keep the names that the robot has for
    them.

    Args:
        robot: that was read.
        coefficients: c of (1) by joint, of `places`.
    """
    import mujoco

    spec = robot.spec.copy()
    named(spec, robot)
    for name, c in coefficients.items():
        first = before(robot, name)
        assert first is not None
        tendon = spec.add_tendon(name=name + TENDON)
        tendon.wrap_joint(name, 1.0)
        tendon.wrap_joint(first.name, c)
        for actuator in spec.actuators:
            if robot.actuators[actuator.id].joint == name:
                actuator.trntype = mujoco.mjtTrn.mjTRN_TENDON
                actuator.target = tendon.name
                if actuator.inheritrange > 0:
                    # The tendon has no range to inherit: the joint's is written down.
                    actuator.inheritrange = 0.0
                    actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
                    actuator.ctrlrange = robot.compiled.actuator_ctrlrange[actuator.id]
    return replace(robot, spec=spec, coupled=tuple(coefficients))
