"""Tests of the table of measured recordings with right and wrong answers."""

import dataclasses

import pytest

from sims.core.toml_validation import tomllib
from tests.exams.exam import UndrawableError
from tests.exams.explain_calls import Outcome
from tests.exams.recordings import recording_cases
from tests.exams.recordings.recording_cases import RECORDINGS, SHARED, find_answer_errors

EXPECTED = {
    "verdicts": ["named", "ambiguous"],
    "causes": [
        {
            "effect": ["drag.linear@elbow"],
            "value": 3.0,
            "tolerance": 0.05,
            "alternatives": ["actuator.damping@m"],
        }
    ],
}


def outcome(*sets, name="named", value=3.01, parameters=None):
    causes = [
        {"effect": s[0], "alternatives": list(s[1:]), "coefficients": {"c": {"value": value}}}
        for s in sets
    ]
    verdict = {"verdict": name, "causes": causes, "parameters": parameters or {}}
    return Outcome(verdict, 0, 1.0, 1.0, 100.0, "")


@pytest.mark.parametrize(
    ("answer", "error"),
    [
        (outcome(("drag.linear@elbow",)), None),
        (outcome(("drag.linear@elbow", "actuator.damping@m"), name="ambiguous"), None),
        (outcome(("actuator.damping@m", "drag.linear@elbow"), value=9.0), None),
        (outcome(("drag.linear@elbow",), value=3.2), "= 3.2, not 3"),
        (outcome(("drag.linear@wrist",)), "without drag.linear@elbow"),
        (outcome(("drag.linear@elbow", "input.rate@m")), "alternatives input.rate@m"),
        (outcome(("drag.linear@elbow",), ("backlash@m",)), "in addition backlash@m"),
        (outcome(("drag.linear@elbow",), name="partial"), "verdict partial"),
        (outcome(name="adequate"), "verdict adequate"),
        (Outcome(None, None, 120.0, 130.0, 100.0, ""), "no answer"),
    ],
)
def test_faults(answer, error):
    found = find_answer_errors(EXPECTED, answer)
    assert (found == []) if error is None else any(error in text for text in found)


def test_faults_of_parameters_and_findings():
    free = {"parameters": {"drag.linear@elbow": {"value": 60.0, "tolerance": 0.05}}}
    right = outcome(name="adequate", parameters={"drag.linear@elbow": {"value": 59.0}})
    assert find_answer_errors(free, right) == []
    assert find_answer_errors(free, outcome(name="adequate")) == ["no parameter drag.linear@elbow"]
    refused = Outcome(None, 2, 1.0, 1.0, 100.0, "joint elbow: its axis is reversed")
    flipped = {"exit": 2, "message": "axis.*reversed"}
    assert find_answer_errors(flipped, refused) == []
    assert find_answer_errors(flipped, dataclasses.replace(refused, code=0)) == [
        "exit code 0, not 2"
    ]
    assert len(find_answer_errors(flipped, outcome(("mass.scale@upper",)))) == 2
    assert find_answer_errors({"plain": "nothing is published"}, refused) is None


def test_every_recording_has_a_row():
    shared = SHARED
    if not (shared / "cases").is_dir():
        pytest.skip(f"no cases: {shared / 'cases'} is missing (set SIMGAP_SHARED)")
    recordings = tomllib.loads(RECORDINGS.read_text())
    listed = {(r["folder"], r.get("recording")) for r in recordings.values()}
    folders = {folder for folder, _ in listed}
    for case in (shared / "cases").iterdir():
        assert f"cases/{case.name}" in folders or case.name in ("tuners", "ANSWERS.md")
    for path in (shared / "data").glob("*/*.csv"):
        assert (f"data/{path.parent.name}", path.name) in listed
    for path in (shared / "robots").glob("*/"):
        assert f"robots/{path.name}" in folders


def test_answers_are_marked_and_descriptions_are_written(tmp_path, monkeypatch):
    folder = tmp_path / "shared" / "data" / "ball_drops"
    folder.mkdir(parents=True)
    monkeypatch.setattr(recording_cases, "SHARED", tmp_path / "shared")
    adequate = Outcome({"verdict": "adequate", "causes": []}, 0)
    for name, mark in (
        ("bowling_ball", "right"),
        ("tennis_ball", "wrong"),
        ("golf_ball", "unknown"),
    ):
        case = recording_cases.RecordingQuestion(name).draw()
        assert case.write(tmp_path).parent == folder
        assert case.mark(adequate).outcome == mark
        assert case.mark(adequate).strict is (mark == "right")
    with pytest.raises(UndrawableError, match="SIMGAP_SHARED"):
        recording_cases.RecordingQuestion("soft_friction").draw()
