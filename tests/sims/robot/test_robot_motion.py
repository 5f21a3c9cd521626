"""Tests of robot motion against mechanics and a plain MuJoCo loop, effect by effect."""

from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sims.core.simulator import InputError, Scenario
from sims.robot.integrator_settings import IntegratorSettings, read_integrator_settings
from sims.robot.robot_model import RobotModel
from sims.robot.robot_simulator import make_robot_simulator
from tests.sims.robot.sample_arms import ARM

PENDULUM = """
<mujoco>
  <option timestep="{step}" integrator="{integrator}" gravity="0 0 {gravity}"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.01" armature="0.002"/>
      <inertial pos="0 0 -0.3" mass="0.5" diaginertia="0.004 0.004 0.001"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" gear="2"/></actuator>
</mujoco>
"""
INERTIA = 0.002 + 0.004 + 0.5 * 0.3**2
"""About the hinge, kg m^2."""
TIMES = np.arange(0, 0.5, 0.01)
NONE = np.empty((1, 0))


def kind_of(text, **given):
    """Return the simulator class of an MJCF text."""
    spec = mujoco.MjSpec.from_string(text)
    return make_robot_simulator(RobotModel(Path("robot.xml"), "mjcf", spec, digest=text), **given)


def pendulum(step=0.001, integrator="RK4", gravity=-9.81):
    return kind_of(PENDULUM.format(step=step, integrator=integrator, gravity=gravity))


def arm(integrator="Euler", text=ARM):
    option = f'timestep="0.001" integrator="{integrator}"'
    return kind_of(text.replace('timestep="0.001"', option))


def one(kind, scenario, observe=("q.hinge",), **effects):
    """Simulate with effects given by coefficients; return (T, C)."""
    fixed = {name.replace("__", ".").replace("_at_", "@"): c for name, c in effects.items()}
    return kind(observe=observe, fixed=fixed).simulate(NONE, scenario)[0]


def swing(times, initial, damping=0.01, force=lambda t: 0.0):
    """Return the pendulum's motion from SciPy, with a tolerance of 1e-12."""

    def slopes(t, state):
        weight = -0.5 * 9.81 * 0.3 * np.sin(state[0])
        return state[1], (weight - damping * state[1] + force(t)) / INERTIA

    ends = (times[0], times[-1])
    given = {"t_eval": times, "rtol": 1e-12, "atol": 1e-12, "method": "DOP853"}
    return solve_ivp(slopes, ends, initial, **given).y.T


@pytest.mark.parametrize("jitter", [0.0, 0.004])
def test_a_pendulum_swings_as_its_equation_says_wherever_samples_lie(jitter):
    times = TIMES + jitter * np.random.default_rng(3).uniform(0, 1, TIMES.size)
    times[0] = 0.0
    scenario = Scenario(times, {"q.hinge": 2.0, "qd.hinge": -1.0})
    seen = one(pendulum(), scenario, ["q.hinge", "qd.hinge"])
    expected = swing(times, [2.0, -1.0])
    np.testing.assert_allclose(seen[:, 0], expected[:, 0], rtol=0, atol=1e-8)
    # Velocity is interpolated linearly between steps: the error is h^2 / 8 times its second
    # derivative.
    np.testing.assert_allclose(seen[:, 1], expected[:, 1], rtol=0, atol=1e-4 if jitter else 1e-8)


def test_a_command_is_held_and_applied_as_its_mean_over_a_step():
    times = np.arange(0, 0.3, 0.0137)
    u = np.sin(40 * times)
    seen = one(pendulum(), Scenario(times, {"q.hinge": 0.3}, {"u.motor": u}))
    held = lambda t: 2.0 * u[np.searchsorted(times, t, side="right") - 1]  # noqa: E731
    parts = [np.array([0.3, 0.0])]
    for a, b in pairwise(times):
        middle = held((a + b) / 2)
        parts.append(swing(np.array([a, b]), parts[-1], force=lambda _, f=middle: f)[-1])
    # For a command that changes within a step the impulse is exact; its time is off by order h^2.
    np.testing.assert_allclose(seen[:, 0], np.array(parts)[:, 0], rtol=0, atol=2e-5)


ARM_RUN = Scenario(
    TIMES,
    {"q.shoulder": 0.3, "q.elbow": -0.5, "q.spin": 0.1},
    {"u.m_shoulder": np.sin(9 * TIMES), "u.m_elbow": np.cos(7 * TIMES), "u.m_spin": 6 * TIMES},
)
JOINTS = ("q.shoulder", "q.elbow", "q.spin")


def looped(kind, text=ARM, applied=(0, 0, 0), lead=0):
    """Return (T, 3) positions of a plain MuJoCo loop."""
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.integrator = kind.robot.compiled.opt.integrator
    data = mujoco.MjData(model)
    data.qpos[:] = (0.3, -0.5, 0.1)
    u = np.stack(list(ARM_RUN.inputs.values()), axis=1)
    seen = []
    for step in range(491):
        if step % 10 == 0:
            seen.append(data.qpos.copy())
        row = np.clip(np.array([step, step + lead, step]) // 10, 0, len(u) - 1)
        data.ctrl[:] = u[row, range(3)]
        data.qfrc_applied[:] = applied
        mujoco.mj_step(model, data)
    return np.array(seen)


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicit", "implicitfast"])
def test_an_arm_moves_as_in_plain_mujoco(integrator):
    kind = arm(integrator)
    np.testing.assert_allclose(one(kind, ARM_RUN, JOINTS), looped(kind), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ({"drag__linear_at_*": [0.1, 0.1, 0.1]}, None),
        ({"force__bias_at_elbow": 0.7}, {"applied": (0, 0.7, 0)}),
        ({"input__delay_at_m_elbow": 0.013}, {"lead": -13}),
        ({"input__delay_at_m_elbow": -0.02}, {"lead": 20}),
        (
            {"mass__scale_at_fore": 0.5, "inertia__scale_at_fore": -0.2},
            {"text": ARM.replace('mass="0.8" diaginertia="0.002 0.008 0.009"',
                                 'mass="1.2" diaginertia="0.0024 0.0096 0.0108"')},
        ),
    ],
    ids=str,
)  # fmt: skip
def test_an_effect_is_what_mujoco_makes_of_it(effects, message):
    kind = arm()
    seen = one(kind, ARM_RUN, JOINTS, **effects)
    plain = one(kind, ARM_RUN, JOINTS)
    assert np.abs(seen - plain).max() > 1e-4
    if message is not None:
        np.testing.assert_allclose(seen, looped(kind, **message), rtol=0, atol=1e-12)
    else:
        each = {f"drag__linear_at_{j}": 0.1 for j in ("shoulder", "elbow", "spin")}
        np.testing.assert_array_equal(seen, one(kind, ARM_RUN, JOINTS, **each))


def test_stribeck_friction_without_its_extra_is_coulombs():
    kind = arm()
    stribeck = one(kind, ARM_RUN, JOINTS, friction__stribeck_at_elbow=[0.2, 0.0, 0.1])
    coulomb = one(kind, ARM_RUN, JOINTS, friction__coulomb_at_elbow=0.2)
    np.testing.assert_allclose(stribeck, coulomb, rtol=0, atol=1e-12)
    more = one(kind, ARM_RUN, JOINTS, friction__stribeck_at_elbow=[0.2, 0.1, 0.1])
    assert np.abs(more - coulomb).max() > 1e-4


PUSHED = {"u.motor": np.full(TIMES.size, 0.3)}
PUSH = 2 * 0.3 / INERTIA
"""rad/s^2."""


@pytest.mark.parametrize(
    ("effects", "measured_time"),
    [
        ({}, lambda t: t),
        ({"sensor__delay_at_q.hinge": 0.0033}, lambda t: np.maximum(t - 0.0033, 0.0)),
        ({"sensor__delay_at_q.hinge": -0.0033}, lambda t: t + 0.0033),
        ({"clock__skew": 0.03}, lambda t: 1.03 * t),
        ({"clock__skew": -0.03}, lambda t: 0.97 * t),
    ],
    ids=["on time", "late", "early", "a slow clock", "a fast clock"],
)
def test_a_late_sensor_shows_what_was_the_case(effects, measured_time):
    """A constant force without gravity and damping gives a parabola, up to the last sample."""
    text = PENDULUM.format(step=0.002, integrator="RK4", gravity=0).replace('damping="0.01"', "")
    seen = one(kind_of(text), Scenario(TIMES, {}, PUSHED), **effects)[:, 0]
    np.testing.assert_allclose(seen, PUSH * measured_time(TIMES) ** 2 / 2, rtol=0, atol=1e-10)


def test_a_lag_of_one_sensor_leaves_the_others_as_they_are():
    """T y' = s - y of the parabola s, in closed form."""
    text = PENDULUM.format(step=0.002, integrator="RK4", gravity=0).replace('damping="0.01"', "")
    times = np.arange(30) * 0.0131
    run = Scenario(times, {}, {"u.motor": np.full(30, 0.3)})
    observe, lag = ["q.hinge", "qd.hinge"], 0.05
    seen = one(kind_of(text), run, observe, **{"sensor__lag_at_q.hinge": lag})
    left = lag**2 * -np.expm1(-times / lag)
    expected = PUSH * (times**2 / 2 - lag * times + left)
    # The lag takes its signal as linear over each step, and is interpolated between step ends.
    np.testing.assert_allclose(seen[:, 0], expected, rtol=0, atol=2 * PUSH * 0.002**2 / 8)
    np.testing.assert_array_equal(seen[:, 1], one(kind_of(text), run, observe)[:, 1])


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicitfast"])
def test_forces_and_sensors_are_those_of_the_instant(integrator):
    text = ARM.replace(
        "</actuator>",
        '</actuator><sensor><framelinvel name="speed" objtype="body" objname="fore"/>'
        '<jointactuatorfrc name="drive" joint="elbow"/></sensor>',
    )
    kind = arm(integrator, text)
    observe = [
        f"{what}.{of}" for what in ("q", "qd", "tau") for of in ("shoulder", "elbow", "spin")
    ]
    observe += ["s.speed.x", "s.speed.y", "s.speed.z", "s.drive"]
    seen = one(kind, ARM_RUN, observe)
    model, data = kind.robot.compiled, mujoco.MjData(kind.robot.compiled)
    for row, u in zip(seen, np.stack(list(ARM_RUN.inputs.values()), axis=1), strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = row[:3], row[3:6], u
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(row[6:9], data.qfrc_actuator, rtol=0, atol=1e-11)
        np.testing.assert_allclose(row[9:], data.sensordata, rtol=0, atol=1e-11)
    assert np.ptp(seen[:, np.arange(13) != 10], axis=0).min() > 0, "it stays in its plane"


def test_an_element_that_explodes_is_nan_and_leaves_the_others(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kind = arm()
    simulator = kind(observe=JOINTS, effects=["spring.cubic@elbow", "force.ripple@shoulder"])
    quiet = np.array([[0.0, 0.0, 0.0, 1.0], [0.4, 0.3, 0.0, 0.2], [0.0, 0.0, 0.0, 0.0]])
    wild = np.array([[-1e9, 0.0, 0.0, 1.0], [-1e9, 1.0, 0.0, 1.0], [np.nan, 0.0, 0.0, 1.0]])
    seen = simulator.simulate(np.concatenate([quiet, wild]), ARM_RUN)
    assert np.isnan(seen[3:, -1]).all()
    np.testing.assert_array_equal(seen[:3], simulator.simulate(quiet, ARM_RUN))
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir()), "MuJoCo writes no log"


def test_elements_have_the_same_bits_in_any_order_and_batch():
    kind = arm()
    names = [
        "friction.coulomb@*", "friction.stribeck@elbow", "mass.scale@fore", "force.periodic@spin",
        "input.lag@m_elbow", "sensor.lag@q.elbow", "sensor.delay@q.spin", "clock.skew",
    ]  # fmt: skip
    simulator = kind(observe=["q.elbow", "q.spin", "tau.shoulder"], effects=names)
    rng = np.random.default_rng(5)
    lanes = rng.uniform(0, 0.1, (24, len(simulator.parameters)))
    lanes *= rng.uniform(size=lanes.shape) < 0.3
    short = Scenario(np.array([0.0, 0.0131, 0.2, 0.2004]), {"q.elbow": 1.0}, {})
    runs = [short if i % 3 else ARM_RUN for i in range(24)]
    together = simulator.simulate_batch(lanes, runs)
    order = rng.permutation(24)
    turned = simulator.simulate_batch(lanes[order], [runs[i] for i in order])
    np.testing.assert_array_equal(turned, together[order])
    for i in range(24):
        alone = simulator.simulate(lanes[i : i + 1], runs[i])[0]
        np.testing.assert_array_equal(together[i, : len(alone)], alone)


def test_another_step_is_that_of_a_file_that_states_it():
    """All values that depend on the step change, such as the stiffness of dry friction."""
    finer = IntegratorSettings(0.0004, "RK4")
    other = kind_of(ARM.replace('timestep="0.001"', 'timestep="0.0004" integrator="RK4"'))
    effects = {"friction__coulomb_at_elbow": 0.2, "mass__scale_at_fore": 0.3}
    expected = one(other, ARM_RUN, JOINTS, **effects)
    found = arm().with_integrator_settings(finer)
    assert (found.numerics, read_integrator_settings(found.robot)) == (
        finer,
        IntegratorSettings(0.001, "Euler"),
    )
    np.testing.assert_array_equal(one(found, ARM_RUN, JOINTS, **effects), expected)
    assert np.abs(one(arm(), ARM_RUN, JOINTS, **effects) - expected).max() > 1e-4


def test_an_engine_that_cannot_be_is_one_line():
    kind = pendulum()
    for settings, message in (
        ({"engine": "pybullet"}, "steps in MuJoCo; it has no engine 'pybullet'"),
        ({"integrator": "leapfrog"}, "unknown integrator 'leapfrog'; there are: Euler, RK4"),
        ({"timestep": -1.0}, "timestep must be a positive number of seconds, found -1.0"),
        ({"time_step": 0.01}, "unknown setting of engine mujoco 'time_step'; there are"),
    ):
        with pytest.raises(InputError, match=message):
            kind(**settings)
    fine = kind(timestep=0.0005, integrator="Euler")
    assert fine.time_step == 0.0005
