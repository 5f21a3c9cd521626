"""Tests of an elastic joint whose drive inertia the model file lacks, with matrix exponentials.

The inertia of the drive is found first, then the compliance on the load side.
"""

import numpy as np
import pytest
from scipy.linalg import expm

from bench.diagnosis.explain import explain
from tests.bench.diagnosis.simulated_logs import write_log

WHEEL = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="RK4" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="wheel">
      <joint name="axle" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.08 0.08 0.08"/>
    </body>
  </worldbody>
  <actuator><motor name="m_axle" joint="axle"/></actuator>
</mujoco>
"""
TOML = """
model = "wheel.xml"
[inputs."u.m_axle"]
unit = "N*m"
[channels."q.axle"]
unit = "rad"
noise = 0.001
[runs.4]
held_out = true
"""
LINK, ROTOR, STIFF, DAMPED = 0.08, 0.002, 30.0, 0.02  # kg m^2, N m/rad, N m s/rad
TIMES = np.arange(151) / 100.0


def turned(torque):
    """Return (T,) angles of the drive side from rest; torques are held between samples."""
    spring = np.array([STIFF, DAMPED])
    rates = np.zeros((5, 5))
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1, [0, 1]], rates[1, [2, 3]] = -spring / ROTOR, spring / ROTOR
    rates[3, [0, 1]], rates[3, [2, 3]] = spring / LINK, -spring / LINK
    rates[1, 4] = 1.0 / ROTOR
    step, state, seen = expm(rates * 0.01), np.zeros(5), []
    for u in torque:
        seen.append(state[0])
        state[4] = u
        state = step @ state
    return np.array(seen)


def log(folder):
    rng, runs = np.random.default_rng(4), []
    for _ in range(4):
        torque = np.repeat(rng.uniform(-1, 1, 16), 10)[: TIMES.size]
        runs.append((TIMES, torque, turned(torque) + 0.001 * rng.standard_normal(TIMES.size)))
    return write_log(folder, TOML, "u.m_axle,q.axle", runs, wheel=WHEEL)


@pytest.mark.slow
def test_a_spring_is_found_behind_a_drive_that_weighs_more_than_it_gives(tmp_path):
    explained = explain(log(tmp_path))
    assert explained.answer.verdict == "named"
    (cause,) = explained.answer.causes
    assert (cause.effect, cause.alternatives) == ("joint.flexibility@axle", ())
    found = cause.coefficients
    assert found["compliance"].value == pytest.approx(1 / STIFF, rel=0.02)
    assert found["rotor"].value == pytest.approx(ROTOR / LINK, rel=0.05)
