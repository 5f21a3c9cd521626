"""Tests that forces evaluated per step act at its midpoint: the error is of second order in the
step.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sims.core.simulator import Scenario
from sims.robot.dynamics.midpoint_state import compute_midpoint_loads
from tests.sims.robot.test_robot_motion import kind_of

MASS, LENGTH, SPIN = 0.8, 0.3, 0.001
PENDULUM = f"""
<mujoco>
  <option timestep="STEP" integrator="RK4"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0"/>
      <inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="{SPIN} {SPIN} {SPIN}"/>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="hinge"/></actuator>
</mujoco>
"""
TIMES = np.arange(0, 0.6, 0.02)
BEGINS = {"q.hinge": 0.2, "qd.hinge": 1.0}
COMMANDS = 2.5 + np.where(np.arange(TIMES.size) % 2, 0.8, -0.8)
"""Commands that jump at every sample without reversing the motion, since a standstill lowers the
order.
"""
EFFECTS = {
    "friction.load@hinge": (0.2,),
    "friction.position@hinge": (0.1, 0.15, -0.1, 0.7),
    "friction.warming@hinge": (0.3, 0.05, 0.2),
}


def limit(name, c, t, q, v, u):
    """Return the friction limit of the effect, as its source states it."""
    if name.startswith("friction.load"):
        return c[0] * abs(u + MASS * 9.81 * LENGTH * np.sin(q))
    if name.startswith("friction.position"):
        angle = 2 * np.pi * q / c[3]
        return c[0] + np.hypot(c[1], c[2]) + c[1] * np.sin(angle) + c[2] * np.cos(angle)
    return (c[0] + c[1] * abs(v)) * np.exp(-t / c[2])


def exact(name, c):
    """Return the angles at `TIMES`, from an ODE solver restarted at every command."""

    def rate(t, y, u):
        q, v = y
        force = u - MASS * 9.81 * LENGTH * np.sin(q) - np.sign(v) * limit(name, c, t, q, v, u)
        return v, force / (MASS * LENGTH**2 + SPIN)

    y, rows = np.array(list(BEGINS.values())), []
    for k, u in enumerate(COMMANDS):
        rows.append(y[0])
        assert y[1] > 0.2, "it goes on"
        span = TIMES[k], TIMES[k] + 0.02
        y = solve_ivp(rate, span, y, args=(u,), rtol=1e-11, atol=1e-12).y[:, -1]
    return np.array(rows)


def off(name, c, step):
    """Return the largest error of the simulated angle, rad."""
    kind = kind_of(PENDULUM.replace("STEP", str(step)))
    simulator = kind(observe=["q.hinge"], effects=[kind.system.effect(name)])
    given = {c.name: np.zeros(TIMES.size) for c in simulator.inputs}
    given["u.m"] = COMMANDS
    run = Scenario(TIMES, BEGINS, given)
    seen = simulator.simulate(np.array([c]), run)[0][:, 0]
    return np.abs(seen - exact(name, c)).max()


@pytest.mark.parametrize("name", EFFECTS)
def test_half_the_step_makes_a_quarter_of_the_error(name):
    coarse, fine = (off(name, EFFECTS[name], step) for step in (0.004, 0.002))
    # First order would give one half; the error is near zero where the motion is followed exactly.
    assert fine < 0.3 * coarse
    assert coarse < 3e-4


def test_what_a_drive_carries_in_the_middle_of_steps_knows_jumps_from_growth():
    # end of step k: the command plus an increase of 2 per step
    commands = np.array([0.0, 0.0, 5.0, 5.0, 5.0])[:, None]
    ended = np.stack([commands + 2.0 * np.arange(1.0, 6.0)[:, None]] * 2)
    expected = commands + 2.0 * (np.arange(5.0)[:, None] + 0.5)
    np.testing.assert_allclose(compute_midpoint_loads(ended, commands), np.stack([expected] * 2))
