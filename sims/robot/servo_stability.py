"""Stability of servos at the time step of a simulation.

MuJoCo's integrator `Euler` takes the force of a servo from the state at the beginning of a step;
only the damping b of a joint is implicit. With position gain k and velocity gain d, the inertia m
that the servo moves, and the step h, small motions of its length q follow

    v' = ((m - h d) v - h k q) / (m + h b),    q' = q + h v'               (1)

from one step to the next. Errors decay if

    h^2 k + 2 h d < 4 m + 2 h b                                            (2)

(Schur-Cohn criterion of the characteristic polynomial of (1)). With `RK4`, whose damping of joints
is explicit too, they decay if for both roots s of m s^2 + (d + b) s + k = 0

    |1 + z + z^2 / 2 + z^3 / 6 + z^4 / 24| < 1,    z = h s.                (3)

Otherwise they grow until the servo reaches its force limit, and it oscillates from step to step.
The implicit integrators have no such limit. The inertia at an actuator with the moment arms r of
all degrees of freedom (rows of MuJoCo's `actuator_moment`) and the inertia matrix M is
m = 1 / (r M^-1 r^T). Servos are considered one by one.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from sims.core.simulator import Array
from sims.robot.integrator_settings import IntegratorSettings
from sims.robot.robot_model import RobotModel

EXPLICIT_INTEGRATORS = ("Euler", "RK4")
"""Integrators that take the force of a servo at the beginning of a step."""
MIN_GROWTH = 1.01
"""Minimum growth of an error in one step at which a servo counts as unstable."""
MAX_HALVINGS = 12
"""Maximum number of times that the step is halved to find a stable one."""


class UnstableServo(NamedTuple):
    """A servo whose simulation is unstable at the time step.

    Attributes:
        name: name of the actuator.
        growth: factor by which an error grows in a step, in the worst pose.
        stable_step: stable step in seconds in this pose, found by halving the present one; None if
            none is stable.
    """

    name: str
    growth: float
    stable_step: float | None


class ServoMotion(NamedTuple):
    """Linear motion of a servo.

    Attributes:
        inertia: inertia m that it moves, kg m^2 or kg.
        stiffness: position gain k.
        servo_damping: velocity gain d.
        joint_damping: damping b of its joint.
    """

    inertia: float
    stiffness: float
    servo_damping: float
    joint_damping: float

    def compute_growth(self, step: float, integrator: str) -> float:
        """Return the factor by which an error of the state grows in one step.

        Args:
            step: time step in seconds.
            integrator: ``Euler`` (1) or ``RK4`` (3).
        """
        inertia, stiffness, servo_damping, joint_damping = self
        if integrator == "Euler":
            total = inertia + step * joint_damping
            determinant = (inertia - step * servo_damping) / total
            trace = 1.0 + determinant - step**2 * stiffness / total
            return float(np.abs(np.roots([1.0, -trace, determinant])).max())
        z = step * np.roots([inertia, servo_damping + joint_damping, stiffness])
        return float(np.abs(1.0 + z + z**2 / 2.0 + z**3 / 6.0 + z**4 / 24.0).max())


def list_unstable_servos(
    robot: RobotModel, settings: IntegratorSettings, poses: Iterable[Any]
) -> list[UnstableServo]:
    """List the servos that are unstable at the time step of a simulation in any of some poses.

    Servos are actuators whose force is an affine function of their length and velocity. Those with
    an activation (a filter before the force) are left out.

    Args:
        robot: model of the robot.
        settings: time step and integrator of the simulation.
        poses: states (mujoco.MjData) of the compiled model, each after mj_forward; they are not
            evaluated for an implicit integrator.

    Returns:
        The servos in alphabetical order.
    """
    step, integrator = settings.timestep, settings.integrator
    if integrator not in EXPLICIT_INTEGRATORS:
        return []
    # Largest growth of each servo, and its motion in that pose.
    worst: dict[str, tuple[float, ServoMotion]] = {}
    for data in poses:
        for name, motion in _list_servo_motions(robot.compiled, data):
            growth = motion.compute_growth(step, integrator)
            if growth >= MIN_GROWTH and (name not in worst or growth > worst[name][0]):
                worst[name] = growth, motion
    return [
        UnstableServo(name, growth, _find_stable_step(motion, step, integrator))
        for name, (growth, motion) in sorted(worst.items())
    ]


def _find_stable_step(motion: ServoMotion, step: float, integrator: str) -> float | None:
    """Return the first stable step in seconds, halving the present one; None if none is."""
    for halvings in range(1, MAX_HALVINGS + 1):
        smaller_step = step * 0.5**halvings
        if motion.compute_growth(smaller_step, integrator) < MIN_GROWTH:
            return smaller_step
    return None


def _list_servo_motions(model: Any, data: Any) -> list[tuple[str, ServoMotion]]:
    """Return name and linear motion of each servo of a compiled model in a pose.

    Args:
        model: compiled model (mujoco.MjModel).
        data: its state (mujoco.MjData) in the pose, after mj_forward.
    """
    import mujoco

    is_servo = (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE) & (
        model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    )
    if not is_servo.any():
        return []
    moments: Array = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(
        moments, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
    )
    accelerations: Array = np.zeros_like(moments)
    mujoco.mj_solveM(model, data, accelerations, moments)  # M^-1 r^T, by row
    # Inverse inertia at each actuator; zero if it moves nothing.
    mobilities = np.einsum("ij,ij->i", moments, accelerations)
    motions = []
    for i in np.flatnonzero(is_servo).tolist():
        mobility = float(mobilities[i])
        position_gain, velocity_gain = (-model.actuator_biasprm[i, 1:3]).tolist()
        if mobility > 0.0 and (position_gain > 0.0 or velocity_gain > 0.0):
            # Damping of the joints as seen at the actuator, whose length changes by r q.
            squared_moments = np.square(moments[i])
            damping = float(squared_moments @ model.dof_damping) / float(squared_moments.sum()) ** 2
            motions.append(
                (
                    model.actuator(i).name,
                    ServoMotion(1.0 / mobility, position_gain, velocity_gain, damping),
                )
            )
    return motions
