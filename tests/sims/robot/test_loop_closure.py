"""Tests of joints that closed loops couple, and of unmeasured joints that are placed by them."""

import mujoco
import numpy as np
import pytest

from sims.robot.loop_closure import (
    close_loops,
    coupled_joints,
    follow_measured_joints,
    list_following_joints,
    list_joints_placed_by_loops,
    settle_loops,
)
from sims.robot.parsing.read_model_file import read_robot
from sims.robot.robot_system import make_robot_system

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


BALL_CRANK = SLIDER_CRANK.replace(
    '<joint name="rod" axis="0 1 0"/>', '<joint name="rod" type="ball"/>'
)


def test_a_rod_with_ball_joints_is_placed_by_its_loop(write):
    robot = read_robot(write(BALL_CRANK))
    (placed,) = list_joints_placed_by_loops(robot)
    assert placed.name == "rod"
    given = {f"{kind}.{name}": 0.0 for kind in ("q", "qd") for name in ("crank", "piston", "arm")}
    given |= {"q.rod.qw": 1.0} | {f"q.rod.q{axis}": 0.0 for axis in "xyz"}
    given |= {f"qd.rod.w{axis}": 0.0 for axis in "xyz"} | {"q.crank": 0.4, "qd.crank": 3.0}
    closed = close_loops(robot, given, ["rod", "piston"])
    # As with a hinge: the ball joint turns about y, and the rod does not turn about itself.
    turned = -np.arcsin(CRANK * np.sin(0.4) / ROD)
    rate = -3.0 * CRANK * np.cos(0.4) / (ROD * np.cos(turned)) - 3.0
    half = (turned - 0.4) / 2.0
    pose = [closed[f"q.rod.q{axis}"] for axis in "wxyz"]
    assert pose == pytest.approx([np.cos(half), 0.0, np.sin(half), 0.0], abs=1e-9)
    assert [closed[f"qd.rod.w{axis}"] for axis in "xyz"] == pytest.approx([0, rate, 0], abs=1e-8)


def test_a_free_rod_is_placed_by_two_loops_and_a_free_base_by_none(write):
    rod = """<body name="{name}" pos="0 2 0"><freejoint name="{name}"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.01"/></body>"""
    ends = """<connect body1="held" body2="arm" anchor="0 0 0"/>
      <connect body1="held" body2="world" anchor="0.2 0 0"/></equality>"""
    bodies = rod.format(name="held") + rod.format(name="base") + "</worldbody>"
    text = SLIDER_CRANK.replace("</worldbody>", bodies).replace("</equality>", ends)
    placed = list_joints_placed_by_loops(read_robot(write(text)))
    assert [joint.name for joint in placed] == ["held"]


def test_of_two_ways_to_close_a_stretched_linkage_that_within_the_ranges_is_taken(write):
    # A parallelogram whose bars are aligned in the reference pose of the file.
    text = """<mujoco><compiler angle="radian"/>
      <default><geom type="capsule" size="0.01" contype="0" conaffinity="0"/></default>
      <worldbody>
        <body name="crank"><joint name="crank" axis="0 0 1" range="-2.5 -0.5"/>
          <geom fromto="0 0 0 0.1 0 0"/>
          <body name="rod" pos="0.1 0 0"><joint name="rod" axis="0 0 1"/>
            <geom fromto="0 0 0 0.3 0 0"/></body></body>
        <body name="rocker" pos="0.3 0 0"><joint name="rocker" axis="0 0 1" range="-2.5 -0.5"/>
          <geom fromto="0 0 0 0.1 0 0"/></body>
      </worldbody>
      <equality><connect body1="rod" body2="rocker" anchor="0.3 0 0"/></equality></mujoco>"""
    robot = read_robot(write(text))
    closed = close_loops(robot, states_of(robot, **{"q.rocker": -1.6}), ["crank", "rod"])
    assert closed["q.crank"] == pytest.approx(-1.6, abs=1e-9)
    assert closed["q.rod"] == pytest.approx(1.6, abs=1e-9)


def test_a_loop_under_load_settles_where_it_comes_to_rest(write):
    # The spring pushes the piston with 20 N; the crank holds.
    loaded = SLIDER_CRANK.replace(
        'type="slide" axis="1 0 0"', 'type="slide" axis="1 0 0" stiffness="50" springref="0.4"'
    )
    robot = read_robot(write(loaded))
    closed = close_loops(robot, states_of(robot, **{"q.crank": 0.9}), ["rod", "piston"])
    settled = settle_loops(robot, closed, ["rod", "piston"])
    # Independently: the same linkage, whose crank is held by its inertia until the others rest.
    held = mujoco.MjModel.from_xml_string(loaded)
    held.dof_armature[held.joint("crank").dofadr[0]] = 1e9
    data = mujoco.MjData(held)
    for name in ("crank", "rod", "piston"):
        data.qpos[held.joint(name).qposadr[0]] = closed[f"q.{name}"]
    mujoco.mj_step(held, data, 2000)
    rest = {name: float(data.qpos[held.joint(name).qposadr[0]]) for name in ("rod", "piston")}
    moved = rest["piston"] - closed["q.piston"]
    assert abs(moved) > 3e-5
    assert settled["q.piston"] - closed["q.piston"] == pytest.approx(moved, rel=0.03)
    assert settled["q.rod"] - closed["q.rod"] == pytest.approx(
        rest["rod"] - closed["q.rod"], rel=0.03
    )
    assert (settled["q.crank"], settled["q.arm"]) == (closed["q.crank"], closed["q.arm"])


def test_unmeasured_joints_follow_a_measured_motion_that_the_model_would_not_make(write):
    robot = read_robot(write(SLIDER_CRANK))
    times = 0.002 * np.arange(1001)
    angle, rate = 1.2 * np.sin(5.0 * times), 6.0 * np.cos(5.0 * times)
    closed = close_loops(robot, states_of(robot, **{"qd.crank": 6.0}), ["rod", "piston"])
    joints = robot.joints
    positions = np.array([[closed[f"q.{joint.name}"] for joint in joints]] * times.size)
    velocities = np.array([[closed[f"qd.{joint.name}"] for joint in joints]] * times.size)
    positions[:, 0], velocities[:, 0] = angle, rate
    followed, rates = follow_measured_joints(robot, 0.002, positions, velocities, ["rod", "piston"])
    turned = -np.arcsin(CRANK * np.sin(angle) / ROD)
    piston = CRANK * np.cos(angle) + ROD * np.cos(turned) - (CRANK + ROD)
    assert followed[:, 0] == pytest.approx(angle, abs=0.0)
    assert np.abs(followed[:, 1] - (turned - angle)).max() < 0.02
    assert np.abs(followed[:, 2] - piston).max() < 2e-3
    assert rates[:, 3] == pytest.approx(velocities[:, 3], abs=0.0)


@pytest.mark.parametrize(
    ("driven", "measured", "following"),
    [
        ("crank", ["q.crank"], ["piston", "rod"]),
        ("crank", ["q.piston", "qd.rod", "q.arm"], []),
        ("rod", ["q.crank"], []),
        ("rod", ["q.crank", "q.rod"], ["piston"]),
        ("arm", ["q.arm"], []),
    ],
)
def test_joints_follow_measured_ones_unless_a_drive_moves_them(write, driven, measured, following):
    actuator = f'<actuator><motor name="m" joint="{driven}"/></actuator></mujoco>'
    robot = read_robot(write(SLIDER_CRANK.replace("</mujoco>", actuator)))
    assert list_following_joints(robot, make_robot_system(robot).joint_loops, measured) == following


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
