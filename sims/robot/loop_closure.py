"""Closed loops of a robot: the joints that they couple, and poses in which they are closed.

In such a pose, unmeasured joints follow from the measured ones.

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
    """Place unmeasured joints of closed loops where the constraints put them.

    The constraints of the loops are r(q) = 0, with J = dr/dq and its pseudo-inverse J^+. Positions
    of unmeasured joints u satisfy them by steps q_u <- q_u - J_u^+ r(q); their velocities are
    v_u = -J_u^+ J_m v_m, with the measured joints m (1).

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        states: positions ``q.JOINT`` and velocities ``qd.JOINT`` of its joints.
        unmeasured: names of the joints to place; the others stay.

    Returns:
        The states with the positions and velocities of the unmeasured joints; if the constraints
        cannot be satisfied, the given states.
    """
    import mujoco

    # 1. Model and initial state.
    joints = [joint for joint in robot.joints if f"q.{joint.name}" in states]
    if not unmeasured or not robot.compiled.neq:
        return dict(states)
    model = copy.copy(robot.compiled)
    # The Jacobian of the constraints is then a plain matrix.
    model.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    data = mujoco.MjData(model)
    for joint in joints:
        data.qvel[joint.velocity] = states[f"qd.{joint.name}"]
    # 2. Positions: the measured joints move in small steps from the reference pose to their states,
    # and the unmeasured ones follow.
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
    # 3. Velocities: v_u = -J_u^+ J_m v_m.
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
    """Move the unmeasured joints until the equality constraints are satisfied.

    Each Gauss-Newton step is q_u <- q_u - J_u^+ r(q) with the residual r of the constraints, their
    Jacobian J, and its pseudo-inverse for the unmeasured joints u.

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
        # MuJoCo stores J and r of all constraints; equality constraints are the first `ne` rows.
        mujoco.mj_fwdPosition(model, data)
        jacobian: Array = data.efc_J.reshape(-1, model.nv)[: data.ne].copy()
        step = -np.linalg.pinv(jacobian[:, velocities]) @ data.efc_pos[: data.ne]
        if float(np.abs(step).max(initial=0.0)) < POSITION_TOLERANCE:
            return jacobian
        data.qpos[positions] += step
    return None


def coupled_joints(model: Any, dofs: Sequence[int]) -> list[set[int]]:
    """Return the groups of joints that constraints of a MuJoCo model couple.

    Their motions are not independent, so effects at them may be indistinguishable:

    * A `connect` or `weld` constraint couples the joints between its two bodies and their nearest
      common ancestor.
    * A joint equality couples its two joints.
    * Constraints of other kinds are ignored.

    Args:
        model: compiled MuJoCo model (`mujoco.MjModel`).
        dofs: index of the degree of freedom of each joint.

    Returns:
        Sets of joint numbers (indices into `dofs`), each with at least two joints. Sets that share
        a joint are merged.
    """
    import mujoco

    joint_of_dof = {int(dof): joint for joint, dof in enumerate(dofs)}
    constraint_types, object_types = mujoco.mjtEq, mujoco.mjtObj
    groups: list[set[int]] = []
    for constraint in range(model.neq):
        kind = int(model.eq_type[constraint])
        first_object = int(model.eq_obj1id[constraint])
        second_object = int(model.eq_obj2id[constraint])
        if kind == int(constraint_types.mjEQ_JOINT):
            # The second joint is -1 if the first one is held at a constant.
            coupled_dofs = [
                int(model.jnt_dofadr[joint])
                for joint in (first_object, second_object)
                if joint >= 0
            ]
        elif kind in (int(constraint_types.mjEQ_CONNECT), int(constraint_types.mjEQ_WELD)):
            if int(model.eq_objtype[constraint]) == int(object_types.mjOBJ_SITE):
                first_object, second_object = (
                    int(model.site_bodyid[site]) for site in (first_object, second_object)
                )
            # Ancestors of one of the bodies only are those below the common ancestor.
            first_ancestors = _list_ancestors(model, first_object)
            second_ancestors = _list_ancestors(model, second_object)
            coupled_dofs = [
                dof
                for body in set(first_ancestors) ^ set(second_ancestors)
                for dof in _get_dofs(model, body)
            ]
        else:
            continue
        # Merge the group with all former ones that share a joint with it.
        group = {joint_of_dof[dof] for dof in coupled_dofs if dof in joint_of_dof}
        overlapping_groups = [other_group for other_group in groups if other_group & group]
        groups = [other_group for other_group in groups if not other_group & group]
        groups.append(group.union(*overlapping_groups))
    return [group for group in groups if len(group) > 1]


def _list_ancestors(model: Any, body: int) -> list[int]:
    """Return a body and all its ancestors, including the world.

    Args:
        model: compiled model.
        body: number of the body.
    """
    bodies = [body]
    while body > 0:
        body = int(model.body_parentid[body])
        bodies.append(body)
    return bodies


def _get_dofs(model: Any, body: int) -> range:
    """Return the velocity addresses of a body's own joints; empty if it has none.

    Args:
        model: compiled model.
        body: number of the body.
    """
    first = int(model.body_dofadr[body])
    return range(first, first + int(model.body_dofnum[body])) if first >= 0 else range(0)
