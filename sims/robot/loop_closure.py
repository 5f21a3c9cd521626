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
from itertools import count
from typing import Any

import numpy as np

from sims.core.simulator import Array
from sims.robot.floating_joints import list_state_units
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.robot_model import Joint, RobotModel

MAX_STEPS = 40
"""Maximum number of Gauss-Newton steps at a pose of the measured joints."""
MAX_MOTION = 0.2
"""Largest change of a joint from one pose to the next, in rad or m."""
SETTLING_SECONDS = 0.1
"""Duration for which unmeasured joints settle, several time constants of usual constraints."""
GUIDED_INERTIA = 1e6
"""Inertia added to joints with a given motion, in kg m² or kg."""
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
        states: positions and velocities of its joints, such as ``q.JOINT`` and ``qd.JOINT``.
        unmeasured: names of the joints to place, of any kind; the others stay.

    Returns:
        The states with the positions and velocities of the unmeasured joints; if the constraints
        cannot be satisfied, the given states.
    """
    import mujoco

    # 1. Model and initial state. Without equality constraints (`neq`) there are no loops.
    if not unmeasured or not robot.compiled.neq:
        return dict(states)
    loops = _LoopModel(robot, states, unmeasured)
    model, data, dofs = loops.model, loops.data, loops.dofs
    # 2. Positions: the measured joints move in small steps from the reference pose to their states,
    # and the unmeasured ones follow. In the reference pose of a file, a linkage may be stretched,
    # so that two motions are possible; the ranges of its joints tell which one is meant.
    reference = np.clip(model.qpos0, *loops.ranges)
    # Displacement from the reference pose to the given one; only the measured joints make it.
    change = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, change, 1.0, reference, data.qpos)
    change[dofs] = 0.0
    data.qpos[:] = reference
    # Number of steps in which the measured joints move, each by at most `MAX_MOTION`.
    poses = 1 + int(np.abs(change).max(initial=0.0) / MAX_MOTION)
    jacobian: Array | None = None
    for _ in range(poses):
        mujoco.mj_integratePos(model, data.qpos, change, 1.0 / poses)
        jacobian = _solve_constraints(loops)
    if jacobian is None:
        return dict(states)
    # 3. Velocities: v_u = -J_u^+ J_m v_m. With v_u = 0, the product J v is J_m v_m.
    data.qvel[dofs] = 0.0
    data.qvel[dofs] = -np.linalg.pinv(jacobian[:, dofs]) @ (jacobian @ data.qvel)
    return {**states, **loops.get_unmeasured_states()}


def settle_loops(
    robot: RobotModel, states: Mapping[str, float], unmeasured: Collection[str]
) -> dict[str, float]:
    """Let unmeasured joints of closed loops settle, while the measured ones move evenly.

    MuJoCo's constraints are soft: under load, such as that of a spring in the loop, they deflect,
    and a simulation that begins without the deflection begins with a jump of the forces. The
    measured joints approach their state with constant velocity for `SETTLING_SECONDS`.

    Args:
        robot: model of the robot.
        states: positions and velocities of its joints, in which the loops are closed.
        unmeasured: names of the joints that settle, of any kind; the others keep their states.

    Returns:
        The states with the settled ones; the given states if the joints do not settle.
    """
    import mujoco

    if not unmeasured or not robot.compiled.neq:
        return dict(states)
    loops = _LoopModel(robot, states, unmeasured)
    model, data = loops.model, loops.data
    # Go back in time with constant velocities, and close the loops there. A negative time step
    # moves the positions backwards.
    steps = max(round(SETTLING_SECONDS / model.opt.timestep), 1)
    mujoco.mj_integratePos(model, data.qpos, data.qvel, -steps * model.opt.timestep)
    if _solve_constraints(loops) is None:
        return dict(states)
    # Simulate until the measured joints are in their given state again.
    loops.guide_measured_joints()
    with capture_mujoco_warnings() as warnings:
        mujoco.mj_step(model, data, steps)
    if warnings:  # the simulation is unstable
        return dict(states)
    return {**states, **loops.get_unmeasured_states()}


def follow_measured_joints(
    robot: RobotModel, step: float, positions: Array, velocities: Array, unmeasured: Collection[str]
) -> tuple[Array, Array]:
    """Move unmeasured joints of closed loops as the constraints and the measured joints make them.

    A simulation of the whole robot is far from the measured motion if a number of the model is
    wrong, so that its unmeasured joints would not fit in the loops. Here only they are simulated.

    Args:
        robot: model of the robot.
        step: time step in seconds.
        positions: (S + 1, nq) positions of all joints at the beginnings of S steps and at the end,
            in the order of qpos.
        velocities: (S + 1, nv) their velocities, in the order of qvel.
        unmeasured: names of the joints that are moved from their states in the first row.

    Returns:
        Positions and velocities with the motion of the unmeasured joints; the given ones if the
        simulation is unstable.
    """
    import mujoco

    loops = _LoopModel(robot, {}, unmeasured)
    model, data = loops.model, loops.data
    loops.guide_measured_joints()
    model.opt.timestep = step
    new_positions, new_velocities = positions.copy(), velocities.copy()
    with capture_mujoco_warnings() as warnings:
        for k in range(len(positions) - 1):
            # The result of a step counts for the unmeasured joints only; all others have the given
            # state at the next step.
            data.qpos[:], data.qvel[:] = new_positions[k], new_velocities[k]
            mujoco.mj_step(model, data)
            new_positions[k + 1, loops.addresses] = data.qpos[loops.addresses]
            new_velocities[k + 1, loops.dofs] = data.qvel[loops.dofs]
    if warnings:
        return positions, velocities
    return new_positions, new_velocities


class _LoopModel:
    """Copy of a robot's model and its data, with the addresses of unmeasured joints.

    Attributes:
        model: compiled model, whose constraints have a dense Jacobian.
        data: its state.
        addresses: addresses of the unmeasured joints in qpos.
        dofs: their addresses in qvel.
        ranges: (2, nq) lowest and highest positions of all joints.
    """

    def __init__(
        self, robot: RobotModel, states: Mapping[str, float], unmeasured: Collection[str]
    ) -> None:
        """Copy the model, and set the state of its data.

        Args:
            robot: model of the robot.
            states: positions and velocities by name; others are those of the reference pose.
            unmeasured: names of the unmeasured joints.
        """
        self.model, self.data = _make_dense_data(robot)
        # Addresses of the unmeasured joints in qpos and qvel, by the names of their positions and
        # velocities.
        addresses: dict[str, int] = {}
        dofs: dict[str, int] = {}
        # Lowest and highest value of each position; infinite for joints without a range.
        self.ranges = np.full((2, self.model.nq), [[-np.inf], [np.inf]])
        for joint in robot.joints:
            # The names of a joint's positions (and velocities) have consecutive addresses.
            positions, velocities = list_state_units(joint)
            joint_addresses = dict(zip(positions, count(joint.position), strict=False))
            joint_dofs = dict(zip(velocities, count(joint.velocity), strict=False))
            for name in states.keys() & joint_addresses.keys():
                self.data.qpos[joint_addresses[name]] = states[name]
            for name in states.keys() & joint_dofs.keys():
                self.data.qvel[joint_dofs[name]] = states[name]
            if joint.name in unmeasured:
                addresses |= joint_addresses
                dofs |= joint_dofs
            if joint.range is not None and joint.has_one_coordinate:
                self.ranges[:, joint.position] = joint.range
        self._names = [*addresses, *dofs]
        self.addresses = np.array([*addresses.values()], np.intp)
        self.dofs = np.array([*dofs.values()], np.intp)

    def guide_measured_joints(self) -> None:
        """Give measured joints a large inertia, so that they keep the velocities that they have.

        Drives, contacts and limits are left out: their forces depend on more than the loops.
        """
        import mujoco

        # All degrees of freedom except for those of the unmeasured joints.
        guided = np.setdiff1d(np.arange(self.model.nv), self.dofs)
        self.model.dof_armature[guided] += GUIDED_INERTIA
        flags = mujoco.mjtDisableBit
        for flag in (flags.mjDSBL_CONTACT, flags.mjDSBL_LIMIT, flags.mjDSBL_ACTUATION):
            self.model.opt.disableflags |= int(flag)

    def get_unmeasured_states(self) -> dict[str, float]:
        """Return positions and velocities of the unmeasured joints by name."""
        states = [*self.data.qpos[self.addresses].tolist(), *self.data.qvel[self.dofs].tolist()]
        return dict(zip(self._names, states, strict=True))


def list_following_joints(
    robot: RobotModel, loops: Sequence[Collection[str]], measured: Collection[str]
) -> list[str]:
    """Return the names of unmeasured joints that the measured ones of their closed loop move.

    The result has no joints of a loop without a measured joint, since its drives move it; and
    none of a loop with a drive at an unmeasured joint, since this drive moves it, too.

    Args:
        robot: model of the robot with its joints and actuators.
        loops: names of the joints of each closed loop.
        measured: names of the measured states, such as ``q.crank`` and ``q.rod.qw``.
    """
    # An actuator drives one joint, or those of its tendon.
    driven = {joint for a in robot.actuators for joint in (a.joint, *a.moves)}
    following = list[str]()
    for loop in loops:
        unmeasured = list_unmeasured_joints(robot, loop, measured)
        has_measured_joint = len(unmeasured) < len(loop)
        if has_measured_joint and driven.isdisjoint(unmeasured):
            following += unmeasured
    return following


def list_unmeasured_joints(
    robot: RobotModel, joints: Collection[str], measured: Collection[str]
) -> list[str]:
    """Return the names of those joints of a loop that are not measured, sorted.

    A joint counts as measured if any of its positions or velocities is.

    Args:
        robot: model of the robot with its joints.
        joints: names of the joints, of any kind.
        measured: names of the measured states, such as ``q.crank``.
    """
    unmeasured = []
    for name in sorted(joints):
        position_units, velocity_units = list_state_units(robot.joint(name))
        states = {*position_units, *velocity_units}  # their names
        if states.isdisjoint(measured):
            unmeasured.append(name)
    return unmeasured


def list_joints_placed_by_loops(robot: RobotModel) -> list[Joint]:
    """Return the floating joints whose pose follows from those of the joints with one coordinate.

    The constraints determine all of its directions in the reference pose but one: a rod with a ball
    joint at each end may turn about itself, which moves nothing else.

    Args:
        robot: model of the robot.
    """
    import mujoco

    floating = [joint for joint in robot.joints if not joint.has_one_coordinate]
    if not floating or not robot.compiled.neq:
        return []
    model, data = _make_dense_data(robot)
    mujoco.mj_fwdPosition(model, data)
    jacobian = _get_equality_jacobian(model, data)
    placed = []
    for joint in floating:
        _, velocity_units = list_state_units(joint)
        dof_count = len(velocity_units)
        columns = jacobian[:, joint.velocity : joint.velocity + dof_count]
        if np.linalg.matrix_rank(columns) >= dof_count - 1:
            placed.append(joint)
    return placed


def _make_dense_data(robot: RobotModel) -> tuple[Any, Any]:
    """Return a copy of the robot's model whose constraints have a dense Jacobian, and its data."""
    import mujoco

    model = copy.copy(robot.compiled)
    model.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    return model, mujoco.MjData(model)


def _get_equality_jacobian(model: Any, data: Any) -> Array:
    """Return the Jacobian (constraints, nv) of the equality constraints.

    MuJoCo stores the Jacobian and the residual of all constraints; equality constraints are the
    first `ne` rows.

    Args:
        model: compiled model, whose constraints have a dense Jacobian.
        data: its state, after `mj_fwdPosition`.
    """
    jacobian: Array = data.efc_J.reshape(-1, model.nv)[: data.ne].copy()
    return jacobian


def _solve_constraints(loops: _LoopModel) -> Array | None:
    """Move the unmeasured joints until the equality constraints are satisfied.

    Each Gauss-Newton step is q_u <- q_u - J_u^+ r(q) with the residual r of the constraints, their
    Jacobian J, and its pseudo-inverse for the unmeasured joints u. A step is shortened to
    `MAX_MOTION`, and joints stay in their ranges.

    Args:
        loops: the model, whose state is changed.

    Returns:
        Jacobian (constraints, nv) of the constraints; None if they cannot be satisfied.
    """
    import mujoco

    model, data, dofs = loops.model, loops.data, loops.dofs
    step = np.zeros(model.nv)
    for _ in range(MAX_STEPS):
        mujoco.mj_fwdPosition(model, data)
        jacobian = _get_equality_jacobian(model, data)
        residual = data.efc_pos[: data.ne]  # of the equality constraints, which come first
        step[dofs] = -np.linalg.pinv(jacobian[:, dofs]) @ residual
        length = float(np.abs(step).max(initial=0.0))
        if length < POSITION_TOLERANCE:
            return jacobian
        mujoco.mj_integratePos(model, data.qpos, step, min(1.0, MAX_MOTION / length))
        lowest, highest = loops.ranges[:, loops.addresses]
        data.qpos[loops.addresses] = np.clip(data.qpos[loops.addresses], lowest, highest)
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
            chain = set(first_ancestors) ^ set(second_ancestors)
            coupled_dofs = [dof for body in chain for dof in _get_dofs(model, body)]
        else:
            continue
        # Merge the group with all former ones that share a joint with it. Joints that are not in
        # `dofs` are left out.
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
