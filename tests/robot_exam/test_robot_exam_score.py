"""Tests of the grades of robot diagnoses."""

import dataclasses

import pytest

from tests.robot_exam.robot_exam_score import marked
from tests.robot_exam.robot_items import Item

ITEM = Item(
    "single/arm2-motor/friction.coulomb/0", "single", "arm2-motor",
    {"friction.coulomb@elbow": (0.3,)}, False, 4.0, "white", ("q.elbow",), None, 0.0, 0.002, "RK4",
)  # fmt: skip
FAMILY = dataclasses.replace(
    ITEM, kind="family", family=True,
    effects={"friction.coulomb@elbow": (0.3,), "friction.coulomb@shoulder": (0.5,)},
)  # fmt: skip
PAIR = dataclasses.replace(
    ITEM, kind="double", effects={"friction.coulomb@elbow": (0.3,), "input.gain@m_shoulder": (0.1,)}
)


def verdict(*sets, kind="named", **coefficients):
    causes = [
        {"effect": names[0], "alternatives": list(names[1:]), "coefficients": coefficients}
        for names in sets
    ]
    return {"verdict": kind, "causes": causes}


TRUE, OTHER = "friction.coulomb@elbow", "drag.linear@shoulder"


@pytest.mark.parametrize(
    ("item", "answer", "outcome", "members"),
    [
        (ITEM, verdict((TRUE,)), "right", 1),
        (ITEM, verdict((OTHER, TRUE)), "set", 2),
        (ITEM, verdict(("friction.coulomb@shoulder",)), "place", 0),
        (ITEM, verdict(("force.bias@elbow",)), "effect", 0),
        (ITEM, verdict(("mass.scale@elbow_link",)), "effect", 0),
        (ITEM, verdict((OTHER,)), "wrong", 0),
        (ITEM, verdict((TRUE,), (OTHER,)), "extra", 1),
        (ITEM, verdict(kind="adequate"), "missed", 0),
        (ITEM, verdict((TRUE,), kind="unknown"), "unnamed", 0),
        (ITEM, None, "failed", 0),
        (FAMILY, verdict(("friction.coulomb@*",)), "right", 1),
        (FAMILY, verdict((TRUE,), ("friction.coulomb@shoulder",)), "member", 0),
        (PAIR, verdict((TRUE,), ("input.gain@m_shoulder",)), "right", 1),
        (PAIR, verdict((TRUE,)), "one", 1),
        (PAIR, verdict((TRUE, "input.gain@m_shoulder"),), "one", 2),
        (dataclasses.replace(ITEM, kind="clean"), verdict(kind="adequate"), "right", 0),
        (dataclasses.replace(ITEM, kind="clean"), verdict((TRUE,)), "alarm", 0),
        (dataclasses.replace(ITEM, kind="foreign"), verdict((TRUE,), kind="partial"), "right", 0),
        (dataclasses.replace(ITEM, kind="foreign"), verdict((TRUE,)), "wrong", 0),
        (dataclasses.replace(ITEM, kind="numerics"), verdict(("numerics.step",)), "right", 1),
        (dataclasses.replace(ITEM, kind="numerics"), verdict((TRUE,)), "wrong", 0),
    ],
)  # fmt: skip
def test_outcomes(item, answer, outcome, members):
    mark = marked(item, answer)
    assert (mark.outcome, mark.members) == (outcome, members)


def test_large_sets_tell_less_and_are_fair_only_where_measured():
    mark = marked(ITEM, verdict((TRUE, "a@x", "b@x", "c@x", "d@x")))
    assert (mark.strict, mark.few, mark.any, mark.fair) == (False, False, True, False)
    ratios = dict.fromkeys(("a@x", "b@x", "c@x", "d@x"), 1.01)
    assert dataclasses.replace(mark, equal=ratios).fair
    assert not dataclasses.replace(mark, equal=ratios | {"a@x": 1.2}).fair
    assert not dataclasses.replace(mark, equal=ratios | {"a@x": None}).fair


def test_intervals_are_held_against_the_truth():
    inside = {"value": 0.31, "low": 0.29, "high": 0.32}
    outside, open_ = inside | {"low": 0.305}, inside | {"low": None}
    for said, held in ((inside, True), (outside, False), (open_, None)):
        mark = marked(ITEM, verdict((TRUE,), coefficient=said))
        assert mark.covered == {f"{TRUE} coefficient": held}
    family = marked(FAMILY, verdict(("friction.coulomb@*",), **{"coefficient@elbow": inside}))
    assert family.covered == {"friction.coulomb@* coefficient@elbow": True}
