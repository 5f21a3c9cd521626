"""Tests of reading model files: the values they state."""

import pytest

from sims.robot.parsing.read_model_file import read_robot

ARM = """
<mujoco>
  <option timestep="0.004" integrator="RK4"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" range="-90 90" damping="0.2"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.5" mass="2"/>
      <body name="fore" pos="0 0 -0.5">
        <joint name="elbow" axis="0 1 0" actuatorfrcrange="-7 7"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.4" mass="1"/>
        <body name="tool"><geom size="0.03" mass="0.5"/></body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="m_shoulder" joint="shoulder" kp="50" kv="2" forcerange="-30 30"/>
    <motor name="m_elbow" joint="elbow" gear="10" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""

SWING = """
<robot name="swing">
  <link name="base"><inertial><mass value="3"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="rod"><inertial><origin xyz="0 0 -0.5"/><mass value="2"/>
    <inertia ixx="0.2" iyy="0.3" izz="0.4" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="plate"/>
  <link name="bob"><inertial><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="pivot" type="revolute"><parent link="base"/><child link="rod"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="2" effort="12" velocity="3"/>
    <dynamics damping="0.3" friction="0.05"/></joint>
  <joint name="screws" type="fixed"><parent link="rod"/><child link="plate"/>
    <origin xyz="0 0 -1"/></joint>
  <joint name="glue" type="fixed"><parent link="plate"/><child link="bob"/></joint>
</robot>
"""


def test_an_mjcf_is_read_as_it_stands(write):
    robot = read_robot(write(ARM))
    assert robot.format == "mjcf"
    assert robot.notes == ()
    assert [(joint.name, joint.kind, joint.effort) for joint in robot.joints] == [
        ("shoulder", "hinge", None),
        ("elbow", "hinge", 7.0),
    ]
    assert robot.joint("shoulder").range == pytest.approx((-1.5708, 1.5708), abs=1e-4)
    assert {body.name: body.mass for body in robot.bodies} == {"upper": 2, "fore": 1, "tool": 0.5}
    position, motor = robot.actuators
    assert (position.kind, position.joint, position.force) == ("position", "shoulder", (-30, 30))
    assert (motor.kind, motor.range, motor.control, motor.controls) == ("motor", (-1, 1), 1, 1)
    assert robot.compiled.opt.timestep == 0.004


def test_a_urdf_is_read_with_its_fixed_links_in_what_carries_them(write):
    robot = read_robot(
        write(SWING, "swing.xml")
    )  # the content determines the format, not the file name
    assert robot.format == "urdf"
    assert robot.aliases == {"base": "world", "plate": "rod", "bob": "rod"}
    (body,) = robot.bodies
    assert (body.name, body.mass, body.aliases) == ("rod", pytest.approx(3), ("plate", "bob"))
    assert robot.body("bob").name == "rod"
    (pivot,) = robot.joints
    assert (pivot.range, pivot.effort) == ((-1.0, 2.0), 12.0)
    model = robot.compiled
    assert model.dof_damping[0] == 0.3
    assert model.dof_frictionloss[0] == 0.05
    # About the pivot: the rod's inertia and lever of 0.5 m, the bob's inertia and lever of 1 m.
    inertia = 0.3 + 2 * 0.5**2 + 0.1 + 1 * 1**2
    assert model.dof_invweight0[0] == pytest.approx(1 / inertia)
    assert robot.actuators == ()


def test_notes_of_a_urdf(write):
    assert read_robot(write(SWING)).notes == (
        "held to the world, as MuJoCo does with a URDF's root: base",
        "effort limits clamp what actuators exert (N·m or N): pivot 12",
        "links on fixed joints are merged into their parent links: base of world; plate, bob of "
        "rod",
        "no actuators: it is passive unless the [actuators.NAME] of a recording add some",
    )


def test_settings_of_a_urdf_for_mujoco_are_kept(write):
    option = '<mujoco><option timestep="0.0005" integrator="implicit"/></mujoco>'
    model = read_robot(write(SWING.replace("<link", f"{option}<link", 1))).compiled
    assert (model.opt.timestep, model.opt.integrator) == (0.0005, 2)


def test_what_is_read_and_set_enters_the_digest(write):
    first = read_robot(write(ARM))
    assert read_robot(write(ARM, "other.xml")).digest == first.digest
    assert len(first.digest) == 64
    assert read_robot(write(ARM.replace('mass="2"', 'mass="3"'))).digest != first.digest
    assert read_robot(write(ARM), engine={"timestep": 0.001}).digest != first.digest
