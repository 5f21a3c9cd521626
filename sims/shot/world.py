"""The world in which shots are made: MuJoCo, with physics that the planning simulator lacks.

A free rigid sphere flies through still air with quadratic drag, 1/2 rho Cd A v^2, and the lift of
its spin, 1/2 rho A r omega x v (C_L = r omega / v; G. Robinson, I. Robinson, Physica Scripta 88,
018101, 2013, doi:10.1088/0031-8949/88/01/018101), by MuJoCo's fourth-order integrator. Contact
takes time: MuJoCo's spring and damper between ball and ground act for about `CONTACT` seconds,
damped for the restitution at that impact's speed (T. Schwager, T. Poeschel, Phys. Rev. E 78,
051304, 2008, doi:10.1103/PhysRevE.78.051304: contact ends when the force does). MuJoCo's friction
is a convex relaxation that turns slip into lift, so contact is frictionless there, and Coulomb's
friction acts from step to step with the normal force that MuJoCo reports: the ball slides until it
grips, and spins.
"""

from __future__ import annotations

import functools
import importlib.util
import math
from dataclasses import dataclass

import numpy as np

from sims.base import Array, InputError
from sims.shot.balls import Ball

AIR = 1.2  # kg/m^3
GRAVITY = 9.81
CONTACT = 3e-3  # seconds: tennis balls stay for 5 ms, golf balls for 0.5 ms
_FLIGHT, _IMPACT = 1e-3, 3e-5  # seconds: steps
_IMPEDANCE = 0.9999  # the largest MuJoCo allows


def missing() -> str:
    """Why this world cannot be had here; empty if it can."""
    return (
        ""
        if importlib.util.find_spec("mujoco")
        else "the world needs mujoco, not installed (pip install mujoco)"
    )


@dataclass(frozen=True)
class Ground:
    """What the ball falls on, a plane through the origin: its angle in radians, falling towards x,
    and friction.
    """

    angle: float = 0.0
    friction: float = 0.3


def fly(
    ball: Ball, ground: Ground, start: tuple[float, float, float], times: Array, air: float = AIR
) -> Array:
    """The path of a ball let go at rest.

    Args:
        ball: what flies.
        ground: what it strikes.
        start: its centre, m; above the plane.
        times: (T,) seconds, increasing from 0.
        air: density, kg/m^3.

    Returns:
        Centres (T, 3), m.

    Raises:
        InputError: MuJoCo is missing, or the ball begins in the ground.
    """
    if reason := missing():
        raise InputError(reason)
    flight = _Flight(ball, ground, air)
    if flight.gap(*start) <= 0:
        raise InputError(f"expected a ball above the ground, found its centre at {start}")
    return flight.run(start, times)


@functools.cache
def damping_ratio(restitution: float) -> float:
    """Damping ratio of a spring and damper that end their contact with this restitution, 0 < e <=
    1.
    """
    low, high = 0.0, 60.0
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _restitution(middle) > restitution else (low, middle)
    return 0.5 * (low + high)


def _restitution(ratio: float) -> float:
    """Schwager and Poeschel's Eq. (12), for contact that ends when the force does."""
    if ratio == 0.0 or abs(ratio - 1.0) < 1e-9:
        return 1.0 if ratio == 0.0 else math.exp(-2.0)
    if ratio < 1.0:
        w = math.sqrt(1.0 - ratio * ratio)
        return math.exp(-ratio / w * math.atan2(2.0 * ratio * w, 2.0 * ratio * ratio - 1.0))
    s = math.sqrt(ratio * ratio - 1.0)
    return math.exp(-ratio / s * math.log((ratio + s) / (ratio - s)))


class _Flight:
    def __init__(self, ball: Ball, ground: Ground, air: float) -> None:
        import mujoco

        self._ball, self._friction = ball, ground.friction
        self._normal = math.sin(ground.angle), math.cos(ground.angle)
        area = math.pi * ball.radius**2
        self._drag = 0.5 * air * ball.drag * area
        self._lift = 0.5 * air * area * ball.radius
        self._step = mujoco.mj_step
        self._model = mujoco.MjModel.from_xml_string(_mjcf(ball, ground))
        self._data = mujoco.MjData(self._model)
        self._touches = False

    def gap(self, x: float, _y: float, z: float) -> float:
        """Distance of the ball's surface from the plane."""
        return x * self._normal[0] + z * self._normal[1] - self._ball.radius

    def run(self, start: tuple[float, float, float], times: Array) -> Array:
        data, last = self._data, float(times[-1])
        data.qpos[:3] = start
        rows = [(0.0, *start, 0.0, 0.0, 0.0)]
        while data.time < last:
            self._advance()
            rows.append((data.time, *data.qpos[:3].tolist(), *data.qvel[:3].tolist()))
        return _sampled(np.array(rows), times)

    def _advance(self) -> None:
        """One step, short where the ball touches or soon will."""
        data = self._data
        position, velocity = data.qpos[:3].tolist(), data.qvel.tolist()
        gap, rate = (
            self.gap(*position),
            velocity[0] * self._normal[0] + velocity[2] * self._normal[1],
        )
        near = gap <= 0.0 or (rate < 0.0 and gap < -2.0 * _FLIGHT * rate)
        self._model.opt.timestep = _IMPACT if near else _FLIGHT
        if gap > 0.0:
            self._touches = False
        if not self._touches and rate < 0.0 and gap + rate * _IMPACT <= 0.0:
            self._prepare(-rate)
        self._push(velocity)
        self._step(self._model, data)

    def _prepare(self, speed: float) -> None:
        """The damping of an impact at this speed."""
        self._touches = True
        ratio = damping_ratio(round(self._ball.restitution_at(speed), 9))
        frequency = math.pi / CONTACT
        self._model.geom_solref[1] = -(frequency**2), -2.0 * ratio * frequency

    def _push(self, velocity: list[float]) -> None:
        """Drag, lift and friction as the force and torque of the coming step."""
        vx, vy, vz, wx, wy, wz = (
            velocity  # spin in the ball's frame, which does not matter for a spin about y
        )
        vz -= (
            0.5 * GRAVITY * self._model.opt.timestep
        )  # held through the step, so taken from its middle
        pull = -self._drag * math.sqrt(vx * vx + vy * vy + vz * vz)
        force = [
            pull * vx + self._lift * (wy * vz - wz * vy),
            pull * vy + self._lift * (wz * vx - wx * vz),
            pull * vz + self._lift * (wx * vy - wy * vx),
        ]
        torque = 0.0
        if self._data.ncon and self._friction > 0.0:
            rub = self._rub(vx, vz, wy)
            force[0] += rub * self._normal[1]
            force[2] -= rub * self._normal[0]
            torque = -rub * self._ball.radius
        self._data.xfrc_applied[1] = (*force, 0.0, torque, 0.0)

    def _rub(self, vx: float, vz: float, spin: float) -> float:
        """Coulomb's friction down the slope, N: no more than stops the slip within the step."""
        slip = vx * self._normal[1] - vz * self._normal[0] - spin * self._ball.radius
        k = self._ball.inertia_ratio
        stops = self._ball.mass * k / (1.0 + k) * abs(slip) / self._model.opt.timestep
        held = self._friction * float(self._data.efc_force[0])
        return -math.copysign(min(stops, held), slip)


def _mjcf(ball: Ball, ground: Ground) -> str:
    inertia = ball.inertia_ratio * ball.mass * ball.radius**2
    return f"""
    <mujoco>
      <compiler angle="radian"/>
      <option gravity="0 0 {-GRAVITY}" integrator="RK4"/>
      <worldbody>
        <geom type="plane" size="0 0 1" euler="0 {ground.angle!r} 0" condim="1"/>
        <body>
          <freejoint/>
          <inertial pos="0 0 0" mass="{ball.mass!r}" diaginertia="{inertia!r} {inertia!r} {inertia!r}"/>
          <geom type="sphere" size="{ball.radius!r}" condim="1" priority="1"
            solimp="{_IMPEDANCE} {_IMPEDANCE} 0.001 0.5 2"/>
        </body>
      </worldbody>
    </mujoco>"""


def _sampled(rows: Array, times: Array) -> Array:
    """Positions (T, 3) at the sample times from rows of time, position, velocity, by cubics between
    steps.
    """
    from scipy.interpolate import CubicHermiteSpline

    path: Array = CubicHermiteSpline(rows[:, 0], rows[:, 1:4], rows[:, 4:7])(times)
    return path
