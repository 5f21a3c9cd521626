"""True world of the bounce shot: MuJoCo, with physics that the planning simulator lacks.

A free rigid sphere flies through still air with quadratic drag and the lift of its spin,

    drag = -1/2 rho Cd A |v| v                                             (1)
    lift = 1/2 rho A r omega x v                                           (2)

(C_L = r omega / v; G. Robinson, I. Robinson, Physica Scripta 88, 018101, 2013,
doi:10.1088/0031-8949/88/01/018101), integrated by MuJoCo's Runge-Kutta 4. Contact takes time:
MuJoCo's spring and damper between ball and ground act for about `CONTACT_SECONDS` seconds. The
damping gives the restitution at the impact's speed: with damping ratio D, contact that ends when
the force becomes zero gives

    e = exp(-D / w atan2(2 D w, 2 D^2 - 1)),        w = sqrt(1 - D^2)      for D < 1    (3)
    e = exp(-D / s log((D + s) / (D - s))),         s = sqrt(D^2 - 1)      for D > 1    (4)

(T. Schwager, T. Poeschel, Phys. Rev. E 78, 051304, 2008, doi:10.1103/PhysRevE.78.051304, equation
12). MuJoCo's friction is a convex relaxation that turns slip into lift. Therefore its contact is
frictionless here, and Coulomb friction is applied at each step with the normal force N that MuJoCo
reports: the ball slides until it rolls, and spins. A force f at its surface changes the slip of a
sphere of moment of inertia k m r^2 by f (1 + 1 / k) / m per second, so that within a step h

    |f| = min(mu N, k / (1 + k) m |slip| / h)                              (5)
"""

from __future__ import annotations

import importlib.util
import math
from dataclasses import dataclass

import numpy as np

from bench.bounce_shot.shot_config import BallKind
from sims.core.simulator import Array, InputError
from sims.engines.external.mujoco_bodies import compute_damping_ratio

AIR_DENSITY = 1.2
"""Density of air, kg/m^3."""
GRAVITY = 9.81
"""Gravitational acceleration, downward, m/s^2."""
CONTACT_SECONDS = 3e-3
"""Duration of an impact in seconds; it is 5 ms for tennis balls and 0.5 ms for golf balls."""
_FLIGHT_STEP = 1e-3
"""Length of a step in flight, s."""
_CONTACT_STEP = 3e-5
"""Length of a step in contact in seconds, a hundredth of an impact."""
_CONTACT_IMPEDANCE = 0.9999
"""Constraint impedance of the contact, the largest that MuJoCo allows."""
_MAX_DAMPING_RATIO = 60.0
"""Damping ratio at which the restitution is practically zero."""


def find_missing_requirement() -> str:
    """Return why this world is not available here; empty if it is."""
    if importlib.util.find_spec("mujoco"):
        return ""
    return "the world needs mujoco, not installed (pip install mujoco)"


@dataclass(frozen=True)
class InclinedGround:
    """Inclined plane through the origin: its angle in rad, descending towards x, and friction."""

    angle: float = 0.0
    friction: float = 0.3


def simulate_shot(
    ball: BallKind,
    ground: InclinedGround,
    start: tuple[float, float, float],
    times: Array,
    air: float = AIR_DENSITY,
) -> Array:
    """Simulate the path of a ball that is released at rest.

    Args:
        ball: Properties of the ball.
        ground: Inclined plane.
        start: Initial position of its centre above the plane, m.
        times: (T,) sample times, increasing from 0, s.
        air: Density of the air, kg/m^3.

    Returns:
        Centres (T, 3), m.

    Raises:
        InputError: MuJoCo is missing, or the ball begins in the ground.
    """
    if reason := find_missing_requirement():
        raise InputError(reason)
    flight = _Flight(ball, ground, air)
    if flight.gap(*start) <= 0:
        raise InputError(f"expected a ball above the ground, found its centre at {start}")
    return flight.run(start, times)


class _Flight:
    """Simulation of one ball by MuJoCo, with drag, lift and friction of this module."""

    def __init__(self, ball: BallKind, ground: InclinedGround, air: float) -> None:
        """Build the MuJoCo model, and compute the factors of drag (1) and lift (2).

        `_normal` is the x and z part of the unit vector normal to the ground, and `_touches` tells
        whether the ball is in contact.

        Drag is -1/2 rho Cd A |v| v (1) and lift 1/2 rho A r omega x v (2).

        Args:
            ball: properties of the ball.
            ground: inclined plane.
            air: density of the air, kg/m^3.
        """
        import mujoco

        self._ball = ball
        self._friction = ground.friction
        self._normal = math.sin(ground.angle), math.cos(ground.angle)
        area = math.pi * ball.radius**2
        self._drag = 0.5 * air * ball.drag * area
        self._lift = 0.5 * air * area * ball.radius
        self._step = mujoco.mj_step
        self._model = mujoco.MjModel.from_xml_string(_render_mjcf(ball, ground))
        self._data = mujoco.MjData(self._model)
        self._touches = False

    def gap(self, x: float, _y: float, z: float) -> float:
        """Return the distance of the ball's surface from the plane, m.

        Args:
            x: position of the centre along the slope direction, m.
            _y: unused.
            z: height of the centre, m.
        """
        return x * self._normal[0] + z * self._normal[1] - self._ball.radius

    def run(self, start: tuple[float, float, float], times: Array) -> Array:
        """Simulate from rest at a position, and return the centres at the sample times, (T, 3).

        Args:
            start: initial position of the centre, m.
            times: sample times, increasing from 0, s, (T,).
        """
        data = self._data
        last = float(times[-1])
        data.qpos[:3] = start
        rows = [(0.0, *start, 0.0, 0.0, 0.0)]
        while data.time < last:
            self._make_step()
            rows.append((data.time, *data.qpos[:3].tolist(), *data.qvel[:3].tolist()))
        return _interpolate_positions(np.array(rows), times)

    def _make_step(self) -> None:
        """Make one step, a short one if the ball touches the ground or soon will.

        At the begin of an impact the contact damping is set; it stays until the ball has left the
        ground.
        """
        data = self._data
        position = data.qpos[:3].tolist()
        velocity = data.qvel.tolist()
        gap = self.gap(*position)
        rate = velocity[0] * self._normal[0] + velocity[2] * self._normal[1]
        # Look two steps ahead: a step of flight must not penetrate the ground.
        is_near_impact = gap <= 0.0 or (rate < 0.0 and gap < -2.0 * _FLIGHT_STEP * rate)
        self._model.opt.timestep = _CONTACT_STEP if is_near_impact else _FLIGHT_STEP
        if gap > 0.0:
            self._touches = False
        # Set the damping once per impact, at its initial speed: restitution refers to the whole
        # impact.
        if not self._touches and rate < 0.0 and gap + rate * _CONTACT_STEP <= 0.0:
            self._set_contact_damping(-rate)
        self._apply_forces(velocity)
        self._step(self._model, data)

    def _set_contact_damping(self, speed: float) -> None:
        """Set the contact damping that gives the ball's restitution, for an impact at this speed.

        It also marks the begin of a contact (`_touches`), during which the damping stays constant.

        Args:
            speed: speed normal to the ground at the begin of the impact, m/s.
        """
        self._touches = True
        # Rounded, so that almost equal impacts share one cached result of `compute_damping_ratio`.
        restitution = round(self._ball.compute_restitution(speed), 9)
        ratio = compute_damping_ratio(restitution, _MAX_DAMPING_RATIO)
        # The contact of a spring lasts half of its period.
        frequency = math.pi / CONTACT_SECONDS
        # Two negative values of `solref` are -stiffness and -damping per unit mass. Geom 0 is the
        # ground and geom 1 the ball, whose values apply to their contact (priority 1).
        self._model.geom_solref[1] = -(frequency**2), -2.0 * ratio * frequency

    def _apply_forces(self, velocity: list[float]) -> None:
        """Apply drag (1), lift (2) and friction (5) as force and torque of the next step.

        Drag is -1/2 rho Cd A |v| v (1), and lift 1/2 rho A r omega x v (2), with the density rho of
        air, the cross section A and radius r of the ball, its velocity v and its spin omega.

        Args:
            velocity: velocity of the centre in m/s, and angular velocity in rad/s, (6,).
        """
        # The spin is in the ball's frame, which makes no difference for a spin about y.
        vx, vy, vz, wx, wy, wz = velocity
        # Forces are constant during the step, so they are evaluated at its midpoint.
        vz -= 0.5 * GRAVITY * self._model.opt.timestep
        pull = -self._drag * math.sqrt(vx * vx + vy * vy + vz * vz)
        force = [  # (1) and (2)
            pull * vx + self._lift * (wy * vz - wz * vy),
            pull * vy + self._lift * (wz * vx - wx * vz),
            pull * vz + self._lift * (wx * vy - wy * vx),
        ]
        torque = 0.0
        if self._data.ncon and self._friction > 0.0:
            friction = self._compute_friction(vx, vz, wy)
            force[0] += friction * self._normal[1]
            force[2] -= friction * self._normal[0]
            torque = -friction * self._ball.radius
        self._data.xfrc_applied[1] = (*force, 0.0, torque, 0.0)

    def _compute_friction(self, vx: float, vz: float, spin: float) -> float:
        """Return the Coulomb friction (5) on the ball, N, positive down the slope.

        It is limited to the force that stops the slip within the step, so that it does not reverse
        it.

        The force is at most the friction cone mu N and the force that stops the slip within a step
        h, |f| = min(mu N, k / (1 + k) m |slip| / h) (5), with the moment of inertia k m r^2.

        Args:
            vx: velocity along x, m/s.
            vz: upward velocity, m/s.
            spin: angular velocity about y, rad/s.
        """
        slip = vx * self._normal[1] - vz * self._normal[0] - spin * self._ball.radius
        k = self._ball.inertia_ratio
        stops = self._ball.mass * k / (1.0 + k) * abs(slip) / self._model.opt.timestep
        friction_limit = self._friction * float(self._data.efc_force[0])
        return -math.copysign(min(stops, friction_limit), slip)  # (5)


def _render_mjcf(ball: BallKind, ground: InclinedGround) -> str:
    """Render the MuJoCo model: an inclined plane, and a free sphere above it.

    Contacts are frictionless (``condim`` 1), because `_Flight` applies the friction. The moments of
    inertia are equal about all axes.

    Args:
        ball: properties of the ball.
        ground: inclined plane.
    """
    inertia = ball.inertia_ratio * ball.mass * ball.radius**2
    moments = f"{inertia!r} {inertia!r} {inertia!r}"
    return f"""
    <mujoco>
      <compiler angle="radian"/>
      <option gravity="0 0 {-GRAVITY}" integrator="RK4"/>
      <worldbody>
        <geom type="plane" size="0 0 1" euler="0 {ground.angle!r} 0" condim="1"/>
        <body>
          <freejoint/>
          <inertial pos="0 0 0" mass="{ball.mass!r}" diaginertia="{moments}"/>
          <geom type="sphere" size="{ball.radius!r}" condim="1" priority="1"
            solimp="{_CONTACT_IMPEDANCE} {_CONTACT_IMPEDANCE} 0.001 0.5 2"/>
        </body>
      </worldbody>
    </mujoco>"""


def _interpolate_positions(rows: Array, times: Array) -> Array:
    """Interpolate positions (T, 3) at the sample times by cubic Hermite splines between steps.

    Args:
        rows: Time, position and velocity after each step (S, 7).
        times: (T,) sample times, s.
    """
    from scipy.interpolate import CubicHermiteSpline

    path: Array = CubicHermiteSpline(rows[:, 0], rows[:, 1:4], rows[:, 4:7])(times)
    return path
