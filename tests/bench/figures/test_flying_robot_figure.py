"""Tests of the places of a flying robot in figures."""

import numpy as np
import pytest

from bench.figures.camera_view import make_posed_data
from bench.figures.robot_figure import locate_place
from sims.robot.parsing.read_model_file import read_robot
from tests.sims.robot.test_floating_bases import BASE, QUADROTOR


@pytest.fixture
def posed(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(QUADROTOR)
    robot = read_robot(path, engine=BASE)
    return robot, make_posed_data(robot, {"base.x": 1.0, "base.y": 2.0, "base.z": 3.0})


@pytest.mark.parametrize("joint", ["base.x", "base.z", "base.roll"])
def test_coordinates_of_a_floating_body_are_where_it_is(posed, joint):
    robot, data = posed
    assert locate_place(robot, data, "joint", joint) == pytest.approx([1.0, 2.0, 3.0])


def test_a_rotor_is_at_its_site(posed):
    robot, data = posed
    place = locate_place(robot, data, "actuator", "m2")
    # The site is 0.156 m from the origin of the body.
    distance = np.linalg.norm(place - np.array([1.0, 2.0, 3.0]))
    assert distance == pytest.approx(np.hypot(0.12, 0.1), abs=1e-9)
