"""Test of the inertia of a link, which a regression about a wrong motion of both joints misses."""

import pytest

from bench.diagnosis import explain as explaining
from tests.exams.robots.robot_cases import RobotQuestion


def test_the_inertia_of_a_link_is_found_where_its_armature_and_a_payload_imitate_it(tmp_path):
    case = RobotQuestion("single", "arm2-servo", "inertia.scale", 0).draw()
    found = explaining.explain(case.write(tmp_path))
    assert [cause.effect for cause in found.causes] == ["inertia.scale@elbow_link"]
    (number,) = found.causes[0].coefficients.values()
    assert number.value == pytest.approx(*case.effects["inertia.scale@elbow_link"], rel=0.02)
