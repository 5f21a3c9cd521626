"""Force limits of stiff servos, at which a simulated motion jumps.

MuJoCo's implicit integrators treat the velocity gain kv of a servo implicitly, except in a step in
which its force F is at a limit (`mjd_smooth_vel`: a clamped force does not depend on the velocity).
With the step h, the inertia M at the joint, and r = h kv / M, the velocity then changes by h F / M
instead of h F / (M + h kv), and changes back in the next step. The position jumps by about

    (h² F / M) r / (1 + r)                                                                      (1)

whenever the commanded force crosses the limit. The other joints jump by the reaction. A linearised
model does not contain such jumps.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sims.core.simulator import Array
from sims.robot.dynamics.inverse_dynamics import inertia_matrix

MIN_STIFF_RATIO = 0.1
"""Minimum r (see the module) of a stiff servo."""
NEAR_LIMIT_SHARE = 0.9
"""Share of a force limit from which the limit counts as possibly reached.

It is below 1 since the state is not known exactly.
"""


class ForceLimits(NamedTuple):
    """Force limits of K stiff servos.

    Attributes:
        outputs: limited force of each servo: a field of MuJoCo's data and the column.
        sizes: (K,) forces from which the limits may be reached, in units of the field.
        jumps: (K, nv) jumps of all positions; at the servo's own joint by (1).
    """

    outputs: tuple[tuple[str, int], ...]
    sizes: Array
    jumps: Array


def find_stiff_force_limits(model: Any) -> ForceLimits:
    """Find the force limits of stiff servos, at which the simulated motion jumps.

    An implicit integrator takes the servo's damping into account within the step. At its force
    limit the servo loses this damping, which changes the state abruptly. A linearised model does
    not contain such jumps, so its user must know where they can occur. There are two kinds of
    limits, on the force of an actuator and on the total actuator force at a joint. With other
    integrators nothing jumps, and the result is empty. A servo is stiff if its velocity gain times
    the time step is a considerable part of the inertia (`MIN_STIFF_RATIO`).

    Args:
        model: the mujoco.MjModel.

    Returns:
        For each limit, the field with the limited force, the force from which the limit counts as
        reached, and the jumps (nv,) of the positions.
    """
    import mujoco

    kinds = mujoco.mjtIntegrator
    implicit = (int(kinds.mjINT_IMPLICIT), int(kinds.mjINT_IMPLICITFAST))
    outputs: list[tuple[str, int]] = []  # field of MuJoCo's data and column
    limits: list[float] = []  # in units of the field
    joint_limits: list[tuple[int, float]] = []  # degree of freedom, and limit of its force
    gains = np.zeros(model.nv)  # velocity gains of all servos at each degree of freedom
    if model.opt.integrator in implicit:
        for actuator_id in range(model.nu):
            dof = _find_dof(model, actuator_id)
            if dof is None:
                continue
            gear = abs(float(model.actuator_gear[actuator_id, 0]))
            # Velocity gain of the servo at its joint; MuJoCo stores it with a negative sign.
            gain = -float(model.actuator_biasprm[actuator_id, 2]) * gear**2
            gains[dof] += gain
            if model.actuator_forcelimited[actuator_id] and _is_stiff(model, dof, gain):
                outputs.append(("actuator_force", actuator_id))
                limits.append(float(np.abs(model.actuator_forcerange[actuator_id]).max()))
                joint_limits.append((dof, limits[-1] * gear))
        for joint in np.flatnonzero(model.jnt_actfrclimited).tolist():
            dof = int(model.jnt_dofadr[joint])
            if _is_stiff(model, dof, float(gains[dof])):
                outputs.append(("qfrc_actuator", dof))
                limits.append(float(np.abs(model.jnt_actfrcrange[joint]).max()))
                joint_limits.append((dof, limits[-1]))
    # The gains of all servos must be known first.
    jumps = [_compute_jump(model, dof, force, gains) for dof, force in joint_limits]
    return ForceLimits(
        tuple(outputs), NEAR_LIMIT_SHARE * np.array(limits), np.array(jumps).reshape(-1, model.nv)
    )


def _compute_jump(model: Any, dof: int, force: float, gains: Array) -> Array:
    """Compute how far positions (nv,) jump in a step in which one servo is at its force limit.

    Forces f change the velocity by (M + h diag(kv))^-1 h f in a step h, with the inertia matrix M
    and the servos' velocity gains kv, which MuJoCo's implicit integrators treat implicitly. At its
    limit a servo loses its gain. The jump is the difference of both velocities, times h, without
    its sign. The servos of the other joints are taken as not limited.

    Args:
        model: the mujoco.MjModel.
        dof: degree of freedom of the servo's joint.
        force: force limit at the joint, in N or N m.
        gains: (nv,) velocity gains of the servos at the joints.
    """
    inertia, step, other_gains = inertia_matrix(model), model.opt.timestep, gains.copy()
    other_gains[dof] = 0.0
    force_vector = np.zeros(model.nv)
    force_vector[dof] = force
    undamped = np.linalg.solve(inertia + step * np.diag(other_gains), force_vector)
    damped = np.linalg.solve(inertia + step * np.diag(gains), force_vector)
    jump: Array = step**2 * np.abs(undamped - damped)
    return jump


def _find_dof(model: Any, actuator: int) -> int | None:
    """Return the degree of freedom of an actuator's joint; None if it drives no hinge or slide.

    Args:
        model: compiled model.
        actuator: number of the actuator.
    """
    import mujoco

    joints = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    single = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    joint = int(model.actuator_trnid[actuator, 0])
    if model.actuator_trntype[actuator] not in joints or model.jnt_type[joint] not in single:
        return None
    return int(model.jnt_dofadr[joint])


def _is_stiff(model: Any, dof: int, gain: float) -> bool:
    return bool(model.opt.timestep * gain > MIN_STIFF_RATIO * model.dof_M0[dof])
