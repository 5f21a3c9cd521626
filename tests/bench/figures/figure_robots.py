"""MJCF robots for tests of figures: one planar arm and one spatial arm."""

from pathlib import Path

import mujoco

from sims.robot.robot_model import RobotModel

ARM2 = """
<mujoco>
  <worldbody>
    <light pos="0 -2 3" dir="0 .5 -1"/>
    <geom type="plane" size="3 3 .1" pos="0 0 -1.2"/>
    <body name="base"><geom type="cylinder" size=".06 .05" mass="1"/>
      <body name="upper">
        <joint name="shoulder" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 .4 0 0" size=".04" mass="2"/>
        <body name="forearm" pos=".4 0 0">
          <joint name="elbow" axis="0 1 0"/>
          <geom type="capsule" fromto="0 0 0 .35 0 0" size=".03" mass="1"/>
          <site name="tip" pos=".35 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="m_shoulder" joint="shoulder"/>
    <motor name="m_elbow" joint="elbow"/>
  </actuator>
  <sensor><accelerometer name="shake" site="tip"/></sensor>
</mujoco>
"""
ARM6 = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
_LINKS = (
    ("0 0 1", "0 0 .09", "0 .1 0"),
    ("0 1 0", "0 .13 0", ".42 0 0"),
    ("0 1 0", ".42 -.12 0", ".39 0 0"),
    ("0 1 0", ".39 0 0", "0 .09 0"),
    ("0 0 1", "0 .09 0", "0 0 -.09"),
    ("0 1 0", "0 0 -.09", "0 .08 0"),
)
POSE6 = {"shoulder_lift": -1.0, "elbow": 1.2, "wrist_1": -0.6}


def arm2():
    return robot(ARM2)


def arm6(shapes=True):
    """Build an arm with six joints; without shapes, like a file whose meshes are missing."""
    bare = '<inertial pos="0 0 .01" mass="1" diaginertia=".01 .01 .01"/>'
    bodies = ""
    for name, (axis, at, end) in zip(ARM6, _LINKS, strict=True):
        shape = f'<geom type="capsule" fromto="0 0 0 {end}" size=".045" mass="1"/>'
        bodies += f'<body name="{name}_link" pos="{at}"><joint name="{name}" axis="{axis}"/>'
        bodies += shape if shapes else bare
    motors = "".join(f'<position name="m_{n}" joint="{n}" kp="100"/>' for n in ARM6)
    world = f"<worldbody>{bodies}{'</body>' * 6}</worldbody>"
    return robot(f"<mujoco>{world}<actuator>{motors}</actuator></mujoco>")


def robot(text, name="arm"):
    return RobotModel(Path(f"{name}.xml"), "mjcf", mujoco.MjSpec.from_string(text))
