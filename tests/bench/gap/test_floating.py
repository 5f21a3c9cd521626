"""Recordings of a robot that floats."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.gap.explain import explain
from sims.base import InputError

MODEL = """<mujoco model="satellite">
  <option timestep="0.004" gravity="0 0 0" integrator="RK4"/>
  <worldbody>
    <body name="hull" pos="0 0 1">
      <freejoint name="base"/>
      <inertial pos="0 0 0" mass="5" diaginertia="0.2 0.25 0.3"/>
      <body name="panel" pos="0.3 0 0">
        <joint name="boom" type="hinge" axis="0 0 1" damping="0.02"/>
        <inertial pos="0.25 0 0" mass="1" diaginertia="0.002 0.03 0.03"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="m_boom" joint="boom"/></actuator>
</mujoco>
"""
HULL, PANEL = (5.0, 0.3, 0.3), (1.0, 0.03, 0.25)
"""Mass, moment about the centre of mass, and how far that is from the hinge."""
TRUE = 0.05
"""N m s/rad of drag that the file lacks."""
SPINS = (0.8, -0.5, 0.3)
"""rad/s of the hull as each run begins."""
TOML = """model = "satellite.xml"
[channels."q.boom"]
unit = "rad"
noise = 0.001
[inputs."u.m_boom"]
unit = "N*m"
hold = "linear"
[runs.2]
held_out = true
"""


def command(run, t):
    return 0.12 * np.sin((2.0 + run) * t) + 0.05 * np.cos(5.0 * t)


def motion(run, times):
    """(T,) angle of the boom: two bodies in a plane whose common centre of mass rests, by Lagrange.

    With turns a of the hull and b of the panel, m = m1 m2 / (m1 + m2) and e the unit vectors along
    the bodies, the kinetic energy is I1 a'^2 / 2 + I2 b'^2 / 2 + m |r1 a' e1 + r2 b' e2|^2 / 2.
    """
    (m1, i1, r1), (m2, i2, r2) = HULL, PANEL
    m = m1 * m2 / (m1 + m2)

    def rates(t, state):
        a, b, va, vb = state
        cross = m * r1 * r2 * np.cos(a - b)
        inertia = np.array([[i1 + m * r1**2, cross], [cross, i2 + m * r2**2]])
        turning = m * r1 * r2 * np.sin(a - b) * np.array([-(vb**2), va**2])
        torque = command(run, t) - (0.02 + TRUE) * (vb - va)
        return [va, vb, *np.linalg.solve(inertia, turning + torque * np.array([-1.0, 1.0]))]

    begin = [0.0, 0.0, SPINS[run], SPINS[run]]
    made = solve_ivp(rates, (0.0, times[-1]), begin, "DOP853", times, rtol=1e-9, atol=1e-10)
    return made.y[1] - made.y[0]


def recorded(tmp_path, stated=True):
    times = np.arange(0.0, 3.0, 0.02)
    rng = np.random.default_rng(4)
    lines = ["run,t,u.m_boom,q.boom"]
    for run in range(3):
        seen = motion(run, times) + rng.normal(0.0, 1e-3, times.size)
        columns = zip(times, command(run, times), seen, strict=True)
        lines += [f"{run},{t:.9g},{u:.9g},{q:.9g}" for t, u, q in columns]
    begins = [f'[runs.{k}.initial]\n"qd.base.wz" = {spin}\n' for k, spin in enumerate(SPINS)]
    (tmp_path / "satellite.xml").write_text(MODEL)
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "log.toml").write_text(TOML + "".join(begins if stated else ()))
    return tmp_path / "log.csv"


def test_pieces_of_what_floats_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"log\.csv: expected no --pieces: .* leave it out"):
        explain(recorded(tmp_path), pieces=1.0)
