"""Tests of the grading with right and wrong answers."""

import json

import pytest

from bench.diagnosis_benchmark.case_generation.case_sampling import BenchmarkCase
from bench.diagnosis_benchmark.grading import grade_answer
from tests.simple_exam import exam_answers
from tests.simple_exam.__main__ import main
from tests.simple_exam.exam_questions import Question
from tests.simple_exam.exam_summary import share
from tests.simple_exam.stub_answers import ADEQUATE


def item(kind="single", system="slider", **effects):
    return BenchmarkCase(
        "name",
        system,
        kind,
        effects,
        2.0,
        "white",
        True,
        100,
        4.0,
        4,
        "scipy",
        True,
        ("x",),
        0,
        {"mass": 1.5},
    )


def answer(verdict="named", *sets, **values):
    """Return a verdict that names these sets, with the interval 0.3 to 0.5 everywhere."""
    interval = {"value": 0.4, "unit": "1", "low": 0.3, "high": 0.5}
    causes = [
        {
            "effect": first,
            "alternatives": rest,
            "says": "something",
            "coefficients": {"coefficient": interval},
            "p_value": 0.0,
        }
        for first, *rest in sets
    ]
    return {**ADEQUATE, "verdict": verdict, "causes": causes, "parameters": values}


DRAG, BIAS = {"drag.linear": (0.4,)}, {"force.bias": (0.4,)}


@pytest.mark.parametrize(
    ("hidden", "given", "outcome", "found", "found_class"),
    [
        (item("clean"), ADEQUATE, "right", True, True),
        (item("clean"), answer("named", ["drag.linear"]), "alarm", False, False),
        (item("clean"), answer("unknown"), "alarm", False, False),
        (item("clean"), answer("unidentifiable"), "undecided", False, False),
        (item(**DRAG), answer("named", ["drag.linear"]), "right", True, True),
        (item(**DRAG), answer("partial", ["drag.linear"]), "right", True, True),
        (item(**DRAG), answer("ambiguous", ["drag.quadratic", "drag.linear"]), "set", True, True),
        (item(**DRAG), answer("ambiguous", ["wind", "drag.quadratic", "drag.linear"]), "set", False,
        False),
        (item(**DRAG), answer("named", ["drag.quadratic"]), "wrong", False, False),
        (item(**DRAG), answer("named", ["drag.linear"], ["force.bias"]), "extra", False, False),
        (item(**DRAG), answer("unknown"), "unnamed", False, False),
        (item(**DRAG), answer("unknown", ["drag.linear"]), "unnamed", False, False),
        (item(**DRAG), ADEQUATE, "missed", False, False),
        (item(**DRAG), None, "failed", False, False),
        (item(**BIAS), answer("named", ["gravity.tilt"]), "class", False, True),
        (item(**BIAS), answer("ambiguous", ["gravity.tilt", "force.bias", "input.bias"]), "set",
        False, True),
        (item(**BIAS), answer("ambiguous", ["gravity.tilt", "wind", "drag.linear"]), "class", False,
        False),
        (item("foreign", patch=(1.0,)), answer("unknown"), "right", True, True),
        (item("foreign", patch=(1.0,)), answer("partial", ["friction.coulomb"]), "right", True,
        True),
        (item("foreign", patch=(1.0,)), answer("named", ["friction.coulomb"]), "wrong", False,
        False),
        (item("foreign", patch=(1.0,)), ADEQUATE, "missed", False, False),
        (item("double", **DRAG, **BIAS), answer("named", ["force.bias"], ["drag.linear"]), "right",
        True, True),
        (item("double", **DRAG, **BIAS), answer("named", ["input.bias"], ["drag.linear"]), "class",
        False, True),
        (item("double", **DRAG, **BIAS), answer("partial", ["drag.linear"]), "one", False, False),
        (item("double", **DRAG, **BIAS), answer("ambiguous", ["drag.linear", "force.bias"]), "one",
        False, False),
        (
            item("double", **DRAG, **BIAS),
            answer("ambiguous", ["drag.linear", "force.bias"], ["drag.linear"]),
            "set", True, True,
        ),
        (item("double", **DRAG, **BIAS), answer("named", ["wind"], ["backlash"]), "wrong", False,
        False),
    ],
)  # fmt: skip
def test_marks(hidden, given, outcome, found, found_class):
    mark = grade_answer(hidden, given)
    assert (mark.outcome, mark.is_correct, mark.is_correct_up_to_equivalence) == (
        outcome,
        found,
        found_class,
    )


def test_intervals_are_held_against_the_truth():
    wide, narrow, open_ = (
        {"value": 1.5, "unit": "kg", "low": low, "high": high}
        for low, high in ((1, 2), (1, 1.2), (None, 2))
    )
    for mass, held in ((wide, True), (narrow, False), (open_, None)):
        assert grade_answer(item(**DRAG), answer("named", ["drag.linear"], mass=mass)).covered == {
            "mass": held,
            "drag.linear.coefficient": True,
        }
    assert grade_answer(
        item(**{"drag.linear": (0.6,)}), answer("named", ["drag.linear"])
    ).covered == {"drag.linear.coefficient": False}
    assert grade_answer(item("clean"), {**ADEQUATE, "parameters": {"mass": wide}}).covered == {
        "mass": True
    }
    assert grade_answer(item(**DRAG), answer("named", ["drag.quadratic"], mass=wide)).covered == {}


def test_shares_have_their_intervals():
    assert share([True] * 97 + [False] * 3, bool)["low"] == pytest.approx(
        0.9155, abs=1e-3
    )  # Wilson interval.
    assert share([False] * 300, bool, exact=True)["high"] == pytest.approx(
        1 - 0.025 ** (1 / 300)
    )  # Clopper-Pearson interval.


def test_a_crash_is_a_row():
    asked = Question("marks", "clean", "slider", None, 0, None)
    row = exam_answers.answered(asked.json(), 0, None, "tests.simple_exam.stub_answers:crashes")
    assert row["mark"]["outcome"] == "failed"
    assert "RuntimeError: no answer" in row["error"]
    json.dumps(row)


@pytest.mark.slow
def test_an_exam_goes_on_where_it_was(tmp_path, capsys):
    given = ["--quick", "--only", "clean", "--jobs", "1", "--out", str(tmp_path)]
    explain = ["--explain", "tests.simple_exam.stub_answers:sees_nothing"]
    assert main([*given, *explain]) == 0
    rows = (tmp_path / "items.jsonl").read_text()
    assert rows.count("\n") == 3
    # Leave an incomplete line, as an interruption does.
    (tmp_path / "items.jsonl").write_text(rows[: rows.index("\n") + 5])
    assert main([*given, "--explain", "tests.simple_exam.stub_answers:crashes"]) == 1
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["outcomes"]["clean"] == {"right": 1, "failed": 2}
    assert main([*given, *explain, "--fresh"]) == 0
    assert "0/3" in capsys.readouterr().out
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "items.jsonl",
        "items.csv",
        "confusion.csv",
        "summary.json",
        "README.md",
        "figures",
    }
