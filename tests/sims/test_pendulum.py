"""Tests of the pendulum in Bullet and MuJoCo: damping, energy and high speeds.

`test_engines` compares its motion, with each effect, with that of the batch engine.
"""

import numpy as np
import pytest

from sims.core.simulator import Scenario
from sims.systems.pendulum import Pendulum

MASS, LENGTH, GRAVITY = 0.15, 0.15, 9.81
WEIGHT = MASS * LENGTH * GRAVITY  # N*m at the horizontal
INERTIA = 3.3e-3


@pytest.fixture(params=["pybullet", "mujoco"], autouse=True)
def engine(request, monkeypatch):
    monkeypatch.setattr(Pendulum, "default_engine", request.param)
    return request.param


def swing(scenario, damping=0.0, constants=None, fixed=None):
    """Return q and qd, each (T,)."""
    fixed = {**(fixed or {}), **({"drag.linear": damping} if damping else {})}
    return Pendulum(constants, fixed=fixed).simulate(np.array([[INERTIA]]), scenario)[0].T


def test_damping_carried_by_the_joint_is_damping_put_in_from_outside():
    # With a second effect the engine evaluates forces at every step; its coefficient is too small
    # to change the motion.
    scenario = Scenario(
        np.arange(200) / 100, {"q": 1.5}, {"u": 0.05 * np.sign(np.sin(3.0 * np.arange(200) / 100))}
    )
    carried = swing(scenario, damping=1e-3)
    known = swing(scenario, damping=1e-3, fixed={"drag.quadratic": 1e-300})
    asked = swing(scenario, damping=1e-3, fixed={"spring.linear": 1e-300})
    np.testing.assert_allclose(known, carried, atol=1e-10)
    np.testing.assert_allclose(asked, carried, atol=1e-9)


def test_strong_damping_is_stable():
    # Steps of 2.5 ms at a time constant of 0.33 ms: explicit damping would diverge.
    times = np.arange(200) / 100
    q, qd = swing(Scenario(times, {"q": 1.0}), damping=10.0, fixed={"drag.quadratic": 1e-300})
    np.testing.assert_allclose(
        q, 2.0 * np.arctan(np.tan(0.5) * np.exp(-WEIGHT / 10.0 * times)), atol=1e-4
    )
    assert np.abs(qd).max() < 0.05


def test_energy_does_not_drift():
    times = np.arange(4000) / 200
    q, qd = swing(Scenario(times, {"q": 2.0}))
    energy = INERTIA * qd**2 / 2 + WEIGHT * (1 - np.cos(q))
    assert np.abs(energy / energy[0] - 1).max() < 5e-4
    assert abs(energy[-400:].mean() / energy[:400].mean() - 1) < 2e-6


def test_whirling_is_not_limited():
    q, qd = swing(
        Scenario(np.arange(100) * 0.01, {"q": 0.0, "qd": 300.0}), constants={"gravity": 0.0}
    )
    np.testing.assert_allclose(qd, 300.0, rtol=1e-12)
    assert q[-1] == pytest.approx(297.0, rel=1e-12)
