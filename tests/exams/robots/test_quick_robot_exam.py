"""Tests that `explain` finds a few hidden causes of two robots at their places."""

import pytest

pytest.importorskip("pinocchio", reason="pin has no wheel here")

from tests.exams.explain_calls import ExplainCall
from tests.exams.robots import exam_settings, robot_cases


@pytest.fixture
def short_recordings(monkeypatch):
    """Make recordings of three runs of 3 s instead of six of 4 s; causes have the same sizes."""
    for name, value in (("FITTED", 2), ("HELD_OUT", 1), ("SECONDS", 3.0)):
        monkeypatch.setattr(exam_settings, name, value)
    caches = robot_cases.setting_of, robot_cases.gauge_of
    for cached in caches:
        cached.cache_clear()
    yield
    for cached in caches:
        cached.cache_clear()


@pytest.mark.slow
@pytest.mark.usefixtures("short_recordings")
@pytest.mark.parametrize("question", robot_cases.quick(), ids=lambda question: question.name)
def test_a_hidden_cause_of_an_arm_is_named(question, tmp_path, monkeypatch):
    monkeypatch.setattr(robot_cases.RobotCase, "_held_out_ratios", lambda case, sets: {})
    case = question.draw()
    outcome = ExplainCall(cpu_limit=900.0)(case.write(tmp_path), tmp_path)
    assert not outcome.message
    assert case.mark(outcome).few, case.mark(outcome)
