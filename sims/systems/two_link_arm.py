"""A two-link arm in a vertical plane, on PyBullet.

With both angles measured from the vertical of the link before (0 hanging straight),

    M(q) q'' + c(q, q') + g(q) = u - damping q' - friction sign(q')        (1)

the equations are those of M. W. Spong, S. Hutchinson, M. Vidyasagar, Robot Modeling and Control
(2006), section 7.4, with gravity along the arm at rest. Bullet's articulated-body algorithm solves
them.

Bullet steps by semi-implicit Euler, which is of first order. Here each step of length h is two of
Bullet's, from v to v1 and from v1 to v2, whose mean is taken as in Heun's method, which makes it of
second order (E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 1993,
section II.1):

    q' = q + h (v + v1) / 2                                                (2)
    v' = (v + v2) / 2                                                      (3)

Dry friction is Bullet's
joint motor with the friction as its limit and standstill as its goal: a constraint of both joints
at once, which holds what pulls less. It cannot change sides within a step, so a step in which a
joint with friction comes to rest or turns round is taken again in small parts.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from sims.core.number_limits import GRAVITY_RANGE, INERTIA_RANGE, LENGTH_RANGE
from sims.core.simulator import Channel, Constant, Parameter
from sims.engines.external.bullet_world import NO_LIMIT
from sims.own_simulator import BulletWorld, OwnSimulator

_IDENTITY_QUATERNION = (0.0, 0.0, 0.0, 1.0)
"""Not turned, as a quaternion x, y, z, w."""
_JOINT_AXIS = (0.0, 1.0, 0.0)
"""Of both joints: the arm swings in the plane of x and z."""
_FRICTION_SUBSTEPS = 16
"""Parts of a step in which dry friction changes sides."""
_SOLVER_ROUNDS = 200
"""Rounds of Bullet's constraint solver, in which both joints' frictions are settled together."""
_UNPICKLABLE_ATTRIBUTES = (
    "_world",
    "_set_joint_state",
    "_set_joint_motor",
    "_get_joint_state",
    "_step_simulation",
)
"""Attributes that belong to a world in this process and cannot be copied."""
_REST_SPEED = 1e-6
"""rad/s: a joint that is slower is at rest."""


def _make_link_parameters(
    name: str,
    unit: str,
    nominal: float,
    bounds: tuple[float, float],
    training: tuple[float, float],
    description: str,
) -> tuple[Parameter, Parameter]:
    """Return a parameter of each of the two links, with the link's number in its name.

    Args:
        name: name without the number.
        unit: unit of the values.
        nominal: nominal value.
        bounds: lower and upper bound.
        training: range of the training.
        description: the quantity in words.
    """

    def of(link: int) -> Parameter:
        return Parameter(
            f"{name}{link}", unit, nominal, bounds, training, says=f"{description} {link}"
        )

    return of(1), of(2)


class TwoLinkArm(OwnSimulator):
    """A two-link arm that swings in a vertical plane, driven at both joints."""

    name = "arm"
    requires = ("pybullet",)
    says = "a two-link arm in a vertical plane, driven at both joints"
    kind = "rotary"
    time_step = 1 / 250
    parameters = (
        *_make_link_parameters(
            "mass", "kg", 1.0, (0.2, 3.0), (0.5, 1.5), description="mass of link"
        ),
        *_make_link_parameters(
            "centre",
            "m",
            0.2,
            (0.05, 0.35),
            (0.12, 0.28),
            description="from the joint to the centre of mass of link",
        ),
        *_make_link_parameters(
            "damping",
            "N*m*s/rad",
            0.1,
            (0.0, 0.5),
            (0.0, 0.2),
            description="viscous damping of joint",
        ),
        *_make_link_parameters(
            "friction", "N*m", 0.1, (0.0, 0.5), (0.0, 0.2), description="dry friction of joint"
        ),
    )
    constants = (
        Constant("length", "m", 0.4, "of link 1, from joint to joint", True, LENGTH_RANGE),
        Constant(
            "inertia1", "kg*m^2", 0.012, "of link 1 about its centre of mass", True, INERTIA_RANGE
        ),
        Constant(
            "inertia2", "kg*m^2", 0.012, "of link 2 about its centre of mass", True, INERTIA_RANGE
        ),
        Constant("gravity", "m/s^2", 9.81, "downward", limits=GRAVITY_RANGE),
    )
    inputs = (
        Channel("u1", "N*m", says="torque at joint 1"),
        Channel("u2", "N*m", says="torque at joint 2"),
    )
    channels = (
        Channel("q1", "rad", says="angle of joint 1, 0 when link 1 hangs"),
        Channel("q2", "rad", says="angle of joint 2, 0 when the arm is straight"),
        Channel("qd1", "rad/s", 10.0, "rate of joint 1"),
        Channel("qd2", "rad/s", 10.0, "rate of joint 2"),
    )
    coordinates = ("q1", "q2")
    rates = ("qd1", "qd2")
    states = MappingProxyType({"q1": 0.5, "q2": 0.5, "qd1": 0.0, "qd2": 0.0})

    _world: BulletWorld

    def reset(
        self,
        theta: Mapping[str, float],
        constants: Mapping[str, float],
        initial: Mapping[str, float],
    ) -> None:
        """Build the arm again in an empty world.

        Bullet cannot move a centre of mass, and building takes 0.3 ms.

        Args:
            theta: parameters by name: masses, centres of mass, damping and friction of both links.
            constants: constants by name: gravity, length of the first link, and inertias.
            initial: angles and rates of both joints by name, rad and rad/s.
        """
        if "_world" not in self.__dict__:
            self._world = BulletWorld()
        pybullet = self._world
        pybullet.resetSimulation()
        pybullet.setGravity(0.0, 0.0, -constants["gravity"])
        # Do all rounds, whatever the residual: a joint that friction holds must stand still.
        pybullet.setPhysicsEngineParameter(
            numSolverIterations=_SOLVER_ROUNDS, solverResidualThreshold=0.0
        )
        self._arm = self._build_arm(theta, constants)
        for joint in (0, 1):
            inertia = constants[f"inertia{joint + 1}"]
            damping = theta[f"damping{joint + 1}"]
            pybullet.changeDynamics(
                self._arm, joint, localInertiaDiagonal=(inertia,) * 3, jointDamping=damping
            )
        self._friction = [theta["friction1"], theta["friction2"]]
        self._step = 0.0  # s; Bullet's step is set before the first one
        # Functions of Bullet, looked up once: a run calls each of them thousands of times.
        self._set_joint_state = pybullet.resetJointState
        self._set_joint_motor = pybullet.setJointMotorControl2
        self._get_joint_state = pybullet.getJointState
        self._step_simulation = pybullet.stepSimulation
        self._torque_mode = pybullet.TORQUE_CONTROL
        self._q = [initial["q1"], initial["q2"]]
        self._v = [initial["qd1"], initial["qd2"]]

    def _build_arm(self, theta: Mapping[str, float], constants: Mapping[str, float]) -> int:
        """Build the two links in the empty world and return the id of the body.

        Args:
            theta: masses (kg) and distances of the centres of mass (m) by name.
            constants: length of the first link (m).
        """
        pybullet = self._world
        arm: int = pybullet.createMultiBody(
            linkMasses=[theta["mass1"], theta["mass2"]],
            linkCollisionShapeIndices=[-1, -1],
            linkVisualShapeIndices=[-1, -1],
            linkPositions=[(0.0, 0.0, 0.0), (0.0, 0.0, -constants["length"])],
            linkOrientations=[_IDENTITY_QUATERNION, _IDENTITY_QUATERNION],
            linkInertialFramePositions=[
                (0.0, 0.0, -theta["centre1"]),
                (0.0, 0.0, -theta["centre2"]),
            ],
            linkInertialFrameOrientations=[_IDENTITY_QUATERNION, _IDENTITY_QUATERNION],
            linkParentIndices=[0, 1],
            linkJointTypes=[pybullet.JOINT_REVOLUTE, pybullet.JOINT_REVOLUTE],
            linkJointAxis=[_JOINT_AXIS, _JOINT_AXIS],
        )
        # By default Bullet adds air resistance, sleep when nothing moves, and a speed limit. -1 is
        # Bullet's index of the body's base.
        pybullet.changeDynamics(
            arm, -1, linearDamping=0.0, angularDamping=0.0, maxJointVelocity=NO_LIMIT
        )
        pybullet.changeDynamics(arm, -1, activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING)
        return arm

    def step(self, inputs: Mapping[str, float], seconds: float) -> None:
        """Make one step of Heun's method, or several short ones where dry friction changes sides.

        Args:
            inputs: torques ``u1`` and ``u2``, N·m.
            seconds: length of the step, s.
        """
        torques = (inputs["u1"], inputs["u2"])
        state_before = (self._q, self._v)
        # Bullet fixes the direction of friction for a step: where it changes, repeat the step in
        # short parts.
        if self._step_heun(torques, seconds):
            self._q, self._v = state_before
            for _ in range(_FRICTION_SUBSTEPS):
                self._step_heun(torques, seconds / _FRICTION_SUBSTEPS)

    def _step_heun(self, torques: tuple[float, float], seconds: float) -> bool:
        """Make one step of Heun's method from two steps of Bullet, v to v1 and v1 to v2.

        With the angles q, the rates v and the step h, the result is q + h (v + v1) / 2 (2) and
        (v + v2) / 2 (3). Bullet's step is of first order; these means are of second order.

        Args:
            torques: torques at both joints, N·m.
            seconds: length of the step, s.

        Returns:
            Whether a joint with dry friction came to rest or changed its direction.
        """
        self._set_step_length(seconds)
        q = self._q
        v = self._v
        for joint in (0, 1):
            self._set_joint_state(self._arm, joint, q[joint], v[joint])
        v1 = self._advance(torques)
        v2 = self._advance(torques)
        self._q = [q[i] + seconds * (v[i] + v1[i]) / 2 for i in (0, 1)]  # (2)
        self._v = [(v[i] + v2[i]) / 2 for i in (0, 1)]  # (3)
        return any(
            _has_stopped_or_turned(v[i], v1[i], v2[i]) for i in (0, 1) if self._friction[i] > 0
        )

    def observe(self) -> Mapping[str, float]:
        """Angles and rates."""
        q1, q2 = self._q
        qd1, qd2 = self._v
        return {"q1": q1, "q2": q2, "qd1": qd1, "qd2": qd2}

    def close(self) -> None:
        """Leave Bullet; the next run starts it again."""
        self.__dict__.pop("_world", None)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for pickling without the Bullet world, which cannot be copied."""
        # A copy gets a world of its own.
        return {
            name: value
            for name, value in self.__dict__.items()
            if name not in _UNPICKLABLE_ATTRIBUTES
        }

    def _set_step_length(self, seconds: float) -> None:
        """Set the step length in seconds, and with it the joint friction, if the length changes."""
        # Dry friction is a motor that holds the joint still with at most this torque. Bullet turns
        # the torque into an impulse when the motor is set, which is valid for one step length.
        if seconds != self._step:
            pybullet = self._world
            pybullet.setTimeStep(seconds)
            for joint, friction in enumerate(self._friction):
                pybullet.setJointMotorControl2(
                    self._arm, joint, pybullet.VELOCITY_CONTROL, targetVelocity=0.0, force=friction
                )
            self._step = seconds

    def _advance(self, torques: tuple[float, float]) -> tuple[float, float]:
        """Advance Bullet by one step with torques in N m; return the new joint rates in rad/s."""
        for joint in (0, 1):
            if torques[joint]:  # Bullet forgets them after each step
                self._set_joint_motor(self._arm, joint, self._torque_mode, force=torques[joint])
        self._step_simulation()
        _, rate1, *_ = self._get_joint_state(self._arm, 0)
        _, rate2, *_ = self._get_joint_state(self._arm, 1)
        return rate1, rate2


def _has_stopped_or_turned(rate_before: float, middle: float, rate_after: float) -> bool:
    """Return whether a joint that moved has come to rest or turned round.

    Args:
        rate_before: rate at the beginning of the step, rad/s.
        middle: rate after the first of two steps of Bullet.
        rate_after: rate after the second one.
    """
    if abs(rate_before) <= _REST_SPEED:
        return False
    # Rates times the sign of the rate before are negative after a reversal.
    return min(middle * rate_before, rate_after * rate_before) < _REST_SPEED * abs(rate_before)
