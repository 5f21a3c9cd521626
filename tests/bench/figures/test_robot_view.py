import numpy as np
import pytest

from bench.figures.camera_view import choose_projection, make_posed_data
from tests.bench.figures.figure_robots import POSE6, arm2, arm6, robot

SLIDE_AND_TURN = """
<mujoco><worldbody>
  <geom type="capsule" fromto="-40 0 0 40 0 0" size=".02"/>
  <body name="cart"><joint name="slider" type="slide" axis="1 0 0"/>
    <geom type="box" size=".15 .1 .08"/>
    <body name="pole"><joint name="hinge" axis="{axis}"/>
      <geom type="capsule" fromto="0 0 0 0 0 .6" size=".03"/>
    </body>
  </body>
</worldbody></mujoco>
"""


def seen(robot, positions=None):
    data = make_posed_data(robot, positions or {})
    return choose_projection(robot, data), data


def test_a_planar_robot_is_seen_along_the_common_axis_of_its_joints():
    there, data = seen(arm2(), {"shoulder": 0.6, "elbow": 0.8})
    assert np.abs(there.axes[2]) == pytest.approx([0, 1, 0], abs=1e-12)
    assert there.axes[0] == pytest.approx([1, 0, 0], abs=1e-12)
    assert there.axes[1] == pytest.approx([0, 0, 1], abs=1e-12)
    # A view along the axis has no foreshortening: the upper arm is 0.4 m long.
    shoulder, elbow = there.project(data.xanchor)
    assert np.linalg.norm(elbow - shoulder) == pytest.approx(0.4, abs=1e-12)


def test_one_that_turns_about_the_vertical_is_seen_from_above():
    there, _ = seen(robot(SLIDE_AND_TURN.format(axis="0 0 1")))
    assert there.axes == pytest.approx(np.array([[1, 0, 0], [0, 1, 0], [0, 0, -1]]), abs=1e-12)


def test_one_in_space_is_seen_from_above_where_no_two_joints_cover_each_other():
    there, data = seen(arm6(), POSE6)
    assert there.elevation == -25
    points = there.project(data.xanchor)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)[~np.eye(6, dtype=bool)]
    assert apart.min() > 0.02


def test_axes_are_orthogonal_from_everywhere():
    made, data = arm6(), make_posed_data(arm6(), POSE6)
    there = choose_projection(made, data)
    assert there.axes @ there.axes.T == pytest.approx(np.eye(3), abs=1e-12)


def test_all_of_the_robot_is_in_the_picture():
    for made, pose in ((arm2(), {"shoulder": 0.6}), (arm6(), POSE6), (arm6(shapes=False), {})):
        there, data = seen(made, pose)
        points = there.project(np.concatenate([data.xanchor, data.xipos[1:]]))
        assert (np.abs(points) <= (there.width / 2, there.height / 2)).all()


def test_a_long_rail_does_not_make_the_robot_small():
    there, _ = seen(robot(SLIDE_AND_TURN.format(axis="0 1 0")))
    assert there.width < 2.0


def test_a_pose_moves_the_joints_that_it_names():
    _, data = seen(arm2(), {"elbow": 0.5, "no_such_joint": 9.0})
    assert data.qpos == pytest.approx([0.0, 0.5])
