"""Tests of activation filters of actuators: meaning of their inputs, and motion compared with plain
MuJoCo.
"""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from sims.core.simulator import InputError, Scenario
from sims.recording.recording_description import check_description
from sims.robot.dynamics.activation_filters import activation_filters
from sims.robot.robot_model import RobotModel
from sims.robot.robot_simulator import make_robot_simulator

ROBOT = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="{integrator}"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.05" armature="0.01" range="-2 2"/>
      <inertial pos="0 0 -0.2" mass="0.5" diaginertia="0.002 0.002 0.001"/>
    </body>
  </worldbody>
  <actuator>{actuator}</actuator>
</mujoco>
"""
TAU = 0.05
POSITION = f'<position name="m" joint="hinge" kp="8" kv="0.3" timeconst="{TAU}"/>'
GENERAL = (
    '<general name="m" joint="hinge" dyntype="{dyntype}" dynprm="0.05" biastype="affine" '
    'gainprm="{gain}" biasprm="{bias}" {more}/>'
)
TIMES = 0.01 * np.arange(81)
COMMAND = 0.4 + 0.3 * np.sin(9.0 * TIMES)
NONE = np.empty((1, 0))


def simulator(actuator, integrator="implicitfast"):
    text = ROBOT.format(actuator=actuator, integrator=integrator)
    spec = mujoco.MjSpec.from_string(text)
    return make_robot_simulator(RobotModel(Path("robot.xml"), "mjcf", spec, digest=text))


def plain(kind, activation, command=COMMAND):
    """Return the angles of a plain MuJoCo loop, and its final data."""
    model = kind.robot.compiled
    data = mujoco.MjData(model)
    data.act[:] = activation
    angles = [0.0]
    for u in command[:-1]:
        data.ctrl[0] = u
        for _ in range(5):
            mujoco.mj_step(model, data)
        angles.append(float(data.qpos[0]))
    return np.array(angles), data


def simulated(kind, scenario, **given):
    return kind(observe=["q.hinge"], **given).simulate(NONE, scenario)[0, :, 0]


@pytest.mark.parametrize(
    ("actuator", "kind", "unit"),
    [
        (POSITION, "position", "rad"),
        (POSITION.replace("kp=", 'inheritrange="1" kp='), "position", "rad"),
        (POSITION.replace("kp=", 'gear="3" kp='), "position", "rad"),
        (GENERAL.format(dyntype="filter", gain=8, bias="0 -8 -0.3", more=""), "position", "rad"),
        (
            GENERAL.format(dyntype="filterexact", gain=2, bias="0 0 -2", more=""),
            "velocity",
            "rad/s",
        ),
        (GENERAL.format(dyntype="filter", gain=2, bias="0 0 0", more=""), "motor", "N*m"),
    ],
)
def test_a_filter_does_not_change_what_an_input_means(actuator, kind, unit):
    robot = simulator(actuator)
    assert robot.robot.actuators[0].kind == kind
    assert {c.name: c.unit for c in robot.system.inputs}["u.m"] == unit
    named = robot.system.servos.get(0)
    assert named == ("u.m" if kind == "position" else None)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
@pytest.mark.parametrize("dyntype", ["filter", "filterexact"])
def test_the_motion_is_that_of_mujoco_from_a_stated_activation(dyntype, integrator):
    more = 'gear="2" ctrlrange="-0.5 0.6" ctrllimited="true"'
    actuator = GENERAL.format(dyntype=dyntype, gain=8, bias="0 -8 -0.3", more=more)
    kind = simulator(actuator, integrator)
    for stated in (0.0, 0.25):
        initial = {"act.m": stated, "q.hinge": 0.0, "qd.hinge": 0.0}
        scenario = Scenario(TIMES, initial, {"u.m": COMMAND})
        expected, _ = plain(kind, stated)
        assert simulated(kind, scenario) == pytest.approx(expected, abs=1e-12)
    unstated = Scenario(TIMES, {}, {"u.m": COMMAND})
    expected, _ = plain(kind, min(COMMAND[0], 0.6))
    assert simulated(kind, unstated) == pytest.approx(expected, abs=1e-12)


def test_commands_before_a_run_set_its_first_activation():
    kind = simulator(POSITION)
    angles, _ = plain(kind, COMMAND[0])
    _, data = plain(kind, COMMAND[0], COMMAND[:41])
    earlier = np.stack([TIMES[:40] - TIMES[40], COMMAND[:40]])
    initial = {"q.hinge": angles[40], "qd.hinge": float(data.qvel[0])}
    scenario = Scenario(TIMES[40:], initial, {"u.m": COMMAND[40:]}, before={"u.m": earlier})
    assert simulated(kind, scenario) == pytest.approx(angles[40:], abs=1e-9)


def test_elements_of_one_command_keep_their_own_activations():
    kind = simulator(POSITION)
    scenarios = [Scenario(TIMES, {"act.m": a}, {"u.m": COMMAND}) for a in (0.0, 0.5)]
    lanes = kind(observe=["q.hinge"]).simulate_batch(np.empty((2, 0)), scenarios)
    for row, activation in zip(lanes[:, :, 0], (0.0, 0.5), strict=True):
        assert row == pytest.approx(plain(kind, activation)[0], abs=1e-12)


def test_a_dead_zone_of_the_servo_acts_on_the_filtered_set_point():
    """A dead zone wider than any error leaves only the velocity gain."""
    kind = simulator(POSITION)
    wide = simulated(kind, Scenario(TIMES, {}, {"u.m": COMMAND}), fixed={"servo.deadband@m": 50.0})
    damped = simulator(GENERAL.format(dyntype="filterexact", gain=0, bias="0 0 -0.3", more=""))
    expected = simulated(damped, Scenario(TIMES, {}, {"u.m": COMMAND}))
    # The effect is constant over half a step, the servo is not.
    assert wide == pytest.approx(expected, abs=2e-3)
    assert np.ptp(simulated(kind, Scenario(TIMES, {}, {"u.m": COMMAND}))) > 0.3


@pytest.mark.parametrize("unit", ["rad", "1", "rad/s"])
def test_an_input_of_an_integrator_is_refused_in_one_line(unit):
    kind = simulator('<intvelocity name="m" joint="hinge" kp="8" actrange="-2 2"/>')
    meta = {
        "model": "robot.xml",
        "channels": {"q.hinge": {"unit": "rad"}},
        "inputs": {"u.m": {"unit": unit}},
    }
    with pytest.raises(InputError, match=r"log.toml: input u.m: the actuator integrates") as error:
        check_description(Path("log.toml"), meta, kind)
    assert "\n" not in str(error.value)


def test_a_recording_may_state_activations_of_filters_alone():
    meta = {
        "model": "robot.xml",
        "channels": {"q.hinge": {"unit": "rad"}},
        "runs": {"a": {"initial": {"act.m": 0.2}}},
    }
    about = check_description(Path("log.toml"), meta, simulator(POSITION))
    assert about.runs["a"].initial == {"act.m": 0.2}
    without = simulator(POSITION.replace(f'timeconst="{TAU}"', ""))
    assert not activation_filters(without.robot)
    with pytest.raises(InputError, match=r"act.m"):
        check_description(Path("log.toml"), meta, without)
