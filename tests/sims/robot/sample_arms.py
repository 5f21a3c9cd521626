"""A robot for tests, and its model file: two links driven by servos and a motor."""

from __future__ import annotations

import mujoco

from sims.robot.export.round_trip_check import check_written_files
from sims.robot.export.write_model_file import write_model_files
from sims.robot.robot_model import RobotModel

ARM = """
<mujoco model="arm">
  <option timestep="0.001" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.2 0.05 0" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="1.5"/>
      <body name="fore" pos="0.4 0 0">
        <!-- the elbow is the one that wears -->
        <joint name="elbow" axis="0 1 0" damping="0.1" frictionloss="0.05" stiffness="0.5"
               springref="10"/>
        <inertial pos="0.15 0 0.01" mass="0.8" diaginertia="0.002 0.008 0.009"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
        <body name="wheel" pos="0.3 0 0">
          <joint name="spin" axis="0 0 1"/>
          <geom type="cylinder" size="0.05 0.01" mass="0.2"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="m_shoulder" joint="shoulder" kp="60" kv="3"/>
    <motor name="m_elbow" joint="elbow" gear="2" forcelimited="true" forcerange="-1 4"/>
    <velocity name="m_spin" joint="spin" kv="0.05"/>
  </actuator>
</mujoco>
"""


def robot(folder, text=ARM):
    """Write an MJCF text to a file and return its robot."""
    path = folder / "arm.xml"
    path.write_text(text)
    return RobotModel(path, "mjcf", mujoco.MjSpec.from_file(str(path)))


def write_and_check(robot, causes, log="log.csv"):
    """Write causes into the file of a robot, check its motion, and return what was written."""
    done = write_model_files(robot, causes, log)
    check_written_files(robot, causes, done)
    return done
