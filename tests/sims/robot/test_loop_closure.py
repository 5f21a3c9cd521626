"""Tests of joints that closed loops couple, and of unmeasured joints that are placed by them."""

import mujoco
import numpy as np
import pytest

from sims.robot.loop_closure import close_loops, coupled_joints
from sims.robot.parsing.read_model_file import read_robot

SLIDER_CRANK = """<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="crank">
      <joint name="crank" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01"/>
      <body name="rod" pos="0.1 0 0">
        <joint name="rod" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.01"/>
      </body>
    </body>
    <body name="piston" pos="0.35 0 0">
      <joint name="piston" type="slide" axis="1 0 0"/>
      <geom type="sphere" size="0.02" contype="0" conaffinity="0"/>
    </body>
    <body name="arm" pos="0 1 0">
      <joint name="arm" axis="0 0 1"/>
      <geom type="sphere" size="0.02"/>
    </body>
  </worldbody>
  <equality><connect body1="rod" body2="piston" anchor="0.25 0 0"/></equality>
</mujoco>
"""
CRANK, ROD = 0.1, 0.25
"""Lengths in m."""


def states_of(robot, **values):
    states = {f"{kind}.{joint.name}": 0.0 for kind in ("q", "qd") for joint in robot.joints}
    return states | values


@pytest.mark.parametrize("angle", [0.4, -1.3, 2.5])
def test_a_slider_crank_is_closed_as_its_geometry_says(write, angle):
    robot = read_robot(write(SLIDER_CRANK))
    given = states_of(robot, **{"q.crank": angle, "qd.crank": 3.0, "q.arm": 0.7})
    closed = close_loops(robot, given, ["rod", "piston"])
    # The rod's end stays on the axis of the piston: CRANK sin a + ROD sin(a + b) = 0.
    turned = -np.arcsin(CRANK * np.sin(angle) / ROD)
    position = CRANK * np.cos(angle) + ROD * np.cos(turned) - (CRANK + ROD)
    rod_rate = -3.0 * CRANK * np.cos(angle) / (ROD * np.cos(turned))
    rate = -3.0 * CRANK * np.sin(angle) - ROD * rod_rate * np.sin(turned)
    assert closed["q.piston"] == pytest.approx(position, abs=1e-9)
    assert closed["q.rod"] == pytest.approx(turned - angle, abs=1e-9)
    assert closed["qd.piston"] == pytest.approx(rate, abs=1e-8)
    assert closed["qd.rod"] == pytest.approx(rod_rate - 3.0, abs=1e-8)
    assert (closed["q.crank"], closed["qd.crank"], closed["q.arm"]) == (angle, 3.0, 0.7)


def test_a_loop_that_cannot_close_keeps_its_states(write):
    text = SLIDER_CRANK.replace('pos="0.35 0 0"', 'pos="0.35 0 0.5"')
    text = text.replace('anchor="0.25 0 0"', 'anchor="0.25 0 0.5"')
    robot = read_robot(write(text.replace('type="slide"', 'type="slide" ref="5"')))
    given = states_of(robot, **{"q.crank": 0.4, "q.piston": 4.0})
    assert close_loops(robot, given, ["rod"]) == given


def test_a_robot_without_loops_keeps_its_states(write):
    text = SLIDER_CRANK.replace("<equality>", "<!--").replace("</equality>", "-->")
    robot = read_robot(write(text))
    given = states_of(robot, **{"q.crank": 0.4})
    assert close_loops(robot, given, ["rod", "piston"]) == given
    assert robot.compiled.neq == 0


FOURBAR = """
<mujoco><worldbody>
<body name="crank"><joint name="crank" axis="0 1 0"/>
<geom size=".02" fromto="0 0 0 0 0 .2" type="capsule"/>
<body name="coupler" pos="0 0 .2"><joint name="knee" axis="0 1 0"/>
<geom size=".02" fromto="0 0 0 .4 0 0" type="capsule"/></body></body>
<body name="rocker" pos=".4 0 0"><joint name="rocker" axis="0 1 0"/>
<geom size=".02" fromto="0 0 0 0 0 .2" type="capsule"/></body>
<body name="free" pos="1 0 0"><joint name="alone" axis="0 1 0"/><geom size=".02"/>
<body name="arm" pos=".1 0 0"><joint name="first" axis="0 1 0"/><geom size=".02"/>
<body name="tip" pos=".1 0 0"><joint name="second" axis="0 1 0"/><geom size=".02"/></body></body>
</body></worldbody><equality>{equality}</equality></mujoco>
"""
LOOP = '<connect body1="coupler" body2="rocker" anchor=".4 0 0"/>'
JOINTS = '<joint joint1="first" joint2="second"/>'
NAMES = ("crank", "knee", "rocker", "alone", "first", "second")


def groups_of(equality):
    model = mujoco.MjModel.from_xml_string(FOURBAR.format(equality=equality))
    dofs = [model.joint(name).dofadr[0] for name in NAMES]
    return sorted(sorted(NAMES[k] for k in group) for group in coupled_joints(model, dofs))


def test_the_joints_of_a_loop_and_of_an_equality_are_coupled():
    assert groups_of("") == []
    assert groups_of(LOOP) == [["crank", "knee", "rocker"]]
    assert groups_of(LOOP + JOINTS) == [["crank", "knee", "rocker"], ["first", "second"]]


def test_only_the_joints_below_a_common_ancestor_are_in_a_loop():
    equality = '<weld body1="free" body2="tip"/>'
    assert groups_of(equality) == [["first", "second"]]


def test_groups_that_share_a_joint_are_one():
    equality = '<joint joint1="rocker" joint2="first"/>' + LOOP + JOINTS
    assert groups_of(equality) == [["crank", "first", "knee", "rocker", "second"]]
