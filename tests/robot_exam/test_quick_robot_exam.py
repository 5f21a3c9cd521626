"""Tests that `explain` finds a few hidden causes of two robots at their places."""

import pytest

pytest.importorskip("pinocchio", reason="pin has no wheel here")

from tests.robot_exam import (
    cause_sizing,
    exam_recording,
    exam_settings,
    robot_answers,
    robot_items,
    robot_questions,
)


@pytest.fixture
def shorter(monkeypatch):
    """Make recordings of three runs of 3 s instead of six of 4 s; causes have the same sizes."""
    for module in (exam_settings, exam_recording, cause_sizing):
        monkeypatch.setattr(module, "FITTED", 2)
    monkeypatch.setattr(exam_settings, "HELD_OUT", 1)
    monkeypatch.setattr(exam_settings, "SECONDS", 3.0)
    kept = robot_items.setting_of, robot_items.gauge_of
    for cached in kept:
        cached.cache_clear()
    yield
    for cached in kept:
        cached.cache_clear()


@pytest.mark.slow
@pytest.mark.usefixtures("shorter")
@pytest.mark.parametrize("question", robot_questions.quick(), ids=lambda question: question.name)
def test_what_is_hidden_in_an_arm_is_named(question):
    row = robot_answers.answered(question.json(), 0, equal=False)
    assert not row["error"]
    assert row["mark"]["few"], row["mark"]
