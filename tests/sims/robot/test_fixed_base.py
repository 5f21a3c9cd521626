"""Tests of floating robots that are fixed, as on a stand."""

import mujoco
import numpy as np
import pytest

from sims.core.simulator import InputError
from sims.robot.export.round_trip_check import simulate_test_motion
from sims.robot.parsing.read_model_file import read_robot
from tests.sims.robot.sample_arms import write_and_check
from tests.sims.robot.test_model_changes import one

STAND = """<mujoco>
  <worldbody>
    <body name="trunk" pos="0 0 0.6">
      {joint}
      <inertial pos="0 0 0" mass="6" diaginertia="0.05 0.2 0.2"/>
      <body name="leg/thigh" pos="0.2 0 0">
        <joint name="leg/hip" axis="0 1 0" damping="0.1"/>
        <inertial pos="0 0 -0.1" mass="1" diaginertia="0.006 0.006 0.001"/>
      </body>
    </body>
  </worldbody>
  <actuator><position name="leg/hip" joint="leg/hip" kp="20" kv="1"/></actuator>
  {keyframe}
</mujoco>
"""
HOME = '<keyframe><key name="home" qpos="0 0 0.4 1 0 0 0 0.3"/></keyframe>'
FREE = '<freejoint name="root"/>'


def floating(folder, joint=FREE):
    path = folder / "dog.xml"
    path.write_text(STAND.format(joint=joint, keyframe=HOME))
    return path


@pytest.mark.parametrize("joint", [FREE, '<joint name="root" type="free"/>'])
def test_a_fixed_robot_moves_as_one_without_a_free_joint(joint, tmp_path):
    robot = read_robot(floating(tmp_path, joint), engine={"fix_base": True})
    assert [j.name for j in robot.joints] == ["leg/hip"]
    assert robot.notes[0] == (
        "fixed in the pose of the model file: trunk; 1 keyframes are left out"
    )
    stand = mujoco.MjModel.from_xml_string(STAND.format(joint="", keyframe=""))
    np.testing.assert_array_equal(simulate_test_motion(robot.compiled), simulate_test_motion(stand))


def test_its_model_file_is_fixed_too(tmp_path):
    robot = read_robot(floating(tmp_path), engine={"fix_base": True})
    causes = {"drag.linear@leg/hip": one(0.2)}
    done = write_and_check(robot, causes)
    assert not {"freejoint", "keyframe"} & set(done.xml.replace("<", " ").replace("/", " ").split())
    assert mujoco.MjModel.from_xml_string(done.xml).dof_damping == pytest.approx([0.3])


def test_a_robot_that_does_not_float_is_said(tmp_path):
    path = tmp_path / "stand.xml"
    path.write_text(STAND.format(joint="", keyframe=""))
    robot = read_robot(path, engine={"fix_base": True})
    assert "fix_base: no body of the model file floats" in robot.notes


def test_a_number_instead_of_a_boolean_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"engine.fix_base: expected a bool"):
        read_robot(floating(tmp_path), engine={"fix_base": 1.5})


def test_without_the_option_it_floats(tmp_path):
    assert read_robot(floating(tmp_path)).joints[0].kind == "free"
