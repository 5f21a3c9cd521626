"""Tests of first states with settled contacts, against MuJoCo's contact law in closed form."""

import numpy as np
import pytest

from sims.core.simulator import Scenario
from sims.robot.dynamics.contact_equilibrium import (
    ContactModel,
    _compute_cost,
    _Contact,
    settle_contacts,
)
from sims.robot.dynamics.linearisation_about_simulation import RunLinearisation
from sims.robot.parsing.read_model_file import read_robot
from sims.robot.robot_simulator import make_robot_simulator

GRAVITY, MASS, RADIUS, INERTIA = 9.81, 2.0, 0.1, 0.006
WHEEL = f"""
<mujoco model="wheel">
  <option timestep="0.001" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="wheel" pos="0 0 {RADIUS}">
      <inertial pos="0 0 0" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="spin" axis="0 1 0"/>
      <geom name="rim" size="{RADIUS}" solref="0.02 1" solimp="0.9 0.9 0.001"
        priority="1"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="spin"/></actuator>
</mujoco>
"""
IMPEDANCE, TIME_CONSTANT = 0.9, 0.02
STIFFNESS = 1.0 / (IMPEDANCE * TIME_CONSTANT**2)
DAMPING = 2.0 / (IMPEDANCE * TIME_CONSTANT)
"""Reference acceleration of the contact by depth and by speed (MuJoCo's documentation)."""
REGULARISATION = (1.0 - IMPEDANCE) / IMPEDANCE * 2.0 / (3.0 * MASS)
"""Creep acceleration by force: MuJoCo takes the mean inverse mass, and sideways it is zero."""
DEPTH = MASS * GRAVITY * REGULARISATION / STIFFNESS
SIGMA = np.full(3, 1e-3), np.full(3, 0.1)


@pytest.fixture
def simulator(tmp_path):
    (tmp_path / "wheel.xml").write_text(WHEEL)
    kind = make_robot_simulator(read_robot(tmp_path / "wheel.xml")).with_contacts(("floor/rim",))
    return kind(observe=["q.x", "q.z", "q.spin"])


def settle(simulator, scenario, measured, **options):
    model = ContactModel(simulator, np.zeros(0))
    return settle_contacts(model, scenario, measured, SIGMA, **options)


def make_scenario(torque=0.0):
    times = np.arange(21) / 100.0
    return Scenario(times, {}, {"u.drive": np.full(times.size, torque)})


@pytest.mark.parametrize("height", [2e-3, 1e-6, -2e-3])
def test_a_wheel_at_rest_gets_the_depth_of_its_weight(simulator, height):
    measured = np.array([0.3, height, 0.5]), np.array([0.0, 0.02, 0.0])
    x, v = settle(simulator, make_scenario(), measured)
    assert x[1] == pytest.approx(-DEPTH, rel=0.03)
    np.testing.assert_allclose(x[[0, 2]], measured[0][[0, 2]], atol=1e-6)
    np.testing.assert_allclose(v, 0.0, atol=1e-4)


def test_a_settled_wheel_does_not_jump(simulator):
    scenario, measured = make_scenario(), (np.array([0.0, 1e-3, 0.0]), np.zeros(3))
    starts = [measured, settle(simulator, scenario, measured)]
    raw, settled = (
        simulator.simulate(np.zeros((1, 0)), Scenario(scenario.times, {
            **dict(zip(("q.x", "q.z", "q.spin"), x, strict=True)),
            **dict(zip(("qd.x", "qd.z", "qd.spin"), v, strict=True)),
        }, scenario.inputs))[0]
        for x, v in starts
    )  # fmt: skip
    assert np.ptp(raw[:, 1]) > 1e-3
    assert np.ptp(settled[:, 1]) < 5e-6


def test_a_driven_wheel_creeps_as_its_friction_needs(simulator):
    """A torque T needs the force F = T R m / (I + m R^2) at the floor, and so the creep F / b."""
    torque, speed = 0.8, 1.0
    measured = np.array([0.0, 0.0, 0.0]), np.array([speed, 0.0, speed / RADIUS])
    x, v = settle(simulator, make_scenario(torque), measured)
    force = torque * RADIUS * MASS / (INERTIA + MASS * RADIUS**2)
    # The contact point is in the middle of the overlap.
    slip = (RADIUS - DEPTH / 2) * v[2] - v[0]
    assert slip == pytest.approx(force * REGULARISATION / DAMPING, rel=0.05)
    assert x[1] == pytest.approx(-DEPTH, rel=0.03)
    assert v[0] == pytest.approx(speed, abs=0.01)


def test_a_wheel_in_the_air_stays_where_it_was_measured(simulator):
    measured = np.array([0.0, 0.01, 0.2]), np.array([0.1, -0.5, 3.0])
    settled = settle(simulator, make_scenario(), measured)
    np.testing.assert_array_equal(np.concatenate(settled), np.concatenate(measured))


@pytest.mark.parametrize("count", [1, 2, 4])
def test_each_open_contact_costs_the_square_of_free_fall(count):
    """Contacts that rest at the depth of 1e-4 m without force have only the cost of falling."""
    still = _Contact(np.zeros(1), np.zeros(1), -1e-4, False, np.ones(1))
    contacts = {(0, rim, 0): still for rim in range(1, count + 1)}
    # The acceleration has a tolerance of 0.1 m/s^2.
    expected = count * (GRAVITY / 0.1) ** 2
    assert _compute_cost(contacts, list(contacts)) == pytest.approx(expected, rel=1e-9)


def test_known_jacobians_of_contacts_save_evaluations(simulator, monkeypatch):
    """Derivatives of one first state serve for another one, and the results hardly differ."""
    evaluate, calls = ContactModel.evaluate, list[int]()

    def count(self, state):
        calls.append(1)
        return evaluate(self, state)

    monkeypatch.setattr(ContactModel, "evaluate", count)
    scenario, known = make_scenario(0.8), {}
    speed = np.array([1.0, 0.0, 1.0 / RADIUS])
    settle(simulator, scenario, (np.array([0.0, -1e-5, 0.0]), speed), known_jacobians=known)
    assert known
    measured = np.array([0.0, -2e-5, 0.0]), 1.01 * speed
    calls.clear()
    with_known = settle(simulator, scenario, measured, known_jacobians=known)
    few = len(calls)
    calls.clear()
    own = settle(simulator, scenario, measured)
    assert 2 * few < len(calls)
    # The depth is 1e-4 m, and the speeds are 1 m/s and 10 rad/s.
    np.testing.assert_allclose(with_known[0], own[0], atol=2e-6)
    np.testing.assert_allclose(with_known[1], own[1], atol=2e-3)


def test_wrong_known_jacobians_are_replaced(simulator):
    scenario, measured = make_scenario(), (np.array([0.3, -1e-6, 0.5]), np.array([0.0, 0.02, 0.0]))
    known = {}
    settle(simulator, scenario, measured, known_jacobians=known)
    wrong = {layout: -jacobian for layout, jacobian in known.items()}
    x, _ = settle(simulator, scenario, measured, known_jacobians=wrong)
    assert x[1] == pytest.approx(-DEPTH, rel=0.03)


def test_the_response_to_a_first_state_is_right_where_a_contact_begins(simulator):
    """A contact that begins within a finite difference has no derivative of its own."""
    scenario, start = make_scenario(), np.array([0.0, -5e-7, 0.0])
    linear = RunLinearisation(simulator, np.zeros(0), scenario, start, np.zeros(3))
    responses = linear.compute_initial_state_responses()[1, :, 1]
    assert np.abs(responses).max() < 20.0
