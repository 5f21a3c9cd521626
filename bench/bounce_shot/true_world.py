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
from sims.engines.external.mujoco_ball_contact import compute_damping_ratio

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
        """Build the MuJoCo model, and compute the constant factors of the forces.

        * `_drag` and `_lift`: the factors of |v| v in the drag -1/2 rho Cd A |v| v (1), and of
          omega x v in the lift 1/2 rho A r omega x v (2), with the density rho of the air, the
          cross section A, radius r, velocity v and spin omega of the ball.
        * `_normal`: x and z component of the unit vector normal to the ground.
        * `_touches`: whether the ball is in contact.

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
            x: position of the centre along the horizontal direction of descent, m.
            _y: unused, so that a position can be unpacked.
            z: height of the centre, m.
        """
        normal_x, normal_z = self._normal
        return x * normal_x + z * normal_z - self._ball.radius

    def run(self, start: tuple[float, float, float], times: Array) -> Array:
        """Simulate from rest at a position, and return the centres at the sample times, (T, 3).

        Args:
            start: initial position of the centre, m.
            times: sample times, increasing from 0, s, (T,).
        """
        data = self._data
        data.qpos[:3] = start
        # Time, position and velocity of the centre after each step.
        steps = [(0.0, *start, 0.0, 0.0, 0.0)]
        last_time = float(times[-1])
        while data.time < last_time:
            self._make_step()
            steps.append((data.time, *data.qpos[:3].tolist(), *data.qvel[:3].tolist()))
        return _interpolate_positions(np.array(steps), times)

    def _make_step(self) -> None:
        """Make one step, a short one if the ball touches the ground or soon will.

        At the beginning of an impact the contact damping is set; it stays until the ball has left
        the ground.
        """
        data = self._data
        gap = self.gap(*data.qpos[:3].tolist())
        velocity = data.qvel.tolist()
        vx, _, vz, *_ = velocity
        normal_x, normal_z = self._normal
        # Rate of the gap, m/s; negative if the ball approaches the ground.
        rate = vx * normal_x + vz * normal_z
        # Look two steps ahead: a step of flight must not penetrate the ground.
        is_near_impact = gap <= 0.0 or (rate < 0.0 and gap < -2.0 * _FLIGHT_STEP * rate)
        self._model.opt.timestep = _CONTACT_STEP if is_near_impact else _FLIGHT_STEP
        if gap > 0.0:
            self._touches = False
        # Set the damping once per impact, just before the contact, since restitution refers to the
        # speed at which the impact begins.
        if not self._touches and rate < 0.0 and gap + rate * _CONTACT_STEP <= 0.0:
            self._set_contact_damping(-rate)
        self._apply_forces(velocity)
        self._step(self._model, data)

    def _set_contact_damping(self, speed: float) -> None:
        """Set the contact damping that gives the ball's restitution, for an impact at this speed.

        It also marks the beginning of a contact (`_touches`), during which the damping stays
        constant.

        Args:
            speed: speed normal to the ground at the beginning of the impact, m/s.
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
        """Apply drag, lift and friction as force and torque of the next step.

        Drag is -1/2 rho Cd A |v| v (1), and lift 1/2 rho A r omega x v (2), with the density rho of
        air, the drag coefficient Cd, the cross section A and radius r of the ball, its velocity v
        and its spin omega. Friction acts in contact only.

        Args:
            velocity: velocity of the centre in m/s, and angular velocity in rad/s, (6,).
        """
        # The spin is in the ball's frame, which makes no difference for a spin about y.
        vx, vy, vz, wx, wy, wz = velocity
        # Forces are constant during the step, so they are evaluated at its midpoint.
        vz -= 0.5 * GRAVITY * self._model.opt.timestep
        drag = -self._drag * math.sqrt(vx * vx + vy * vy + vz * vz)
        fx = drag * vx + self._lift * (wy * vz - wz * vy)
        fy = drag * vy + self._lift * (wz * vx - wx * vz)
        fz = drag * vz + self._lift * (wx * vy - wy * vx)
        torque = 0.0  # about y, the horizontal direction across the slope
        if self._data.ncon and self._friction > 0.0:
            friction = self._compute_friction(vx, vz, wy)
            normal_x, normal_z = self._normal
            fx += friction * normal_z
            fz -= friction * normal_x
            torque = -friction * self._ball.radius
        # Body 0 is the world, body 1 the ball.
        self._data.xfrc_applied[1] = (fx, fy, fz, 0.0, torque, 0.0)

    def _compute_friction(self, vx: float, vz: float, spin: float) -> float:
        """Return the Coulomb friction on the ball, N, positive down the slope.

        It is |f| = min(mu N, k / (1 + k) m |slip| / h) (5), with the coefficient of friction mu,
        the normal force N, mass m and moment of inertia k m r^2 of the ball, and the time step h.
        The second term is the force that stops the slip within the step; a larger one would
        reverse it.

        Args:
            vx: velocity along x, m/s.
            vz: upward velocity, m/s.
            spin: angular velocity about y, rad/s.
        """
        normal_x, normal_z = self._normal
        # Velocity of the ball's surface at the contact, down the slope.
        slip = vx * normal_z - vz * normal_x - spin * self._ball.radius
        k = self._ball.inertia_ratio
        stopping_force = self._ball.mass * k / (1.0 + k) * abs(slip) / self._model.opt.timestep
        # The only constraint of the model is the contact.
        friction_limit = self._friction * float(self._data.efc_force[0])
        return -math.copysign(min(stopping_force, friction_limit), slip)


def _render_mjcf(ball: BallKind, ground: InclinedGround) -> str:
    """Render the MuJoCo model (MJCF): an inclined plane, and a free sphere above it.

    Contacts are frictionless (``condim`` 1), because `_Flight` applies the friction. The parameters
    of a contact are those of the sphere (``priority`` 1). The moments of inertia are equal about
    all axes.

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
        rows: Time, position and velocity after each of S steps (S, 7).
        times: (T,) sample times, s.
    """
    from scipy.interpolate import CubicHermiteSpline

    path: Array = CubicHermiteSpline(rows[:, 0], rows[:, 1:4], rows[:, 4:7])(times)
    return path
