"""Tests of the arm against the textbook equations of motion of a two-link arm, solved by SciPy."""

import copy
import importlib.util

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.core.plugin_registries import simulators
from sims.core.simulator import Scenario
from sims.systems.two_link_arm import TwoLinkArm

pytest.importorskip("pybullet")

TIMES = np.arange(100) / 50
FREE = np.array([1.0, 0.8, 0.2, 0.17, 0.0, 0.0, 0.0, 0.0])
DAMPED = np.array([0.7, 1.1, 0.25, 0.14, 0.15, 0.06, 0.0, 0.0])
RUBBING = np.array([1.0, 0.8, 0.2, 0.17, 0.1, 0.05, 0.2, 0.1])
START = {"q1": 1.0, "q2": -0.6, "qd1": 0.5, "qd2": -1.0}


def matrix(theta, k, q2):
    """Return the inertia matrix (Spong, Hutchinson, Vidyasagar 2006, equation 7.87)."""
    m1, m2, c1, c2 = theta[:4]
    cross, second = m2 * k["length"] * c2 * np.cos(q2), k["inertia2"] + m2 * c2**2
    first = k["inertia1"] + m1 * c1**2 + m2 * k["length"] ** 2 + second + 2 * cross
    return np.array([[first, second + cross], [second + cross, second]])


def solved(theta, k, torques, start, times, sharpness=1e-5):
    m1, m2, c1, c2, d1, d2, f1, f2 = theta

    def rates(t, y):
        q1, q2, w1, w2 = y
        turn = m2 * k["length"] * c2 * np.sin(q2)
        coriolis = np.array([-turn * (2 * w1 * w2 + w2**2), turn * w1**2])
        outer = m2 * c2 * k["gravity"] * np.sin(q1 + q2)
        gravity = np.array(
            [(m1 * c1 + m2 * k["length"]) * k["gravity"] * np.sin(q1) + outer, outer]
        )
        dry = np.array([f1 * np.tanh(w1 / sharpness), f2 * np.tanh(w2 / sharpness)])
        torque = np.array(torques(t)) - np.array([d1 * w1, d2 * w2]) - dry - coriolis - gravity
        return [w1, w2, *np.linalg.solve(matrix(theta, k, q2), torque)]

    method = "Radau" if f1 or f2 else "DOP853"
    found = solve_ivp(
        rates, (0, times[-1]), list(start.values()), method, times, rtol=1e-9, atol=1e-10
    )
    return found.y.T


def error(theta, torques, time_step=None, constants=None):
    arm = TwoLinkArm(constants, **({} if time_step is None else {"time_step": time_step}))
    inputs = {f"u{i + 1}": np.full(TIMES.size, torque) for i, torque in enumerate(torques)}
    seen = arm.simulate(theta[None], Scenario(TIMES, START, inputs))[0]
    reference = solved(theta, arm.constant_values, lambda t: torques, START, TIMES)
    return np.abs(seen - reference)[:, :2].max()


@pytest.mark.parametrize(
    ("theta", "torques", "tolerance"),
    [(FREE, (0.0, 0.0), 3e-3), (DAMPED, (3.0, -1.0), 5e-4), (RUBBING, (3.0, 0.5), 1e-3)],
    ids=["free", "damped", "rubbing"],
)
def test_equations_of_motion(theta, torques, tolerance):
    assert error(theta, torques) < tolerance


def test_other_constants_are_used():
    other = {"length": 0.3, "inertia1": 0.02, "inertia2": 0.03, "gravity": 3.7}
    assert error(DAMPED, (1.0, 0.3), constants=other) < 5e-4


def test_order_in_the_step_is_second():
    errors = [error(DAMPED, (3.0, -1.0), step) for step in (1 / 100, 1 / 200, 1 / 400)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 2.0, atol=0.15)


def test_dry_friction_holds_what_pulls_less():
    theta = FREE.copy()
    theta[6:] = 0.5, 0.5
    start = {
        "q1": 0.05,
        "q2": 0.05,
    }  # gravity torque is at most 0.34 N m on joint 1, 0.13 on joint 2
    seen = TwoLinkArm().simulate(theta[None], Scenario(TIMES, start))[0]
    np.testing.assert_allclose(seen[:, :2], 0.05, atol=1e-12)
    theta[6] = 0.3
    assert abs(TwoLinkArm().simulate(theta[None], Scenario(TIMES, start))[0, -1, 0] - 0.05) > 1e-4


def test_a_copy_has_a_world_of_its_own():
    arm, scenario = TwoLinkArm(), Scenario(TIMES, START)
    before = arm.simulate(RUBBING[None], scenario)
    other = copy.deepcopy(arm)
    arm.close()
    np.testing.assert_array_equal(other.simulate(RUBBING[None], scenario), before)


def test_without_pybullet_it_is_listed_as_skipped(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "pybullet" else find(name)
    )
    assert (
        simulators.describe("arm")
        == "skipped: needs pybullet, not installed (pip install pybullet)"
    )
