"""A few causes hidden in two robots: `explain` finds them, at their places."""

import pytest

pytest.importorskip("pinocchio", reason="pin has no wheel here")

from tests.robots import answers, items, questions, recording, settings, sizing


@pytest.fixture
def shorter(monkeypatch):
    """Recordings of three runs of 3 s, not of six of 4 s: what is hidden is drawn as large."""
    for module in (settings, recording, sizing):
        monkeypatch.setattr(module, "FITTED", 2)
    monkeypatch.setattr(settings, "HELD_OUT", 1)
    monkeypatch.setattr(settings, "SECONDS", 3.0)
    kept = items.setting_of, items.gauge_of
    for cached in kept:
        cached.cache_clear()
    yield
    for cached in kept:
        cached.cache_clear()


@pytest.mark.slow
@pytest.mark.usefixtures("shorter")
@pytest.mark.parametrize("question", questions.quick(), ids=lambda question: question.name)
def test_what_is_hidden_in_an_arm_is_named(question):
    row = answers.answered(question.json(), 0, equal=False)
    assert not row["error"]
    assert row["mark"]["few"], row["mark"]
