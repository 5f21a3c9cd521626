"""Poses in which the loops of a robot are closed: unmeasured joints follow from the measured ones.

Equality constraints of MuJoCo (connect, weld, joint and tendon) have residuals r(q) and Jacobian
J = dr/dq. With the measured joints m fixed, the unmeasured joints u satisfy r(q) = 0, found by
Gauss-Newton steps, and their velocities follow from it,

    q_u <- q_u - J_u^+ r(q),        v_u = -J_u^+ J_m v_m                                       (1)

(E. J. Haug, Computer Aided Kinematics and Dynamics of Mechanical Systems, 1989, sections 4.2, 3.6).
The measured joints are moved from the reference pose in small steps, so that a loop that can be
closed in two ways is closed as the model file has it.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from sims.core.simulator import Array
from sims.robot.robot_model import RobotModel

MAX_STEPS = 20
"""Maximum number of Gauss-Newton steps at a pose of the measured joints."""
MAX_MOTION = 0.2
"""Largest change of a measured joint from one pose to the next, in rad or m."""
POSITION_TOLERANCE = 1e-10
"""Residual of the constraints, in m or rad, at which the loops are closed."""


def close_loops(
    robot: RobotModel, states: Mapping[str, float], unmeasured: Collection[str]
) -> dict[str, float]:
    """Place unmeasured joints of closed loops where the constraints put them, by eq. (1).

    Unmeasured joints u satisfy the constraints r(q) = 0 by steps q_u <- q_u - J_u^+ r(q); their
    velocities are v_u = -J_u^+ J_m v_m, with the measured joints m and J = dr/dq (1).

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        states: positions ``q.JOINT`` and velocities ``qd.JOINT`` of its joints.
        unmeasured: names of the joints to place; the others stay.

    Returns:
        The states with the positions and velocities of the unmeasured joints; if the constraints
        cannot be satisfied, the given states.
    """
    import mujoco

    joints = [joint for joint in robot.joints if f"q.{joint.name}" in states]
    if not unmeasured or not robot.compiled.neq:
        return dict(states)
    model = copy.copy(robot.compiled)
    # The Jacobian of the constraints is then a plain matrix.
    model.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    data = mujoco.MjData(model)
    for joint in joints:
        data.qvel[joint.velocity] = states[f"qd.{joint.name}"]
    placed = [joint for joint in joints if joint.name in unmeasured]
    positions = [joint.position for joint in placed]
    velocities = np.array([joint.velocity for joint in placed])
    fixed = [joint for joint in joints if joint.name not in unmeasured]
    reference = model.qpos0[[joint.position for joint in fixed]]
    change = np.array([states[f"q.{joint.name}"] for joint in fixed]) - reference
    count = 1 + int(np.abs(change).max(initial=0.0) / MAX_MOTION)
    jacobian: Array | None = None
    for share in np.arange(1, count + 1) / count:
        data.qpos[[joint.position for joint in fixed]] = reference + share * change
        jacobian = _solve_constraints(model, data, positions, velocities)
        if jacobian is None:
            return dict(states)
    assert jacobian is not None
    fixed_rates = data.qvel.copy()
    fixed_rates[velocities] = 0.0
    rates = -np.linalg.pinv(jacobian[:, velocities]) @ (jacobian @ fixed_rates)
    closed = dict(states)
    for joint, rate in zip(placed, rates.tolist(), strict=True):
        closed[f"q.{joint.name}"] = float(data.qpos[joint.position])
        closed[f"qd.{joint.name}"] = rate
    return closed


def _solve_constraints(
    model: Any, data: Any, positions: Sequence[int], velocities: Array
) -> Array | None:
    """Move the unmeasured joints until the equality constraints are satisfied, by eq. (1).

    Each Gauss-Newton step is q_u <- q_u - J_u^+ r(q) (1).

    Args:
        model: compiled model, whose constraints have a dense Jacobian.
        data: its state, which is changed.
        positions: addresses of the unmeasured joints in qpos.
        velocities: their addresses in qvel, integers.

    Returns:
        Jacobian (constraints, nv) of the constraints; None if they cannot be satisfied.
    """
    import mujoco

    for _ in range(MAX_STEPS):
        mujoco.mj_fwdPosition(model, data)
        jacobian: Array = data.efc_J.reshape(-1, model.nv)[: data.ne].copy()
        step = -np.linalg.pinv(jacobian[:, velocities]) @ data.efc_pos[: data.ne]
        if float(np.abs(step).max(initial=0.0)) < POSITION_TOLERANCE:
            return jacobian
        data.qpos[positions] += step
    return None
