"""Tests of actuators on tendons and sites: units, effects and their numbers in the file."""

import numpy as np
import pytest

from sims import effects
from sims.core.simulator import Scenario
from sims.robot.parsing.read_model_file import read_robot
from sims.robot.robot_simulator import make_robot_simulator
from tests.sims.robot.sample_arms import write_and_check
from tests.sims.robot.test_model_changes import number, one

GRIPPER = """<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="rail">
      <joint name="arm" axis="0 1 0" damping="0.2"/>
      <inertial pos="0.1 0 0" mass="1" diaginertia="0.005 0.005 0.005"/>
      <site name="rotor" pos="0.2 0 0"/>
      <body name="left" pos="0.2 0 0">
        <joint name="left" type="slide" axis="0 1 0" damping="2"/>
        <inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>
      </body>
      <body name="right" pos="0.2 0 0">
        <joint name="right" type="slide" axis="0 -1 0" damping="2"/>
        <inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="split"><joint joint="left" coef="0.5"/><joint joint="right" coef="0.5"/></fixed>
    <fixed name="mixed"><joint joint="left" coef="1"/><joint joint="arm" coef="1"/></fixed>
  </tendon>
  <actuator>
    <position name="grip" tendon="split" kp="200" kv="5"/>
    <motor name="thrust" site="rotor" gear="0 0 1 0 0 0"/>
    <motor name="twist" site="rotor" gear="0 0 0 0 1 0"/>
    <motor name="blend" tendon="mixed"/>
  </actuator>
</mujoco>
"""


@pytest.fixture
def gripper(tmp_path):
    path = tmp_path / "gripper.xml"
    path.write_text(GRIPPER)
    return make_robot_simulator(read_robot(path))


def test_commands_have_the_unit_of_what_they_move(gripper):
    units = {c.name: c.unit for c in gripper.system.inputs}
    assert [units[f"u.{name}"] for name in ("grip", "thrust", "twist", "blend")] == [
        "m", "N", "N*m", "1",
    ]  # fmt: skip


def test_effects_of_the_command_and_of_the_actuator_act_there(gripper):
    found = effects.list_effects_for(gripper.system)
    places = {name.partition("@")[2] for name in found if name.startswith("input.delay@")}
    assert places == {"grip", "thrust", "twist", "*"}
    at_grip = {name.partition("@")[0] for name in found if name.endswith("@grip")}
    assert {"input.gain", "input.lag", "actuator.stiffness", "actuator.damping"} <= at_grip
    # A servo of a joint, and the supply of a drive, need one coordinate.
    assert not {"servo.profile", "servo.deadband", "supply.sag", "input.power"} & at_grip
    assert "input.power@thrust" in found


@pytest.mark.parametrize(
    ("effect", "c", "before", "after"),
    [
        ("actuator.stiffness@grip", 0.5, 'kp="200"', 'kp="300"'),
        ("input.gain@thrust", 0.5, 'gear="0 0 1 0 0 0"', 'gear="0 0 1.5 0 0 0"'),
        ("input.gain@twist", -0.5, 'gear="0 0 0 0 1 0"', 'gear="0 0 0 0 0.5 0"'),
    ],
)
def test_the_robot_moves_as_the_file_that_states_it(effect, c, before, after, gripper, tmp_path):
    """MuJoCo's own numbers give the same motion as the coefficient."""
    assert GRIPPER.count(before) == 1
    path = tmp_path / "other.xml"
    path.write_text(GRIPPER.replace(before, after))
    times = np.arange(100) / 100.0
    inputs = {"u.grip": 0.02 * np.sin(5 * times), "u.thrust": np.cos(3 * times), "u.twist": times}
    scenario = Scenario(times, {}, inputs)
    observed = ["q.arm", "q.left"]
    found = gripper(observe=observed, effects=[effect]).simulate(np.array([[c]]), scenario)
    other = make_robot_simulator(read_robot(path))(observe=observed)
    stated = other.simulate(np.empty((1, 0)), scenario)
    plain = gripper(observe=observed).simulate(np.empty((1, 0)), scenario)
    np.testing.assert_allclose(found, stated, rtol=0, atol=1e-9)
    assert np.abs(stated - plain).max() > 1e-4


def test_the_file_states_them(gripper):
    causes = {"actuator.damping@grip": one(0.5), "input.bias@thrust": {"coefficient": number(2.0)}}
    done = write_and_check(gripper.robot, causes)
    assert not done.notes
