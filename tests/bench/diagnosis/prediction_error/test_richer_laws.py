"""Test that a richer friction law replaces the simpler one with which a selection begins."""

import pytest

from bench.diagnosis import explain as explaining
from tests.exams.robots.robot_cases import RobotQuestion


@pytest.mark.slow
def test_friction_that_depends_on_the_position_is_not_called_coulomb_friction(tmp_path):
    """The law is found; its fit stops at a nearby shape, so that the answer is partial."""
    case = RobotQuestion("single", "panda-servo", "friction.position", 0).draw()
    found = explaining.explain(case.write(tmp_path))
    assert [cause.effect for cause in found.causes] == ["friction.position@panda_joint3"]
