"""Tests of the grades of right and of deliberately wrong answers."""

import pytest

from tests.planted_causes.planted_marking import MAX_SET, mark

TRUE, SIZE = "drag.linear@elbow", 2.0


def verdict(*sets, name="named", value=2.02, low=2.01, high=2.03):
    causes = [
        {
            "effect": names[0],
            "alternatives": list(names[1:]),
            "coefficients": {"coefficient": {"value": value, "low": low, "high": high}},
        }
        for names in sets
    ]
    return {"verdict": name, "causes": causes}


@pytest.mark.parametrize(
    ("answer", "outcome"),
    [
        (None, "none"),
        (verdict(name="adequate"), "missed"),
        (verdict(name="unknown"), "unnamed"),
        (verdict((TRUE,), name="unknown"), "unnamed"),
        (verdict((TRUE,), name="unidentifiable"), "unnamed"),
        (verdict(("drag.linear@shoulder",)), "place"),
        (verdict(("friction.coulomb@elbow",)), "wrong"),
        (verdict(("drag.linear@*",)), "place"),
        (verdict((TRUE,), ("input.delay@m_elbow",)), "extra"),
        (verdict((TRUE,), name="partial"), "partial"),
        (verdict((TRUE,), value=2.2, low=2.15, high=2.25), "number"),
        (verdict((TRUE,), value=2.2, low=None, high=None), "number"),
        (verdict((TRUE,), value=-2.0, low=-2.1, high=-1.9), "number"),
    ],
)
def test_wrong_answers(answer, outcome):
    marked = mark(TRUE, SIZE, answer, lambda names: dict.fromkeys(names, 1.0))
    assert marked.outcome == outcome
    assert not marked.strict
    assert not marked.fair


@pytest.mark.parametrize(
    "answer",
    [
        verdict((TRUE,)),
        verdict((TRUE,), low=None, high=None),
        verdict((TRUE,), value=2.4, low=1.9, high=2.9),
    ],
)
def test_right_answers(answer):
    marked = mark(TRUE, SIZE, answer)
    assert (marked.outcome, marked.strict, marked.fair) == ("right", True, True)


@pytest.mark.parametrize(
    ("ratios", "is_fair"),
    [([1.0, 1.05], True), ([1.0, 1.06], False), ([1.0, None], False), ([1.0], False)],
)
def test_a_set_counts_where_all_other_members_do_as_well(ratios, is_fair):
    answer = verdict(("friction.coulomb@elbow", TRUE, "spring.linear@elbow"), name="ambiguous")
    marked = mark(TRUE, SIZE, answer, lambda names: dict(zip(names, ratios, strict=False)))
    assert (marked.outcome, marked.members) == ("set", 3)
    assert not marked.strict
    assert marked.fair is is_fair


def test_a_large_set_tells_nothing():
    names = [TRUE, *(f"input.{k}@m" for k in range(MAX_SET))]
    marked = mark(TRUE, SIZE, verdict(names), lambda others: dict.fromkeys(others, 1.0))
    assert marked.outcome == "set"
    assert not marked.fair


def test_a_set_with_a_wrong_number_is_not_right():
    answer = verdict((TRUE, "friction.coulomb@elbow"), value=3.0, low=2.9, high=3.1)
    marked = mark(TRUE, SIZE, answer, lambda names: dict.fromkeys(names, 1.0))
    assert marked.outcome == "set"
    assert not marked.fair


def test_a_set_without_a_refit_is_not_fair():
    assert not mark(TRUE, SIZE, verdict((TRUE, "friction.coulomb@elbow"))).fair
