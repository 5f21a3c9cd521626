"""Tests of the pendulum in Bullet and MuJoCo against closed forms and an accurate integrator.

`test_engines` compares its motion, with each effect, with that of the batch engine.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from sims.core.simulator import Scenario
from sims.systems.pendulum import Pendulum

MASS, LENGTH, GRAVITY = 0.15, 0.15, 9.81
WEIGHT = MASS * LENGTH * GRAVITY  # N*m at the horizontal
INERTIA = 3.3e-3
OMEGA = (WEIGHT / INERTIA) ** 0.5


@pytest.fixture(params=["pybullet", "mujoco"], autouse=True)
def engine(request, monkeypatch):
    monkeypatch.setattr(Pendulum, "default_engine", request.param)
    return request.param


def swing(scenario, inertia=INERTIA, damping=0.0, constants=None, fixed=None, **settings):
    """Return q and qd, each (T,)."""
    fixed = {**(fixed or {}), **({"drag.linear": damping} if damping else {})}
    return (
        Pendulum(constants, fixed=fixed, **settings).simulate(np.array([[inertia]]), scenario)[0].T
    )


def exact(times, q, qd, inertia=INERTIA, damping=0.0, torque=lambda _: 0.0, quadratic=0.0):
    def law(t, state):
        resistance = damping + quadratic * abs(state[1])
        return [state[1], (torque(t) - WEIGHT * np.sin(state[0]) - resistance * state[1]) / inertia]

    options = {"rtol": 1e-9, "atol": 1e-11, "max_step": 0.02}
    return solve_ivp(law, (times[0], times[-1]), [q, qd], t_eval=times, **options).y


def period(times, q):
    """Return the mean period from the upward zero crossings, located by linear interpolation."""
    i = np.flatnonzero((q[:-1] < 0) & (q[1:] >= 0))
    crossings = times[i] - q[i] * (times[i + 1] - times[i]) / (q[i + 1] - q[i])
    return (crossings[-1] - crossings[0]) / (len(crossings) - 1)


def order(steps, errors):
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]


@pytest.mark.parametrize(("amplitude", "length"), [(1e-3, 1.0), (0.5, 1.0), (1.6, 1.0), (3.0, 2.0)])
def test_period_follows_the_elliptic_integral(amplitude, length):
    times = np.arange(2000) * 2e-3
    q, _ = swing(Scenario(times, {"q": amplitude}), time_step=5e-4)
    expected = 4 / OMEGA * ellipk(np.sin(amplitude / 2) ** 2)
    assert period(times, q) == pytest.approx(expected, rel=2e-5)
    if amplitude == 1e-3:
        assert expected == pytest.approx(2 * np.pi / OMEGA, rel=1e-6)


@pytest.mark.parametrize("inertia", [1e-3, 2e-3, 3.3e-3, 1e-2])
def test_inertia_below_mass_length_squared_works_too(inertia):
    times = np.arange(2000) * 2e-3
    q, _ = swing(Scenario(times, {"q": 1e-3}), inertia=inertia, time_step=5e-4)
    assert period(times, q) == pytest.approx(2 * np.pi * (inertia / WEIGHT) ** 0.5, rel=2e-5)


@pytest.mark.parametrize("damping", [0.0, 2e-3])
@pytest.mark.parametrize("torque", [0.0, 0.1])
def test_second_order_in_the_step_with_damping_and_torque(damping, torque):
    times = np.array([0.0, 0.13, 0.5, 1.0])  # uneven: the step differs between intervals
    scenario = Scenario(times, {"q": 1.5, "qd": -2.0}, {"u": np.full(4, torque)})
    reference = exact(times, 1.5, -2.0, damping=damping, torque=lambda _: torque)
    steps = np.array([8e-3, 4e-3, 2e-3, 1e-3])
    errors = np.array(
        [
            np.abs(swing(scenario, damping=damping, time_step=h) - reference).max(axis=1)
            for h in steps
        ]
    )
    for channel in (0, 1):
        assert order(steps, errors[:, channel]) == pytest.approx(2.0, abs=0.1)


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
