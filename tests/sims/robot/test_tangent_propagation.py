"""Tests that linearised responses of a robot's motion to small changes agree with simulations."""

import mujoco
import numpy as np
import pytest

from sims import effects as library
from sims.core.simulator import Scenario
from sims.robot.dynamics import tangent_propagation
from sims.robot.dynamics.applied_inputs import compute_step_inputs
from sims.robot.dynamics.linearisation_about_simulation import RunLinearisation
from sims.robot.dynamics.step_jacobians import (
    DifferenceQuotients,
    compute_difference_quotients,
    compute_runge_kutta_step,
    replace_diverging_points,
)
from sims.robot.integrator_settings import IntegratorSettings
from tests.sims.robot.test_robot_motion import kind_of

ARM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper_arm" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="1.2" contype="0"
            conaffinity="0"/>
      <body name="forearm" pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0" damping="0.05"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.35" size="0.025" mass="0.8" contype="0"
              conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="m_shoulder" joint="shoulder" kp="60" kv="3"/>
    <position name="m_elbow" joint="elbow" kp="30" kv="1.5"/>
  </actuator>
</mujoco>
"""

TIMES = np.arange(0, 1.0, 0.01)
SMALL_CHANGES = {
    "drag.linear": 1e-4, "drag.quadratic": 1e-4, "force.bias": 1e-4, "force.ripple": 1e-4,
    "friction.coulomb": 1e-4, "friction.direction": 1e-3, "gravity.tilt": 1e-4,
    "friction.position": 1e-4, "friction.warming": 1e-4, "friction.load_direction": 1e-3,
    "inertia.armature": 1e-4, "joint.coupling": 1e-3,
    "input.bias": 1e-4, "input.gain": 1e-4, "input.lag": 1e-3, "mass.scale": 1e-3,
    "mass.offset": 1e-3, "sensor.bias": 1e-4, "sensor.delay": 1e-3, "sensor.gain": 1e-4,
    "sensor.eccentricity": 1e-3, "servo.deadband": 1e-4, "servo.derivative": 1e-2,
    "spring.linear": 1e-4,
    "supply.braking": 1e-3, "supply.sag": 1e-3,
}  # fmt: skip
"""Fractions of plausible ranges that are small changes."""


def moving(
    integrator="implicitfast", step=0.002, channels=("q.shoulder", "q.elbow", "tau.elbow"), text=ARM
):
    """Return a simulator of a moving arm with all effects, and its scenario."""
    kind = kind_of(text).with_integrator_settings(IntegratorSettings(step, integrator))
    effects = list(library.list_effects_for(kind.system).values())
    simulator = kind(observe=list(channels), effects=effects)
    rng = np.random.default_rng(3)
    inputs = {}
    for channel in simulator.inputs:
        if channel.name.startswith("u."):
            rate, phase = rng.uniform(3, 9), rng.uniform(0, 6)
            inputs[channel.name] = 0.4 * (np.sin(rate * TIMES + phase) - np.sin(phase))
    return simulator, Scenario(TIMES, {}, inputs)


def probes(simulator):
    """Return effects with one small coefficient each, and the corresponding parameters."""
    added, thetas, place = [], [], 0
    for effect in simulator.effects:
        count = len(effect.coefficients)
        share = SMALL_CHANGES.get(effect.of or effect.name)
        for i, coefficient in enumerate(effect.coefficients if share else ()):
            low, high = coefficient.plausible[0]
            if low > 0:
                continue
            c = np.array([k.plausible[0][1] if k.plausible[0][0] > 0 else 0.0
                          for k in effect.coefficients])  # fmt: skip
            c[i] = share * high
            theta = np.zeros(len(simulator.parameters))
            theta[place : place + count] = c
            added.append((effect, c))
            thetas.append(theta)
        place += count
    return added, np.array(thetas)


@pytest.mark.parametrize("integrator", ["implicitfast", "RK4"])
def test_the_tangent_is_what_each_small_change_makes(integrator):
    simulator, scenario = moving(integrator)
    added, thetas = probes(simulator)
    still = simulator.simulate_batch(np.zeros((1, thetas.shape[1])), [scenario])[0]
    changed = simulator.simulate_batch(thetas, [scenario] * len(thetas)) - still
    about = RunLinearisation(
        simulator, np.zeros(thetas.shape[1]), scenario, np.zeros(2), np.zeros(2)
    )
    np.testing.assert_allclose(about.observed, still, atol=1e-12)
    # Torque and angle have different scales, so each channel is scaled by its own.
    scale = np.sqrt(np.square(changed).mean(axis=1, keepdims=True).max(axis=0, keepdims=True))
    seen = about.compute_effect_responses(added)[0] / scale
    true = changed / scale
    size = np.sqrt(np.square(true).sum(axis=(1, 2)))
    counted = size > 1e-3 * size.max()
    assert counted.sum() > 30, "most of them move something"
    apart = np.sqrt(np.square(seen - true).sum(axis=(1, 2)))[counted] / size[counted]
    worst = np.argsort(-apart)[:3]
    names = [added[i][0].name for i in np.flatnonzero(counted)[worst]]
    assert apart.max() < 0.15, (names, apart[worst])
    assert np.median(apart) < 0.01


def test_the_response_to_a_mass_is_proportional_where_joints_stick():
    """Dry friction of a joint at rest absorbs forces, which made a jump of any size."""
    simulator, scenario = moving(text=ARM.replace('damping="', 'frictionloss="4" damping="'))
    zeros = np.zeros(len(simulator.parameters))
    about = RunLinearisation(simulator, zeros, scenario, np.zeros(2), np.zeros(2))
    assert (np.abs(np.diff(about.observed[:, 0])) < 1e-5).any(), "the shoulder sticks"
    mass = next(e for e in simulator.effects if e.name == "mass.scale@forearm")
    sizes = np.array([1e-2, 1e-3])
    large, small = about.compute_effect_responses([(mass, np.array([c])) for c in sizes])[0]
    assert np.abs(large).max() > 1e-4
    np.testing.assert_allclose(large / sizes[0], small / sizes[1], atol=0.02)


def response_error(effects):
    """Return the relative error of the linearised response of an arm with effects to a force."""
    simulator, scenario = moving(channels=("q.shoulder", "q.elbow"))
    names = [p.name for p in simulator.parameters]
    about = np.zeros(len(names))
    for name, value in effects.items():
        about[names.index(name)] = value
    pushed = about.copy()
    pushed[names.index("force.bias@elbow")] = 1e-3
    still, moved = simulator.simulate_batch(np.stack([about, pushed]), [scenario] * 2)
    effect = next(e for e in simulator.effects if e.name == "force.bias@elbow")
    tangent = RunLinearisation(simulator, about, scenario, np.zeros(2), np.zeros(2))
    seen = tangent.compute_effect_responses([(effect, np.array([1e-3]))])[0][0]
    return np.sqrt(np.square(seen - (moved - still)).sum() / np.square(moved - still).sum())


@pytest.mark.parametrize("name", ["supply.sag@m_elbow", "friction.load@elbow"])
def test_the_load_of_the_drive_moves_with_the_servo(name):
    """The linearisation includes a weak drive's response; with a fixed drive force the error would
    be 7 to 10 %.
    """
    assert response_error({name: 0.1}) < 0.02


@pytest.mark.parametrize(
    "frictions", [("friction.coulomb@elbow", "friction.load@elbow"),
                  ("friction.position@elbow.least", "friction.load@elbow")],
)  # fmt: skip
def test_frictions_at_one_joint_add_up(frictions):
    """The linearisation is about the motion with all frictions."""
    assert response_error(dict(zip(frictions, (1.0, 0.1), strict=True))) < 0.02


def test_initial_states_move_a_run_as_their_derivatives_say():
    simulator, scenario = moving(channels=("q.shoulder", "q.elbow"))
    size = len(simulator.parameters)
    about = RunLinearisation(simulator, np.zeros(size), scenario, np.zeros(2), np.zeros(2))
    derivatives = about.compute_initial_state_responses()
    small = 1e-4
    for k, name in enumerate(("q.shoulder", "q.elbow", "qd.shoulder", "qd.elbow")):
        moved = Scenario(TIMES, {name: small}, scenario.inputs)
        change = (simulator.simulate(np.zeros((1, size)), moved)[0] - about.observed) / small
        np.testing.assert_allclose(derivatives[k], change, atol=0.02 * np.abs(change).max())


def test_a_command_that_changes_within_a_step_is_neither_early_nor_late():
    """The sum over steps, and the sum weighted with time, equal those of the command."""
    rng = np.random.default_rng(5)
    parts = rng.normal(size=(3, 20, 4))
    seen = np.zeros(21, dtype=bool)
    seen[::5] = True
    given = compute_step_inputs(parts, seen)
    quarters = (np.arange(80) + 0.5) / 4
    steps = np.arange(20) + 0.5
    np.testing.assert_allclose(given.sum(axis=1), parts.mean(axis=2).sum(axis=1))
    wanted = (parts.reshape(3, 80) * quarters).sum(axis=1) / 4
    np.testing.assert_allclose((given * steps).sum(axis=1), wanted)
    # Between any two recorded samples the sums are equal, too.
    for begin in range(0, 20, 5):
        own = slice(begin, begin + 5)
        np.testing.assert_allclose(given[:, own].sum(1), parts[:, own].mean(axis=2).sum(1))


@pytest.mark.parametrize("late", [0.0013, 0.003, 0.0127])
def test_a_delay_of_a_part_of_a_step_is_right_to_the_third_order(late):
    """Reference: a step a hundred times smaller. The mean over the step alone would have 20 times
    the error.
    """
    apart = []
    for step in (0.002, 0.00002):
        kind = kind_of(ARM).with_integrator_settings(IntegratorSettings(step, "RK4"))
        _, scenario = moving()
        simulator = kind(observe=["qd.elbow"], fixed={"input.delay@m_elbow": late})
        apart.append(simulator.simulate(np.empty((1, 0)), scenario)[0])
    size = np.sqrt(np.square(apart[1]).mean())
    assert np.sqrt(np.square(apart[0] - apart[1]).mean()) < 3e-4 * size


def test_a_runge_kutta_step_of_a_linear_joint_has_these_derivatives():
    """x'' = -w^2 x - c x' + b f by the four evaluations of the method, against equation (3)."""
    stiffness, damping, gain, h = 90.0, 3.0, 2.5, 0.02

    def step(x, v, f):
        def rate(y):
            return np.array([y[1], -stiffness * y[0] - damping * y[1] + gain * f])

        y = np.array([x, v])
        k1 = rate(y)
        k2 = rate(y + 0.5 * h * k1)
        k3 = rate(y + 0.5 * h * k2)
        k4 = rate(y + h * k3)
        return y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    states, forces, controls = compute_runge_kutta_step(
        np.array([[[-stiffness, -damping]]]), np.array([[[gain]]]), np.zeros((1, 1, 0)), h
    )
    np.testing.assert_allclose(states[0, :, 0], step(1.0, 0.0, 0.0), rtol=1e-13)
    np.testing.assert_allclose(states[0, :, 1], step(0.0, 1.0, 0.0), rtol=1e-13)
    np.testing.assert_allclose(forces[0, :, 0], step(0.0, 0.0, 1.0), rtol=1e-13)
    assert controls.shape == (1, 2, 0)


def test_points_whose_difference_straddles_a_jump_get_the_quotients_of_the_nearest_other_point():
    step = np.array([[1.0, 0.002], [-0.5, 0.98]])
    states = np.array([step + 0.01 * point for point in range(6)])
    # A stiff contact has large derivatives too, but a step does not multiply deviations.
    states[4] = [[1.0, 0.002], [-400.0, 0.1]]
    states[2] = [[1.0, 0.002], [5890.0, 588.0]]
    states[5, 0, 0] = np.nan
    others = [np.arange(6.0).reshape(6, 1, 1) for _ in range(5)]
    replaced = replace_diverging_points(DifferenceQuotients(states, *others))
    np.testing.assert_array_equal(replaced.states, states[[0, 1, 1, 3, 4, 4]])
    for values in replaced[1:]:
        np.testing.assert_array_equal(values.ravel(), [0, 1, 1, 3, 4, 4])
    kept = DifferenceQuotients(states[[0, 1, 3]], *(values[:3] for values in others))
    assert replace_diverging_points(kept) is kept


def add_filtered_motor(arm):
    """Add a motor with an activation to a `mujoco.MjSpec`."""
    motor = arm.add_actuator(name="slow", target="elbow", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.dyntype, motor.dynprm[0] = mujoco.mjtDyn.mjDYN_FILTER, 0.05


def add_pid(arm):
    """Add a servo with an integral, and with two controls: a set point and its rate."""
    servo = arm.add_actuator(name="pid", target="elbow", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    if not hasattr(servo, "set_to_pid"):
        pytest.skip("a pid needs MuJoCo 4")
    inputs = mujoco.mjtCtrlInput.mjINPUT_POS, mujoco.mjtCtrlInput.mjINPUT_VEL
    servo.set_to_pid(kp=2.0, ki=1.0, kv=0.3, ctrlspec=sum(map(int, inputs)))


def two_arms(add_drive, is_coupled):
    """Return a model file with two arms of two joints each, on one base.

    Args:
        add_drive: function that adds an actuator to the `mujoco.MjSpec` of the left arm.
        is_coupled: whether an equality constraint couples the elbows.
    """
    base = mujoco.MjSpec()
    for side in ("left_", "right_"):
        arm = mujoco.MjSpec.from_string(ARM)
        base.option.timestep, base.option.integrator = arm.option.timestep, arm.option.integrator
        if side == "left_":
            add_drive(arm)
        base.attach(arm, prefix=side, frame=base.worldbody.add_frame())
    if is_coupled:
        base.add_equality(
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1="left_elbow",
            name2="right_elbow",
        )
    return base.to_xml()


@pytest.mark.parametrize("integrator", ["implicitfast", "RK4"])
@pytest.mark.parametrize("add_drive", [lambda arm: None, add_filtered_motor, add_pid])
@pytest.mark.parametrize("is_coupled", [False, True])
def test_limbs_that_are_displaced_together_have_the_derivatives_of_each(
    monkeypatch, integrator, add_drive, is_coupled
):
    channels = ("q.left_shoulder", "q.right_elbow", "tau.right_shoulder")
    kind = kind_of(two_arms(add_drive, is_coupled)).with_integrator_settings(
        IntegratorSettings(0.002, integrator)
    )
    simulator = kind(observe=list(channels))
    rng = np.random.default_rng(4)
    inputs = {
        channel.name: 0.4 * np.sin(rng.uniform(3, 9) * TIMES)
        for channel in simulator.inputs
        if channel.name.startswith("u.")
    }
    compared = []

    def compare(points, sizes, get_base_step):
        assert (points.limbs is None) is is_coupled
        before = points.placed_count
        together = compute_difference_quotients(points, sizes, get_base_step)
        after = points.placed_count
        with monkeypatch.context() as patch:
            patch.setattr(type(points), "limbs", None)
            single = compute_difference_quotients(points, sizes, get_base_step)
        compared.append((together, single, after - before, points.placed_count - after))
        return together

    monkeypatch.setattr(tangent_propagation, "compute_difference_quotients", compare)
    RunLinearisation(simulator, np.zeros(0), Scenario(TIMES, {}, inputs), np.zeros(4), np.zeros(4))
    ((together, single, few, many),) = compared
    for one, other in zip(together, single, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6 * max(np.abs(other).max(initial=0), 1))
    assert np.abs(single.read_states).max() > 1
    # The unperturbed step is computed once, and counts for the first of the two.
    assert few >= many if is_coupled else few < 0.65 * many
