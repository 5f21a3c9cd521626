"""A few causes hidden in two robots: `explain` finds them, at their places."""

import pytest

pytest.importorskip("pinocchio", reason="pin has no wheel here")

from tests.robots import answers, questions


@pytest.mark.slow
@pytest.mark.parametrize("question", questions.quick(), ids=lambda question: question.name)
def test_what_is_hidden_in_an_arm_is_named(question):
    row = answers.answered(question.json(), 0, equal=False)
    assert not row["error"]
    assert row["mark"]["few"], row["mark"]
