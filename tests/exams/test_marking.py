"""Tests of the grades of right and wrong answers in the exams."""

import dataclasses

import pytest

from bench.diagnosis_benchmark.case_generation.benchmark_case import BenchmarkCase
from tests.exams.explain_calls import Outcome
from tests.exams.marking import HiddenCause, Standard, mark_answer
from tests.exams.planted import planted_cases
from tests.exams.robots import robot_cases
from tests.exams.systems.system_cases import SystemCase

TRUE, OTHER = "friction.coulomb@elbow", "drag.linear@shoulder"
INSIDE = {"value": 0.31, "low": 0.29, "high": 0.32}


def verdict(*sets, word="named", **coefficients):
    """Return a verdict that names these sets; a set is a name or a tuple of names."""
    sets = [(names,) if isinstance(names, str) else names for names in sets]
    causes = [
        {"effect": first, "alternatives": others, "coefficients": coefficients or {"c": INSIDE}}
        for first, *others in sets
    ]
    return {"verdict": word, "causes": causes, "parameters": {}}


ADEQUATE, UNKNOWN = verdict(word="adequate"), verdict(word="unknown")


def system_case(kind="single", **effects):
    conditions = "white", True, 100, 4.0, 4, "scipy", True, ("x",), 0, {"mass": 1.5}
    return SystemCase(BenchmarkCase("name", "slider", kind, effects, 2.0, *conditions))


def marked_system(case, answer):
    return case.mark(Outcome(answer, 0))


@pytest.fixture
def no_refit(monkeypatch):
    """Give no evidence against the members of a set."""
    monkeypatch.setattr(SystemCase, "_sigmas_against", lambda case, sets: {})


DRAG, BIAS = {"drag.linear": (0.4,)}, {"force.bias": (0.4,)}
ONE, OFFSET, PAIR = (
    system_case(**DRAG), system_case(**BIAS), system_case("double", **DRAG, **BIAS),
)  # fmt: skip
CLEAN, FOREIGN = system_case("clean"), system_case("foreign", patch=(1.0,))


@pytest.mark.usefixtures("no_refit")
@pytest.mark.parametrize(
    ("case", "answer", "outcome", "in_small_set", "equivalent"),
    [
        (CLEAN, ADEQUATE, "right", True, True),
        (CLEAN, verdict("drag.linear"), "alarm", False, False),
        (CLEAN, UNKNOWN, "alarm", False, False),
        (CLEAN, verdict(word="unidentifiable"), "undecided", False, False),
        (ONE, verdict("drag.linear"), "right", True, True),
        (ONE, verdict("drag.linear", word="partial"), "right", True, True),
        (ONE, verdict(("drag.quadratic", "drag.linear")), "set", True, True),
        (ONE, verdict(("wind", "drag.quadratic", "drag.linear")), "set", False, False),
        (ONE, verdict("drag.quadratic"), "wrong", False, False),
        (ONE, verdict("drag.linear", "force.bias"), "extra", False, False),
        (ONE, UNKNOWN, "unnamed", False, False),
        (ONE, verdict("drag.linear", word="unknown"), "unnamed", False, False),
        (ONE, ADEQUATE, "missed", False, False),
        (ONE, None, "failed", False, False),
        (OFFSET, verdict("gravity.tilt"), "class", False, True),
        (OFFSET, verdict(("gravity.tilt", "force.bias", "input.bias")), "set", False, True),
        (OFFSET, verdict(("gravity.tilt", "wind", "drag.linear")), "class", False, False),
        (FOREIGN, UNKNOWN, "right", True, True),
        (FOREIGN, verdict("friction.coulomb", word="partial"), "right", True, True),
        (FOREIGN, verdict("friction.coulomb"), "wrong", False, False),
        (FOREIGN, ADEQUATE, "missed", False, False),
        (PAIR, verdict("force.bias", "drag.linear"), "right", True, True),
        (PAIR, verdict("input.bias", "drag.linear"), "class", False, True),
        (PAIR, verdict("drag.linear", word="partial"), "one", False, False),
        (PAIR, verdict(("drag.linear", "force.bias")), "one", False, False),
        (PAIR, verdict(("drag.linear", "force.bias"), "drag.linear"), "set", True, True),
        (PAIR, verdict("wind", "backlash"), "wrong", False, False),
    ],
)
def test_outcomes_of_systems(case, answer, outcome, in_small_set, equivalent):
    mark = marked_system(case, answer)
    assert (mark.outcome, mark.few, mark.equivalent) == (outcome, in_small_set, equivalent)


@pytest.mark.parametrize(("sigmas", "is_fair"), [(3.9, True), (4.1, False)])
def test_a_large_set_is_fair_if_the_data_do_not_exclude_its_members(monkeypatch, sigmas, is_fair):
    monkeypatch.setattr(SystemCase, "_sigmas_against", lambda case, sets: {"wind": sigmas})
    mark = marked_system(ONE, verdict(("wind", "drag.quadratic", "drag.linear")))
    assert (mark.fair, mark.equivalent) == (is_fair, False)


def test_intervals_of_systems_cover_parameters_and_coefficients():
    wide, narrow, open_ = (
        {"value": 1.5, "unit": "kg", "low": low, "high": high}
        for low, high in ((1, 2), (1, 1.2), (None, 2))
    )
    held = {"value": 0.4, "low": 0.3, "high": 0.5}
    for mass, is_held in ((wide, True), (narrow, False), (open_, None)):
        answer = verdict("drag.linear", coefficient=held) | {"parameters": {"mass": mass}}
        expected = {"mass": is_held, "drag.linear.coefficient": True}
        assert marked_system(ONE, answer).covered == expected
    other = system_case(**{"drag.linear": (0.6,)})
    answer = verdict("drag.linear", coefficient=held)
    assert marked_system(other, answer).covered == {"drag.linear.coefficient": False}
    answer = verdict("drag.quadratic") | {"parameters": {"mass": wide}}
    assert marked_system(ONE, answer).covered == {}


SINGLE = HiddenCause("single", {TRUE: (0.3,)})
FAMILY = HiddenCause("family", {TRUE: (0.3,), "friction.coulomb@shoulder": (0.5,)})
TWO = HiddenCause("double", {TRUE: (0.3,), "input.gain@m_shoulder": (0.1,)})


@pytest.mark.parametrize(
    ("hidden_cause", "answer", "outcome", "members"),
    [
        (SINGLE, verdict(TRUE), "right", 1),
        (SINGLE, verdict((OTHER, TRUE)), "set", 2),
        (SINGLE, verdict("friction.coulomb@shoulder"), "place", 0),
        (SINGLE, verdict("force.bias@elbow"), "effect", 0),
        (SINGLE, verdict("mass.scale@elbow_link"), "effect", 0),
        (SINGLE, verdict(OTHER), "wrong", 0),
        (FAMILY, verdict("friction.coulomb@*"), "right", 1),
        (FAMILY, verdict(TRUE, "friction.coulomb@shoulder"), "member", 0),
        (TWO, verdict(TRUE, "input.gain@m_shoulder"), "right", 1),
        (HiddenCause("numerics", {}), verdict("numerics.step"), "right", 1),
        (HiddenCause("numerics", {}), verdict(TRUE), "wrong", 0),
        (HiddenCause("numerics", {}), verdict("numerics.step", TRUE), "extra", 1),
    ],
)
def test_outcomes_of_robots(hidden_cause, answer, outcome, members):
    mark = mark_answer(hidden_cause, answer, robot_cases.STANDARD)
    assert (mark.outcome, mark.members) == (outcome, members)


def test_large_sets_are_fair_only_if_all_members_were_compared_and_are_equal():
    answer = verdict((TRUE, "a@x", "b@x", "c@x", "d@x"))
    mark = mark_answer(SINGLE, answer, robot_cases.STANDARD)
    assert (mark.strict, mark.few, mark.any, mark.fair) == (False, False, True, False)
    for last, is_fair in ((1.01, True), (1.2, False), (None, False)):
        ratios = dict.fromkeys(("a@x", "b@x", "c@x"), 1.01) | {"d@x": last}
        mark = mark_answer(SINGLE, answer, robot_cases.STANDARD, lambda sets, r=ratios: r)
        assert mark.fair is is_fair


def test_intervals_of_robots_cover_the_hidden_coefficients():
    outside, open_ = INSIDE | {"low": 0.305}, INSIDE | {"low": None}
    for estimate, is_held in ((INSIDE, True), (outside, False), (open_, None)):
        mark = mark_answer(SINGLE, verdict(TRUE, coefficient=estimate), Standard())
        assert mark.covered == {f"{TRUE} coefficient": is_held}
    answer = verdict("friction.coulomb@*", **{"coefficient@elbow": INSIDE})
    covered = mark_answer(FAMILY, answer, Standard()).covered
    assert covered == {"friction.coulomb@* coefficient@elbow": True}


PLANTED = HiddenCause("single", {"drag.linear@elbow": (2.0,)})


def planted_mark(answer, ratio=1.0):
    def compare(sets):
        names = [name for names in sets for name in names if name != "drag.linear@elbow"]
        return dict.fromkeys(names, ratio)

    return mark_answer(PLANTED, answer, planted_cases.STANDARD, compare)


def estimated(value=2.02, low=2.01, high=2.03, word="named", others=()):
    number = {"value": value, "low": low, "high": high}
    return verdict(("drag.linear@elbow", *others), word=word, c=number)


@pytest.mark.parametrize(
    ("answer", "outcome"),
    [
        (None, "failed"),
        (verdict(word="unidentifiable"), "undecided"),
        (verdict("drag.linear@*"), "place"),
        (estimated(word="partial"), "partial"),
        (estimated(2.2, 2.15, 2.25), "number"),
        (estimated(2.2, None, None), "number"),
        (estimated(-2.0, -2.1, -1.9), "number"),
        (estimated(3.0, 2.9, 3.1, others=("friction.coulomb@elbow",)), "set"),
    ],
)
def test_a_planted_cause_with_a_wrong_number_is_not_right(answer, outcome):
    mark = planted_mark(answer)
    assert (mark.outcome, mark.strict, mark.fair) == (outcome, False, False)


@pytest.mark.parametrize(
    "answer", [estimated(), estimated(low=None, high=None), estimated(2.4, 1.9, 2.9)]
)
def test_a_planted_cause_with_the_right_number_is_right(answer):
    mark = planted_mark(answer)
    assert (mark.outcome, mark.strict, mark.fair) == ("right", True, True)


@pytest.mark.parametrize(
    ("members", "ratio", "is_fair"),
    [(2, 1.0, True), (3, 1.05, True), (3, 1.06, False), (3, None, False), (4, 1.0, False)],
)
def test_a_set_with_a_planted_cause_is_fair_up_to_four_equal_members(members, ratio, is_fair):
    others = [f"input.{k}@m" for k in range(members)]
    mark = planted_mark(estimated(others=others), ratio)
    assert (mark.outcome, mark.members, mark.strict) == ("set", members + 1, False)
    assert mark.fair is is_fair


def test_a_clean_recording_without_a_cause_is_right_where_numbers_count():
    mark = mark_answer(HiddenCause("clean", {}), ADEQUATE, planted_cases.STANDARD)
    assert (mark.outcome, mark.strict) == ("right", True)


def test_a_set_without_comparison_is_not_fair():
    answer = estimated(others=("friction.coulomb@elbow",))
    assert not mark_answer(PLANTED, answer, planted_cases.STANDARD).fair
    is_fair = dataclasses.replace(planted_cases.STANDARD, small_sets_are_fair=True)
    assert mark_answer(PLANTED, answer, is_fair).fair
